"""Comparing logs: errors, delays, clocks, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from rollout_logs import JOINTS, arrays, metadata, rollout

from op3.rollout import LogError, Rollout, compare

POSITION = "joint/position"


def wave(time: np.ndarray, joints=JOINTS, delay: float = 0.0, offset: float = 0.0, **more) -> Rollout:
    """Joints swinging at 1 Hz, the second a quarter of a period ahead."""
    phase = 2 * np.pi * (time[:, None] - delay) + np.arange(len(joints)) * np.pi / 2
    target = np.sign(np.sin(phase))
    rate = float(1 / np.median(np.diff(time)))
    values = {"time": time, "command/position": target, "joint/position": np.sin(phase) + offset, **more}
    return Rollout.from_arrays(values, metadata(joints=joints, rate=rate))


def test_a_log_equals_itself():
    """Every error and delay of a log against itself is exactly zero."""
    result = compare(rollout(), rollout())
    assert len(result) == 15  # 5 commands, 6 joint channels, 3 of the IMU
    for error in result.values():
        assert not error.rmse.any()
        assert not error.largest.any()
        assert not error.lag.any()


def test_an_offset_is_its_own_rmse_and_maximum():
    """A constant difference of 0.1 rad gives 0.1 rad everywhere, and no delay removes it all."""
    time = np.arange(500) / 125
    error = compare(wave(time), wave(time, offset=0.1))[POSITION]
    assert error.rmse == pytest.approx(0.1)
    assert error.largest == pytest.approx(0.1)


@pytest.mark.parametrize("delay", [0.0133, -0.041])
def test_a_pure_delay_is_found_and_removed(delay):
    """A delay between rows is recovered within 0.1 ms, and nearly nothing is left without it."""
    time = np.arange(500) / 125
    error = compare(wave(time), wave(time, delay=delay))[POSITION]
    # rmse of a 1 Hz sine delayed by d: 2 sin(pi d) / sqrt(2)
    assert error.rmse == pytest.approx(np.sqrt(2) * np.sin(np.pi * abs(delay)), rel=0.01)
    assert error.lag == pytest.approx(delay, abs=1e-4)
    assert (error.rmse_without_lag < 0.01 * error.rmse).all()


def test_different_clocks_are_compared_on_the_first():
    """The same motion sampled at another rate with jitter agrees up to the interpolation error."""
    a = np.arange(500) / 125
    b = np.cumsum(np.random.default_rng(3).uniform(0.003, 0.007, 700)) + 0.5
    # linear interpolation of a sine: (2 pi)^2 h^2 / 8 with h = 7 ms
    assert compare(wave(a), wave(b))[POSITION].largest.max() < (2 * np.pi * 0.007) ** 2 / 8


def test_commands_hold_between_rows():
    """A command sampled between rows is the last one sent, not a mean of two."""
    a, b = np.array([0.0, 0.005, 0.0101, 0.0149]), np.array([0.0, 0.01, 0.02])
    values = {"command/position": np.array([[0.0], [1.0], [1.0]]), "joint/position": np.zeros((3, 1)), "time": b}
    other = Rollout.from_arrays(values, metadata(joints=("knee",), rate=100))
    values = {"command/position": np.array([[0.0], [0.0], [1.0], [1.0]]), "joint/position": np.zeros((4, 1))}
    reference = Rollout.from_arrays({"time": a, **values}, metadata(joints=("knee",), rate=200))
    assert not compare(reference, other)["command/position"].largest.any()


def test_yaw_is_compared_around_the_circle():
    """3.13 rad and -3.13 rad are 0.023 rad apart."""
    time = np.arange(10) / 125
    turned = [{"imu/orientation": np.tile([0.0, 0.0, yaw], (10, 1))} for yaw in (3.13, -3.13)]
    error = compare(*(wave(time, **more) for more in turned))["imu/orientation"]
    assert error.largest[2] == pytest.approx(2 * np.pi - 6.26)


def test_yaw_is_interpolated_around_the_circle():
    """A trunk turning through pi, sampled by two clocks, shows no jump where the yaw wraps."""
    turning = []
    for time in (np.arange(100) / 125, np.arange(80) / 100 + 0.003):
        yaw = np.remainder(3.0 + time + np.pi, 2 * np.pi) - np.pi
        orientation = np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=-1)
        turning.append(wave(time, **{"imu/orientation": orientation}))
    assert compare(*turning)["imu/orientation"].largest[2] < 1e-12


def test_joints_are_matched_by_name():
    """The order of the joints in the two logs does not matter."""
    values = arrays()
    swapped = {k: v[:, ::-1] if isinstance(k, tuple) and k[0] in ("joint", "command") else v for k, v in values.items()}
    other = Rollout.from_arrays(swapped, metadata(joints=JOINTS[::-1]))
    assert all(not error.rmse.any() for error in compare(rollout(), other).values())


def test_batches_pool_their_episodes():
    """The error of a batch is the root mean square over its episodes."""
    values = arrays()
    key = ("joint", "position")
    shifted = {**values, key: values[key] + 0.2}
    a = Rollout.from_arrays({k: np.stack([v, v]) for k, v in values.items()}, metadata())
    b = Rollout.from_arrays(
        {k: np.stack([v, w]) for (k, v), w in zip(values.items(), shifted.values(), strict=True)}, metadata()
    )
    assert compare(a, b)[POSITION].rmse == pytest.approx(0.2 / np.sqrt(2))
    with pytest.raises(LogError, match="2 episodes and the other 1"):
        compare(a, rollout())


def test_what_cannot_be_compared_is_refused():
    """Other joints and times without overlap are named."""
    time = np.arange(10) / 125
    with pytest.raises(LogError, match="only one of the two logs has ankle, r_knee"):
        compare(wave(time), wave(time, joints=("l_knee", "ankle")))
    with pytest.raises(LogError, match=r"share no time: 0 to 0\.072 s and 5 to 5\.072 s"):
        compare(wave(time), wave(time + 5))
