"""Terms, robots and tasks from a package of a user's own, without an edit in op3."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from torchrl.envs import check_env_specs

from op3.common.assets import asset_path
from op3.envs import make_env
from op3.envs.record import record_episodes
from op3.policy import PolicyBundle
from op3.robot.robot import robot_files
from op3.tasks import find_task, task_names
from op3.tasks.baselines import Hold

ROOT = Path(__file__).resolve().parents[2]

PACKAGE = """
import torch


def forward_speed(state, target):
    return -(state.base_velocity[:, 0] - target).abs()


class Airtime:
    def __init__(self, num_envs, policy_period, longest=0.4):
        self.longest, self.period, self.time = longest, policy_period, torch.zeros(num_envs, dtype=torch.float64)

    def begin(self, rows):
        self.time[rows] = 0.0

    def __call__(self, state):
        lifted = state.step.foot_force.min(1).values < 1.0
        self.time = torch.where(lifted, self.time + self.period, 0.0)
        return self.time.clamp(max=self.longest)


def knees(sensed, robot):
    return sensed.joint_position[..., robot.indices(["l_knee", "r_knee"])]


def too_fast(state, limit):
    return state.base_velocity.norm(dim=1) > limit


def wind(world, time, force):
    world.base_wrench[:, 1] = force


class Beat:
    def __init__(self, num_envs, rate):
        self.rate = rate

    def at(self, time):
        return torch.sin(2 * torch.pi * self.rate * time)[:, None]


def stairs(robot):
    from dm_control import mjcf

    laid = mjcf.RootElement(model="stairs")
    for number in range(3):
        laid.worldbody.add("geom", type="box", size=[0.1, 0.5, 0.005], pos=[0.4 + 0.2 * number, 0, 0.005 * number])
    door = laid.worldbody.add("body", name="door", pos=[1.2, 0.0, 0.1])
    door.add("joint", type="hinge", axis=[0, 0, 1])
    door.add("geom", type="box", size=[0.2, 0.005, 0.09], mass=0.05)
    return laid


def wrong_shape(state):
    return state.base_velocity


def misspelt(seen):
    return seen.joint_velocty


def scaled(state, size):
    return state.base_height * size


def heights(state):
    return state.base_height


def constant(seen):
    return 1.0


class Mute:
    pass


class Flat:
    def at(self, time):
        return time


def mismatched(state):
    return state.base_velocity @ torch.ones(7, dtype=torch.float64)


def silent(state):
    pass


silent.mirror = (1.0,)


def height_and_velocity(state):
    return torch.cat([state.base_height[:, None], state.heading_velocity], 1)


height_and_velocity.mirror = (1.0, 1.0, -1.0, -1.0)
"""

OWN = {
    "rewards.forward": {"function": "my_package.terms.forward_speed", "weight": 0.5, "target": 0.3},
    "shaping.airtime": {"function": "my_package.terms.Airtime", "weight": 0.1, "longest": 0.2},
    "observations.knees": {"function": "my_package.terms.knees", "noise": 0.01, "delay": 1},
    "observations.beat": {"function": "op3.policy.observations.command", "name": "beat"},
    "terminations.too_fast": {"function": "my_package.terms.too_fast", "limit": 2.0},
    "events.wind": {"function": "my_package.terms.wind", "force": 3.0},
    "commands.beat": {"function": "my_package.terms.Beat", "rate": 2.0},
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of a user's own on the path."""
    folder = tmp_path / "my_package"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "terms.py").write_text(textwrap.dedent(PACKAGE))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    for name in [name for name in sys.modules if name.startswith("my_package")]:
        del sys.modules[name]


@pytest.mark.parametrize("backend", ["batched", "composer"])
def test_own_terms_act(package, backend):
    """A reward, a termination, an observation, an event and a command of a user's own act in both steppers."""
    env = make_env(find_task("walk", OWN), num_envs=1, backend=backend)
    check_env_specs(env)
    state = env.reset()
    state["action"] = torch.from_numpy(env.action_map.stand()).float()[None]
    calm = make_env(find_task("walk", {**OWN, "events.wind": None}), num_envs=1, backend=backend)
    still = calm.reset().set("action", state["action"])
    for _ in range(3):
        after, other = env.step(state)["next"], calm.step(still)["next"]
        state = after.exclude("reward").set("action", state["action"])
        still = other.exclude("reward").set("action", state["action"])
    mdp = env.mdp if backend == "batched" else env.composer_task.mdp
    assert mdp.observer.layout["knees"] == 2
    assert mdp.observer.layout["beat"] == 1
    assert -0.25 < after["reward_terms", "forward"].item() < -0.05  # at rest it misses 0.3 m/s, times 0.5
    assert after["reward_terms", "airtime"].item() == 0.0
    leaned = [made["observation"][0, 3 * 18 : 3 * 18 + 20] for made in (after, other)]
    assert (after["observation"] - other["observation"]).abs().max() > 1e-3, leaned


