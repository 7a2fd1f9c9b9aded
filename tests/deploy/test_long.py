"""Long runs with the losses of the field: nobody notices."""

import numpy as np
import pytest
from deploy_rig import make_rig

from op3.deploy import FollowPolicy, Plan, PolicyRunner, connect, run
from op3.deploy.emulator import Faults
from op3.deploy.exit_codes import ExitCode
from op3.deploy.phases import GainRamp, HoldPose
from op3.policy import PolicyBundle
from op3.robot import asset_path, pose


@pytest.mark.slow
def test_an_hour_with_lost_reads(tmp_path):
    """Sixty virtual minutes of holding with 0.26 % lost reads: no exit, no jump in torque."""
    rig = make_rig(tmp_path, faults=Faults(lost=0.0026), record=False)
    last, jump, missed, ticks = None, 0, 0, 0

    class Watched(HoldPose):
        def command(self, elapsed, state):
            nonlocal last, jump, missed, ticks
            goals = np.array(rig.register("goal_current"))
            if last is not None and elapsed > 125:
                jump = max(jump, int(np.abs(goals - last).max()))
            last, ticks = goals, ticks + 1
            missed += int((~state.answered).sum())
            return super().command(elapsed, state)

    outcome = rig.run([GainRamp(), Watched(pose("stand", "op3"), duration=3600.0)])
    assert outcome.code == ExitCode.OK, outcome.reason
    assert outcome.release.ok
    # one lost part of a fast answer hides those behind it: on average ten more
    assert 0.5 * 0.0026 < missed / (20 * ticks) < 20 * 0.0026
    # holding takes about 62 counts; noise of the readings alone makes goals differ by a few counts from tick to tick
    assert jump <= 12
    assert outcome.timing.misses < 0.05 * outcome.timing.ticks
    assert rig.robot.clock.now() > 3600


@pytest.mark.slow
def test_ten_minutes_of_balancing_with_lost_reads(tmp_path):
    """The shipped policy on its feet: no exit, no lean that grows, and goals that jump no more where answers are lost.

    Ten minutes are ten times what the limiter averages currents over; a policy whose knees take more than a servo may
    carry for ever has sunk down and fallen by then.
    """
    policy = PolicyBundle.load(asset_path("policies/balance/manifest.yaml").parent)
    robot = connect("emulated", mount="floor", model="paper", faults=Faults(lost=0.0026), robot="op3")
    runner = PolicyRunner(policy, robot="op3")
    outcome = run(robot, lambda: FollowPolicy(runner, 600.0), Plan(folder=tmp_path), report=lambda line: None)
    assert outcome.code == ExitCode.OK, outcome.reason
    log = outcome.logs["run"]
    tilt = np.abs(log.array("imu/orientation")[:, :2])
    assert tilt.max() < np.radians(10)
    assert tilt[-7500:].mean() < tilt[:7500].mean() + np.radians(1)
    goals, answered = log.array("raw/goal_current").astype(float), log.array("raw/answered").astype(bool)
    jump, lossy = np.abs(np.diff(goals, axis=0)).max(1), ~answered[1:].all(1)
    assert 0.01 < lossy.mean() < 0.1
    near = np.convolve(lossy, np.ones(4), "full")[: len(lossy)] > 0  # the tick of a loss and the three after it
    settled = np.arange(len(jump)) > 500
    assert jump[near & settled].max() <= jump[~near & settled].max() + 3
