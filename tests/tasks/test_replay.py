"""Open-loop replay of logs."""

import numpy as np
import pytest
import torch

from op3.robot import squat
from op3.robot.motions import Motion
from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.servo.effects import Coulomb, EncoderOffset, Motor, PositionServo
from op3.sim import load_model
from op3.tasks import Replay, bench_task, play, squat_task

SHORT = squat(duration=0.6)


@pytest.fixture(scope="module")
def logs() -> list[Rollout]:
    model = load_model("paper")
    return [play(squat_task(model, SHORT, mount=mount)) for mount in ("stand", "floor")]


def test_a_log_of_the_model_itself_is_reproduced(logs):
    """Replaying what the model made leaves only the error of the starting state, on the floor and in the stand."""
    for prediction in Replay(logs).run(load_model("paper")):
        error = prediction.channels[("joint", "position")][0] - torch.from_numpy(prediction.log.array("joint/position"))
        assert error.abs().max() < 2e-3
        assert not prediction.failed.any()


def test_every_candidate_has_its_own_parameters(logs):
    """Candidates differ, each as if it had been alone."""
    model = load_model("paper")
    constants = torch.tensor([0.005, 0.007], dtype=torch.float64)
    both = Replay(logs[1:]).run(model, {"torque_constant": constants}, 2)[0].channels[("joint", "current")]
    alone = Replay(logs[1:]).run(model.with_values({"torque_constant": 0.007}))[0].channels[("joint", "current")]
    assert not torch.allclose(both[0], both[1], atol=1e-3)
    torch.testing.assert_close(both[1], alone[0], atol=1e-12, rtol=0)


def test_replay_can_be_shortened(logs):
    """With a duration only the first rows are predicted, and less is simulated."""
    replay = Replay(logs, duration=0.2)
    assert replay.seconds < Replay(logs).seconds
    assert replay.run(load_model("paper"))[0].channels[("joint", "position")].shape[1] == 26


def test_foreign_joints_are_refused(logs):
    """A log of another robot is named."""
    stranger = Rollout(logs[0].data, logs[0].metadata.replace(joints=tuple(reversed(logs[0].joints))))
    with pytest.raises(LogError, match="joints"):
        Replay([stranger]).run(load_model("paper"))


def test_nothing_to_replay_is_refused():
    """An empty list is a mistake."""
    with pytest.raises(ValueError, match="at least one log"):
        Replay([])


def bench_model() -> RobotModel:
    effects = (PositionServo(), Motor(gear_ratio=1.0, drive="voltage"), Coulomb(), EncoderOffset())
    return RobotModel(effects).with_values(
        {
            "torque_constant": 0.5,
            "terminal_resistance": 4.0,
            "armature": 0.001,
            "coulomb_friction": 0.005,
            "encoder_offset": -0.1,
        }
    )


def swing() -> Motion:
    time = np.arange(1000) * 0.001
    return Motion(time, np.sin(4 * time)[:, None], ("servo",), "sine")


def test_the_bench_replays_position_servos_of_any_pendulum():
    """Composer and batch agree on the bench, for pendulums of different mass and length in one batch."""
    model, pendulums = bench_model(), [(0.2, 0.05), (0.45, 0.1)]
    logs = [play(bench_task(model, swing(), mass, length, firmware_gain=16.0)) for mass, length in pendulums]
    assert [log.metadata.mass for log in logs] == [0.2, 0.45]
    for log, prediction in zip(logs, Replay(logs, settle=0.0).run(model), strict=True):
        error = prediction.channels[("joint", "position")][0] - torch.from_numpy(log.array("joint/position"))
        assert error.abs().max() < 1e-3
    moved = np.ptp(logs[1].array("joint/position"))
    assert moved > 0.5


@pytest.mark.parametrize("effect", ["payload", "com_offset", "stribeck", "dte", "latency"])
def test_neutral_effects_leave_the_whole_robot_bit_identical(logs, effect):
    """On the floor too, an effect at its neutral value changes no bit of any channel."""
    full = load_model("paper")
    neutral = {p.name: p.neutral for p in full.effect(effect).parameters if p.neutral is not None}
    with_effect = Replay(logs[1:], duration=0.3).run(full.with_values(neutral))[0]
    without = Replay(logs[1:], duration=0.3).run(full.without(effect))[0]
    for key, values in without.channels.items():
        assert torch.equal(values, with_effect.channels[key]), key