@pytest.mark.parametrize("backend", ["batched", "composer"])
def test_what_critics_alone_see(package, backend):
    """A user's privileged observation is a key of its own, from the first observation on; the policy's is as before."""
    own = {"privileged.state": {"function": "my_package.terms.height_and_velocity"}}
    env = make_env(find_task("walk", own), num_envs=1, backend=backend)
    plain = make_env(find_task("walk"), num_envs=1, backend=backend)
    check_env_specs(env)
    env.set_seed(0)
    state, other = env.reset(), plain.reset()
    assert state["privileged"].shape == (1, 4)
    assert 0.2 < state["privileged"][0, 0] < 0.35  # the trunk's height [m]
    assert torch.equal(state["observation"], other["observation"])
    mirror = env.task.mirror(env.action_map)
    assert mirror.privileged(torch.ones(4)).tolist() == [1.0, 1.0, -1.0, -1.0]


def test_privileged_observations_that_cannot_be_are_named(package):
    """Without signs, or with other numbers than signs, one sentence names the term."""
    with pytest.raises(ValueError, match=r"privileged\.mine: the function needs mirror"):
        make_env(find_task("walk", {"privileged.mine": {"function": "my_package.terms.wrong_shape"}}), num_envs=2)
    with pytest.raises(ValueError, match=r"there is no term 'base_heigt'.*base_height"):
        make_env(find_task("walk", {"privileged.base_heigt": {}}), num_envs=2)


def test_a_term_of_the_wrong_shape_is_named(package):
    """One number per robot: anything else is refused with both shapes."""
    env = make_env(find_task("walk", {"rewards.mine": {"function": "my_package.terms.wrong_shape"}}), num_envs=2)
    state = env.reset().set("action", torch.zeros(2, 20))
    with pytest.raises(ValueError, match=r"rewards.mine must return \[env\] = \(2,\), got \(2, 3\)"):
        env.step(state)


@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        ("rewards", {"function": "misspelt"}, r"rewards\.mine: AttributeError in terms\.py, line .* 'joint_velocity'"),
        ("observations", {"function": "misspelt"}, r"observations\.mine does not fit .* terms\.py.* 'joint_velocity'"),
        ("rewards", {"function": "scaled", "size": [1, 2, 3]}, r"rewards\.mine: TypeError in terms\.py, line \d+: "),
        ("rewards", {"function": "constant"}, r"rewards\.mine must return \[env\] = \(2,\), got 1\.0"),
        ("observations", {"function": "constant"}, r"observations\.mine must return \[\.\.\., number\].*, got 1\.0"),
        ("terminations", {"function": "heights"}, r"terminations\.mine must return true or false for each robot, got"),
        ("rewards", {"function": "mismatched"}, r"rewards\.mine: RuntimeError in terms\.py, line \d+: size mismatch"),
        ("privileged", {"function": "silent"}, r"privileged\.mine must return .*mirror\] = \(2, 1\), got None"),
        ("commands", {"function": "Flat"}, r"commands\.mine must return \[env, number\] = \(1, \.\.\.\), got \(1,\)"),
        ("commands", {"function": "Mute"}, r"commands\.mine must be a class with a method at\(time\)"),
        ("commands", {"function": "Beat", "rate": None}, r"commands\.mine: TypeError in terms\.py, line \d+: "),
    ],
)
def test_mistakes_in_own_terms_are_reported_with_term_and_line(package, kind, fields, message):
    """One sentence names the term, and the line of the user's file or what must be returned."""
    fields = {**fields, "function": f"my_package.terms.{fields['function']}"}

    def stepped():
        env = make_env(find_task("balance", {f"{kind}.mine": fields}), num_envs=2)
        env.step(env.reset().set("action", torch.zeros(2, 20)))

    with pytest.raises(ValueError, match=message):
        stepped()


def test_a_curriculum_changes_own_terms(package):
    """A number of a term is changed by its path, whether the term is a function or a class."""
    env = make_env(find_task("walk", OWN), num_envs=1)
    env.set_terms(**{"rewards.forward.weight": 2.0, "rewards.forward.target": 0.0, "shaping.airtime.longest": 0.1})
    state = env.reset().set("action", torch.from_numpy(env.action_map.stand()).float()[None])
    assert env.step(state)["next", "reward_terms", "forward"].abs().item() < 0.4
    assert env.mdp.terms["shaping"]["airtime"].target.longest == 0.1


