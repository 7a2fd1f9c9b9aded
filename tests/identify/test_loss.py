"""The paper's loss on numbers computed by hand."""

import numpy as np
import pytest
import torch

from op3.identify.loss import FAILED_RESIDUAL, TrajectoryLoss, position_error
from op3.replay import Prediction
from op3.rollout import LogError, Metadata, Rollout

JOINTS = ("a", "b")


def prediction(failed: bool = False, **offsets: float) -> Prediction:
    """Four rows of zeros as measured; simulated values are constant offsets by channel."""
    zeros = {
        ("joint", "position"): np.zeros((4, 2)),
        ("joint", "velocity"): np.zeros((4, 2)),
        ("joint", "current"): np.zeros((4, 2)),
        ("imu", "orientation"): np.zeros((4, 3)),
        ("imu", "angular_velocity"): np.zeros((4, 3)),
    }
    arrays = {"time": np.arange(4) * 0.008, ("command", "position"): np.zeros((4, 2)), **zeros}
    log = Rollout.from_arrays(arrays, Metadata(joints=JOINTS, robot="simulated", mount="floor", rate=125.0))
    simulated = {
        key: torch.full((1, *value.shape), offsets.get("_".join(key), 0.0), dtype=torch.float64)
        for key, value in zeros.items()
    }
    return Prediction(log, simulated, torch.tensor([failed]), 0.0)


@pytest.mark.parametrize(
    ("offsets", "loss"),
    [
        ({}, 0.0),
        ({"joint_position": 0.1}, 0.01),  # mean over rows and joints of 0.1^2
        ({"joint_current": 0.2, "joint_velocity": 0.3}, 0.13),  # 0.04 + 0.09
        ({"imu_orientation": 0.1}, 0.02),  # roll and pitch, not yaw: 2 * 0.1^2
        ({"imu_angular_velocity": 0.1}, 0.03),  # three rates: 3 * 0.1^2
    ],
)
def test_terms_of_eq_7(offsets, loss):
    """Squares of joints are averaged, those of the body are summed."""
    assert TrajectoryLoss()([prediction(**offsets)]).item() == pytest.approx(loss)


def test_residuals_square_to_the_loss():
    """Least squares and the loss minimise the same thing, also over several logs and with weights."""
    weights = {("joint", "position"): 4.0, ("imu", "orientation"): 0.5}
    loss = TrajectoryLoss(weights=weights)
    logs = [prediction(joint_position=0.1), prediction(imu_orientation=0.2)]
    assert loss.residuals(logs).square().sum().item() == pytest.approx(loss(logs).item())


def test_only_focusing_joints_count():
    """A joint outside the list may be wrong."""
    off = prediction()
    off.channels[("joint", "position")][:, :, 1] = 1.0
    assert TrajectoryLoss(("a",))([off]).item() == 0.0
    assert TrajectoryLoss(("b",))([off]).item() == pytest.approx(1.0)


def test_the_beginning_may_be_left_out():
    """Rows before `skip` count neither in the loss nor in the residuals; a log that is all beginning is refused."""
    late = prediction()
    late.channels[("joint", "position")][:, :2] = 1.0  # at 0 and 8 ms
    assert TrajectoryLoss()([late]).item() == pytest.approx(0.5)
    assert TrajectoryLoss(skip=0.016)([late]).item() == 0.0
    assert TrajectoryLoss(skip=0.008)([late]).item() == pytest.approx(1 / 3)
    assert TrajectoryLoss(skip=0.008).residuals([late]).square().sum().item() == pytest.approx(1 / 3)
    with pytest.raises(LogError, match="are omitted"):
        TrajectoryLoss(skip=1.0)([late])


def test_orientation_wraps():
    """Roll of 359 degrees is one degree from zero."""
    turned = prediction(imu_orientation=np.deg2rad(359))
    assert TrajectoryLoss()([turned]).item() == pytest.approx(2 * np.deg2rad(1) ** 2)


def test_a_failed_simulation_has_no_loss_but_a_large_residual():
    """Black-box search drops it, least squares turns away from it."""
    failed = prediction(failed=True)
    assert torch.isnan(TrajectoryLoss()([failed])).all()
    assert torch.isnan(position_error([failed])).all()
    assert TrajectoryLoss().residuals([failed]).square().sum() > FAILED_RESIDUAL**2


def test_an_unknown_channel_is_named_as_it_is_written():
    """As in the config, with a slash."""
    with pytest.raises(ValueError, match="weights: unknown channel joint/speed; use channels such as"):
        TrajectoryLoss(weights={("joint", "speed"): 1.0})


def test_a_log_without_comparable_channels_is_refused():
    """The message names the channels that would do."""
    with pytest.raises(LogError, match="imu/orientation"):
        TrajectoryLoss(weights={("imu", "orientation"): 1.0})([_without_imu()])


def _without_imu() -> Prediction:
    full = prediction()
    arrays = {key: full.log.array(key) for key in full.log.channels if "imu" not in key}
    return Prediction(Rollout.from_arrays(arrays, full.log.metadata), full.channels, full.failed, 0.0)
