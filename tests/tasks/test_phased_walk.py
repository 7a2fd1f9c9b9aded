"""A walk without learning in the task's own actions."""

import dataclasses

import numpy as np
import pytest
import torch

from op3.policy import ActionMap
from op3.policy.leg_kinematics import leg_kinematics
from op3.policy.observation import observe
from op3.robot import CONTROLLED_JOINTS, JOINTS, asset_path, indices, mirror, pose
from op3.tasks import PhasedWalk, Stride

MAP = ActionMap.around_stand(0.8)
TILT = np.array([[0.1, -0.05, 0.2], [-0.02, 0.04, 0.0]])
RATES = np.array([[0.3, -0.2, 0.1], [-0.5, 0.1, 0.0]])
STRIDE = dataclasses.replace(
    Stride(),
    surge=0.004,
    bob=0.003,
    sway_third=0.1,
    stance_hip_roll=0.3,
    swing_hip_roll=-0.2,
    stance_ankle_roll=-0.3,
    stance_hip_pitch=0.1,
    swing_hip_pitch_rate=0.05,
    stance_ankle_pitch_rate=-0.03,
)


def whole(targets: np.ndarray) -> np.ndarray:
    """Angles [sim, joint] of all joints from those of the controlled ones."""
    position = np.tile(pose("stand"), (len(targets), 1))
    position[:, indices(CONTROLLED_JOINTS)] = targets
    return position


def test_half_a_cycle_later_the_mirrored_robot_does_the_mirrored_thing():
    """Left and right are treated alike: mirrored tilt and rates, half a cycle later, give mirrored targets."""
    walk, phase = PhasedWalk(STRIDE, MAP), np.array([0.13, 0.61])
    target, gain = walk.commands(phase, TILT, RATES)
    mirrored, same = walk.commands(phase + 0.5, TILT * [-1, 1, -1], RATES * [-1, 1, -1])
    np.testing.assert_allclose(whole(mirrored), mirror(whole(target)), atol=1e-12)
    np.testing.assert_allclose(same, gain[:, [5, 6, 7, 8, 9, 0, 1, 2, 3, 4]], atol=1e-12)


def test_a_foot_is_lifted_while_the_reward_wants_it_to_swing():
    """The left sole is `lift` higher than the right in the middle of its swing, and level with it between swings."""
    stride = Stride(hip_roll=0.0, bob=0.0, lean=0.0, lift=0.03)
    walk = PhasedWalk(stride, MAP)
    phase = np.array([0.15, 0.4, 0.65, 0.9])  # the middle of the left swing, both down, of the right swing, both down
    target, _ = walk.commands(phase, np.zeros((4, 3)), np.zeros((4, 3)))
    position = torch.from_numpy(whole(target))
    points, _ = leg_kinematics().key_points(position, torch.zeros_like(position))
    height = points.unflatten(1, (2, 3))[..., 2].mean(2)
    np.testing.assert_allclose((height[:, 0] - height[:, 1]).numpy(), [0.03, 0.0, -0.03, 0.0], atol=2e-3)


def test_standing_feet_move_backwards_by_twice_the_step():
    """Over its stance a foot goes from `step` ahead to `step` behind of its middle, so the body goes forwards."""
    walk = PhasedWalk(Stride(step=0.05, surge=0.0, lean=0.0), MAP)
    target, _ = walk.commands(np.array([0.3001, 0.65, 0.9999]), np.zeros((3, 3)), np.zeros((3, 3)))
    position = torch.from_numpy(whole(target))
    points, _ = leg_kinematics().key_points(position, torch.zeros_like(position))
    left = points[:, :3, 0].mean(1).numpy()
    np.testing.assert_allclose(left - left[1], [0.05, 0.0, -0.05], atol=1e-3)


def test_actions_are_a_function_of_the_observation():
    """`act` reads phase, tilt and rates from the latest observation and commands what `commands` says."""
    walk, phase = PhasedWalk(STRIDE, MAP), torch.tensor([0.2, 0.7], dtype=torch.float64)
    joints = torch.from_numpy(np.tile(pose("stand"), (2, 1)))
    tilt, rates = torch.from_numpy(TILT), torch.from_numpy(RATES)
    seen = observe(joints, torch.zeros(2, len(JOINTS)), tilt, rates, torch.zeros(2, 20), phase)
    action = walk.act(torch.cat([seen, torch.randn(2, 192, generator=torch.Generator().manual_seed(0))], 1))
    target, gain = walk.commands(phase.numpy(), TILT, RATES)
    given = MAP.targets(action)
    np.testing.assert_allclose(given[0].numpy(), target, atol=1e-9)
    np.testing.assert_allclose(given[1].numpy(), gain, atol=1e-9)


def test_every_robot_can_have_numbers_of_its_own():
    """With arrays, robot i does what a walk of its numbers alone does."""
    steps = np.array([0.03, 0.06])
    both = PhasedWalk(dataclasses.replace(STRIDE, step=steps), MAP).commands(np.array([0.4, 0.4]), TILT, RATES)[0]
    for number, step in enumerate(steps):
        alone = PhasedWalk(dataclasses.replace(STRIDE, step=step), MAP)
        one = alone.commands(np.array([0.4]), TILT[number : number + 1], RATES[number : number + 1])[0]
        np.testing.assert_allclose(both[number], one[0], atol=1e-12)


def test_numbers_are_kept_in_a_file(tmp_path):
    """What is saved is loaded; an unknown name is refused with the names that there are."""
    STRIDE.save(tmp_path / "walk.yaml")
    assert Stride.load(tmp_path / "walk.yaml") == STRIDE
    (tmp_path / "walk.yaml").write_text("stride: 3\n")
    with pytest.raises(ValueError, match="stride must be one of step, lift"):
        Stride.load(tmp_path / "walk.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must give numbers by name"),
        ("- 3", "must give numbers by name"),
        ("step: [", "not valid YAML"),
        ("step: true", "step must be one of"),
        ("lift: .nan", "lift must be one of"),
    ],
)
def test_broken_files_of_numbers_are_refused(text, message, tmp_path):
    """An empty or torn file, and values that are no finite numbers, end with the file's name and what is wrong."""
    (tmp_path / "walk.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"walk\.yaml: {message}"):
        Stride.load(tmp_path / "walk.yaml")
    with pytest.raises(FileNotFoundError, match="no such file; give the numbers of a walk"):
        Stride.load(tmp_path / "nowhere.yaml")


def test_the_walk_that_comes_with_the_project_walks():
    """Two robots walk 0.4 m in 3 s without falling, on targets and gains that a policy may command."""
    from op3.envs import make_env
    from op3.tasks import find_task

    env = make_env(find_task("walk", duration=3.0), "paper", 2, seed=5, action_map=MAP)
    walk = PhasedWalk(Stride.load(asset_path("gaits/walk.yaml")), MAP)
    state = env.reset()
    start = env.snapshot().tip
    for _ in range(env.task.steps):
        state["action"] = walk.act(state["observation"])
        after = env.step(state)["next"]
        assert not after["terminated"].any()
        state = after.exclude("reward")
    assert float((env.snapshot().tip - start).min()) > 0.4