def test_a_task_of_ones_own_trains(package, tmp_path, monkeypatch):
    """A task file in a folder of one's own, built on one that exists, with a curriculum of its own."""
    folder = tmp_path / "configs" / "task"
    folder.mkdir(parents=True)
    (folder / "walk_in_wind.yaml").write_text(
        "defaults: [walk, _self_]\nname: walk_in_wind\n"
        "events:\n  wind: {function: my_package.terms.wind, force: 0.0}\n"
        "curricula:\n  events.wind.force: [[0, 0.0], [100, 2.0]]\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    small = ["train.steps=64", "algorithm.warmup=32", "algorithm.rollout=4", "environments=4", "algorithm.buffer=64"]
    small += ["train.evaluate_every=64", "train.checkpoint_every=64", "evaluation.episodes=1", "evaluation.video=false"]
    out = tmp_path / "out"
    words = [f"--config-dir={folder.parent}", "task=walk_in_wind", *small, "wandb=disabled", f"hydra.run.dir={out}"]
    done = subprocess.run([sys.executable, str(ROOT / "experiments/train.py"), *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert PolicyBundle.load(out / "policy").manifest.task == "walk_in_wind"


ROBOTS = [(name, None) for name in task_names()] + [("stand", "quadruped"), ("walk", "quadruped")]


@pytest.mark.parametrize(("name", "robot"), ROBOTS)
def test_every_task_with_no_and_with_random_actions(name, robot):
    """Zero and random actions give finite observations and rewards in every task, for every robot that fits it."""
    task = find_task(name) if robot is None else find_task(name, robot=robot)
    env = make_env(task, "own", num_envs=2, num_threads=1)
    check_env_specs(env)
    generator = torch.Generator().manual_seed(0)
    state = env.reset()
    for step in range(12):
        action = 2.0 * torch.rand(2, env.action_map.size, generator=generator) - 1.0
        state["action"] = action if step % 2 else 0.0 * action
        after = env.step(state)["next"]
        assert torch.isfinite(after["observation"]).all()
        assert torch.isfinite(after["reward"]).all()
        state = after.exclude("reward")


def test_key_points_of_four_legs_are_mujocos():
    """For feet without key points a policy sees the origins of the feet, as MuJoCo has them."""
    import mujoco
    import numpy as np

    from op3.policy.forward_kinematics import leg_kinematics, tip_kinematics
    from op3.robot import load_robot

    for name, chains in (("quadruped", leg_kinematics), ("arm", tip_kinematics)):
        robot = load_robot(name)
        model, data = robot.bare_model, mujoco.MjData(robot.bare_model)
        position = np.random.default_rng(0).uniform(*robot.limits.T)
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        base = data.body(robot.file.base)
        turn = base.xmat.reshape(3, 3)
        if name == "arm":
            expected = [data.site(robot.file.tip).xpos]
        else:
            expected = [data.body(foot).xpos for foot in robot.file.feet]
        angles = torch.from_numpy(position)
        points, _ = chains(robot).key_points(angles, 0 * angles)
        np.testing.assert_allclose(points.numpy(), (np.array(expected) - base.xpos) @ turn, atol=1e-12)


@pytest.mark.parametrize("robot", ["arm", "arm of servos that take gains", "quadruped", "op3"])
def test_servos_hold_the_pose_that_is_commanded(robot, tmp_path):
    """A robot whose targets stay at its home pose is still near it after a second, though actions command no gains."""
    if robot not in robot_files():
        text = robot_files()["arm"].read_text().replace("servo: sts3215", "servo: xm430-w350")
        text = text.replace("../arm/arm.xml", str(asset_path("arm/arm.xml"))).replace("name: arm", "name: other")
        robot = tmp_path / "other.yaml"
        robot.write_text(text)
    quiet = {"events": {}, "terminations": {}, "commands": {}, "rewards": {"alive": {}}, "success": {}}
    observations = {"joint_position": {}}
    task = find_task("reach", robot=str(robot), scene="stand", observations=observations, **quiet)
    env = make_env(task, num_envs=2, num_threads=1)
    state = env.reset()
    for _ in range(31):
        state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
        state = env.step(state)["next"].exclude("reward")
    home = torch.from_numpy(env.mdp.robot.home)
    assert (env.mdp.state.joint_position - home).abs().max() < 0.15


def test_a_scene_of_ones_own(package, tmp_path):
    """A function lays stairs and a door on the floor, a file a box: the robot stands there, and a log knows where."""
    box = tmp_path / "box.xml"
    box.write_text(
        '<mujoco><worldbody><geom name="box" type="box" size=".1 .1 .02" pos="0.5 0 .02"/></worldbody></mujoco>'
    )
    for scene, geoms in (("my_package.terms.stairs", 5), (str(box), 2)):
        env = make_env(find_task("walk", scene=scene, duration=0.16), num_envs=2)
        assert len(env.scene.ground) == geoms
        log = record_episodes(env, Hold(env.action_map))[0]
        assert not log.metadata.fallen
        assert log.metadata.mount == scene
    with pytest.raises(ValueError, match=r"my_package\.terms has no 'nothing'"):
        make_env(find_task("walk", scene="my_package.terms.nothing"))
    with pytest.raises(ValueError, match="unknown scene 'flor'; the nearest is 'floor'"):
        make_env(find_task("walk", scene="flor"))
