"""Policies on the robot: the observation of training, every fourth tick, and the same actions from the log."""

import dataclasses

import numpy as np
import pytest
import torch
from deploy_rig import make_rig
from policies import hold_policy

from op3.deploy.emulator import Faults
from op3.deploy.exit_codes import ExitCode
from op3.deploy.phases import GainRamp
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner, replay_policy
from op3.envs import make_env
from op3.rollout import Rollout

ORDER = ("joint_position", "joint_velocity", "orientation", "angular_velocity")


@pytest.mark.parametrize("task", ["balance", "walk"])
def test_observation_is_that_of_training(task):
    """Fed with the sensors' readings of a training environment, the robot's observation is that environment's."""
    env = make_env(task, num_envs=1, seed=3, num_threads=1)
    runner = PolicyRunner(hold_policy(task, feedback=0.3), robot="op3")
    state = env.reset()
    worst = 0.0
    for step in range(25):
        now = {name: value[0].numpy() for name, value in env.mdp.readings.items()}
        observation = runner.observe(*(now[name] for name in ORDER), step)
        worst = max(worst, float(np.abs(observation - state["observation"][0].double().numpy()).max()))
        # the environment keeps single precision, of the phase before its sine is taken; nothing else may differ
        same = observation.astype(np.float32) == state["observation"][0].numpy()
        assert same.all() or task == "walk"
        state["action"] = torch.from_numpy(runner.act(observation))[None].float()
        runner.previous = state["action"][0].double().numpy()
        state = env.step(state)["next"].exclude("reward")
    assert worst < 1e-6


def test_yaw_counts_from_the_beginning():
    """The heading at the first step is zero, and passing half a turn does not jump."""
    runner = PolicyRunner(hold_policy(), robot="op3")
    rest = (np.zeros(20), np.zeros(20))
    first = runner.observe(*rest, [0.0, 0.0, 3.10], np.zeros(3), 0)
    second = runner.observe(*rest, [0.0, 0.0, -3.10], np.zeros(3), 1)
    at = slice(18 + 18 + 20, 18 + 18 + 20 + 3)
    assert np.allclose(first[at], 0)
    assert np.allclose(second[at], [0, 0, 2 * np.pi - 6.2])


def run_policy(tmp_path, bundle, duration=1.0, **options):
    rig = make_rig(tmp_path, **options)
    runner = PolicyRunner(bundle, robot="op3")
    outcome = rig.run([GainRamp(), FollowPolicy(runner, duration)], folder=tmp_path / "logs")
    return rig, outcome


@pytest.mark.parametrize("faults", [0.0, 0.02])
def test_replay_gives_the_same_actions(tmp_path, faults):
    """From the log alone, with lost readings or without, the policy gives the actions that were taken."""
    bundle = hold_policy(feedback=0.2)
    _, outcome = run_policy(tmp_path, bundle, 2.0, faults=Faults(lost=faults))
    assert outcome.code == ExitCode.OK
    log = Rollout.load(tmp_path / "logs" / "run")
    result = replay_policy(log, PolicyRunner(bundle, robot="op3"))
    assert result.ok
    assert result.steps in (62, 63)
    assert result.action_difference < 1e-12
    assert result.observation_difference < 1e-12


def test_replay_tells_another_policy(tmp_path):
    """Another policy's actions are told from step 0 on."""
    run_policy(tmp_path, hold_policy(feedback=0.2))
    log = Rollout.load(tmp_path / "logs" / "run")
    result = replay_policy(log, PolicyRunner(hold_policy(feedback=0.2, seed=1), robot="op3"))
    assert not result.ok
    assert result.first == 0
    assert "different actions from step 0 on" in str(result)
    with pytest.raises(ValueError, match="observations have 124 numbers, but those of this policy have 256"):
        replay_policy(log, PolicyRunner(hold_policy("walk"), robot="op3"))


def test_replay_refuses_what_it_cannot_replay(tmp_path):
    """A log without a policy is refused with the remedy."""
    rig = make_rig(tmp_path)
    log = rig.run(duration=0.2, folder=tmp_path / "logs").logs["run"]
    with pytest.raises(ValueError, match="no policy/action"):
        replay_policy(log, PolicyRunner(hold_policy(), robot="op3"))


def test_a_policy_that_breaks_is_refused(tmp_path):
    """An action that is not finite ends the run, damped, with its exit code; no current of it is sent."""
    bundle = hold_policy()
    steps = []

    def broken(observation):
        steps.append(observation)
        return np.full(20, np.nan) if len(steps) > 5 else np.zeros(20)

    bundle.act = broken
    rig, outcome = run_policy(tmp_path, bundle)
    assert outcome.code == ExitCode.NON_FINITE
    assert "the policy's action is not finite" in outcome.reason
    assert outcome.release.ok
    assert max(abs(v) for _, values in rig.written("goal_current") for v in values.values()) < 300


def test_a_policy_for_another_loop_is_refused():
    """A bundle with other rates, another layout, or a phase without a known cycle names the field."""
    bundle = hold_policy()
    bundle.manifest = dataclasses.replace(bundle.manifest, policy_rate=62.5)
    with pytest.raises(ValueError, match=r"field policy_rate of its manifest is 62\.5 Hz, expected 31\.25 Hz"):
        PolicyRunner(bundle, robot="op3")
    bundle.manifest = dataclasses.replace(hold_policy().manifest, layout={"temperature": 20}, observations={})
    with pytest.raises(ValueError, match="field layout"):
        PolicyRunner(bundle, robot="op3")
    bundle.manifest = dataclasses.replace(hold_policy("walk").manifest, task="hop")
    with pytest.raises(ValueError, match="give cycle"):
        PolicyRunner(bundle, robot="op3")
    bundle = hold_policy()
    stiff = dataclasses.replace(bundle.manifest.action_map, gain_high=50.0)
    bundle.manifest = dataclasses.replace(bundle.manifest, action_map=stiff)
    with pytest.raises(ValueError, match=r"field gain_high of the policy's manifest is 50 A/rad.*limits\.p_gain"):
        PolicyRunner(bundle, robot="op3")
    PolicyRunner(bundle, p_gain=50.0, robot="op3")
    with pytest.raises(ValueError, match="was trained for the robot op3, but this one is arm; use a policy for arm"):
        PolicyRunner(hold_policy(), robot="arm")
