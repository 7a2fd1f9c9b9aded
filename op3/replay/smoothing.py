"""From logs to states: angles, velocities and accelerations, smoothed on a grid of ticks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from op3.rollout.errors import LogError
from op3.rollout.robot_log import stand_tilt
from op3.rollout.rollout import Rollout
from op3.rollout.schema import COMMAND_CHANNELS

HALF_WIDTH = 3
"""Half width of the local cubic of the smoothed state in ticks of 8 ms; at other rates it covers the same time."""

TICK = 0.008
"""Usual time between rows [s]."""

SAME_RATE = 0.02
"""Relative difference up to which rows have the rate in the metadata."""

POSITION_NOISE = 0.0006
"""Standard deviation of a position reading, half a count of a 4096-step encoder and a little more [rad]."""

VELOCITY_NOISE = 0.05
"""Standard deviation of the velocity readings of an unknown servo [rad/s], mostly due to their delay."""

LEAST_VELOCITY_NOISE = 0.015
"""Standard deviation of any velocity reading, half a count of 0.024 rad/s and a little more [rad/s]."""

VELOCITY_LAG = 0.002
"""Expected delay of a velocity reading [s]: the time constant of the servo's filter."""

GYRO_LAG = 0.006
"""Delay of a gyro reading [s] behind a low-pass of 40 Hz (register map of the MPU-9250)."""

EXCITED = 2.0
"""A lag is estimated if accelerations exceed this multiple of what noise of the velocities causes."""

LONGEST_LAG = 0.02
"""Largest delay of velocity readings [s]."""

PREROLL = 4
"""Ticks before a window in which the joints are guided along the measurement."""

CHANNELS = (("joint", "position"), ("joint", "velocity"), ("joint", "current"))
"""Compared channels."""


@dataclass(frozen=True, eq=False)
class SmoothLog:
    """A log on a uniform grid of ticks, ``[tick, joint]``.

    Attributes:
        log: source log.
        period: time between ticks [s].
        time: of the ticks, from the log's first row on, give or take its jitter [s].
        position: smoothed angles [rad].
        velocity: smoothed velocities [rad/s].
        acceleration: smoothed accelerations [rad/s2].
        readings: raw channels by key, at the ticks.
        control: position [rad] and velocity [rad/s] as the controller read them, by row.
        rough: distance of the readings from the smoothed state, in standard deviations, ``[tick]``.
        inputs: inputs by signal name.
        tilt: roll and pitch of the stand [rad].
        sway: angular acceleration of the trunk in its axes [rad/s2] and its rate [rad/s3], from the gyro, ``[tick, 2,
            3]``; None without a gyro.
    """

    log: Rollout
    period: float
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    readings: Mapping[tuple[str, str], np.ndarray]
    control: tuple[np.ndarray, np.ndarray]
    rough: np.ndarray
    inputs: Mapping[str, np.ndarray]
    tilt: tuple[float, float]
    sway: np.ndarray | None


@dataclass(frozen=True, eq=False)
class VelocitySensing:
    """Delay and noise of velocity readings, by joint.

    Attributes:
        lag: delay [s], ``[joint]``.
        noise: standard deviation assumed in smoothing [rad/s], ``[joint]``.
    """

    lag: np.ndarray
    noise: np.ndarray


def half_width(period: float) -> int:
    """Ticks on each side of a smoothed state, see `HALF_WIDTH`."""
    return max(2, round(HALF_WIDTH * TICK / period))


def period_of(log: Rollout) -> float:
    """Time between rows [s]: that of the metadata if the rows agree with it, else that of the time stamps."""
    time = log.array("time")[:, 0]
    # the mean is robust against time stamps rounded to milliseconds, the median against missing rows
    mean, median = float(time[-1] - time[0]) / max(1, len(time) - 1), float(np.median(np.diff(time)))
    told = 1.0 / log.metadata.rate
    return told if min(abs(told - mean), abs(told - median)) <= SAME_RATE * told else median


def kernels(
    period: float, half: int = HALF_WIDTH, lag: float = VELOCITY_LAG, noise: float = VELOCITY_NOISE
) -> np.ndarray:
    """Weights ``[position | velocity | acceleration, reading of position | of velocity, lag]`` of a local cubic.

    Args:
        period: time between readings [s].
        half: number of readings on each side.
        lag: delay of velocity readings [s].
        noise: standard deviation of velocity readings [rad/s].
    """
    t = np.arange(-half, half + 1) * period
    value = np.stack([np.ones_like(t), t, t**2 / 2, t**3 / 6], 1) / POSITION_NOISE
    late = t - lag
    rate = np.stack([np.zeros_like(t), np.ones_like(t), late, late**2 / 2], 1) / noise
    inverse = np.linalg.pinv(np.concatenate([value, rate]))[:3]
    count = len(t)
    return np.stack([inverse[:, :count] / POSITION_NOISE, inverse[:, count:] / noise], 1)


def smooth_all(logs: Sequence[Rollout]) -> list[SmoothLog]:
    """Smooth logs of one robot; delay and noise of velocity readings are estimated from these logs.

    Velocity readings are several times more accurate than differences of positions, but delayed by an unknown filter of
    the servo; an error of 2 ms in the delay is an error of 0.1 rad/s while a joint accelerates.

    Raises:
        LogError: see `smooth`.
    """
    period = float(np.median([period_of(log) for log in logs]))
    rough = [smooth(log, period=period) for log in logs]
    if not all("joint/velocity" in log for log in logs):
        return rough
    sensing = velocity_sensing(rough)
    return [smooth(log, sensing, period) for log in logs]


def velocity_sensing(logs: Sequence[SmoothLog]) -> VelocitySensing:
    """Delay and noise of velocity readings, from the change of the angle between them.

    At constant acceleration a, readings with a delay d are lower than the mean velocity of a period by ``a d``. Within
    a period the acceleration changes, when a command takes effect. Neighbouring periods are therefore given separate
    shares, and d is the sum of the three. For a joint that hardly accelerates, the usual delay is assumed. The noise is
    estimated from third differences of the readings at low acceleration.
    """
    period, joints = logs[0].period, logs[0].position.shape[1]
    lag, noise = np.full(joints, VELOCITY_LAG), np.full(joints, LEAST_VELOCITY_NOISE)
    for j in range(joints):
        features, missed, jerky = [], [], []
        for log in logs:
            q, v = log.readings["joint", "position"][:, j], log.readings["joint", "velocity"][:, j]
            gained = np.diff(v) / period
            features.append(np.stack([gained[:-2], gained[1:-1], gained[2:]], 1))
            missed.append((np.diff(q) / period - 0.5 * (v[1:] + v[:-1]))[1:-1])
            jerky.append(np.abs(np.diff(v, 3)))
        x, y, third = np.concatenate(features), np.concatenate(missed), np.concatenate(jerky)
        moves = np.abs(x).max(1) > 0
        if moves.any():
            calm = moves & (np.abs(x).max(1) <= np.median(np.abs(x).max(1)[moves]))
            spread = 1.4826 * np.median(third[calm]) / np.sqrt(20.0)
            noise[j] = np.clip(spread, LEAST_VELOCITY_NOISE, VELOCITY_NOISE)
        if np.sqrt(np.square(x[:, 1]).mean()) > EXCITED * np.sqrt(2) * noise[j] / period:
            lag[j] = np.clip(np.linalg.lstsq(x, y, rcond=1e-6)[0].sum(), 0.0, LONGEST_LAG)
    return VelocitySensing(lag, noise)


def smooth(log: Rollout, sensing: VelocitySensing | None = None, period: float | None = None) -> SmoothLog:
    """Put a log on a uniform grid and smooth its state.

    Args:
        log: log with joint positions and commands.
        sensing: delay and noise of its velocity readings; None: the usual ones.
        period: period of the grid [s]; by default the log's row interval.

    Raises:
        LogError: if it has no positions or commands, or is too short.
    """
    time = log.array("time")[:, 0] - log.array("time")[0, 0]
    period = period or period_of(log)
    half = half_width(period)
    # the first row has the same jitter as others
    time = time - float(np.median(time - period * np.round(time / period)))
    grid = np.arange(int(time[-1] / period + 0.25) + 1) * period
    if len(grid) < 2 * half + 2:
        raise LogError("the log is too short", "record a few seconds", source=log.metadata.recording, column="time")
    if "joint/position" not in log or "command/position" not in log:
        raise LogError(
            "the log has no joint positions or no commands",
            "record <joint>.position and <joint>.target",
            source=log.metadata.recording,
        )
    # a current is held between commands, so the nearest reading is used instead of a mean
    nearest = np.clip(np.searchsorted(time, grid - 0.5 * period), 0, len(time) - 1)
    readings = {
        key: log.array(key)[nearest] if key[1] == "current" else _interpolated(log.array(key), time, grid)
        for key in CHANNELS
        if key in log
    }
    q = readings["joint", "position"]
    v = readings.get(("joint", "velocity"), np.gradient(q, period, axis=0))
    if sensing is None:
        usual = np.full(q.shape[1], VELOCITY_NOISE)
        sensing = VelocitySensing(np.full(q.shape[1], VELOCITY_LAG), usual)
    by_joint = zip(sensing.lag, sensing.noise, strict=True)
    weights = np.stack([kernels(period, half, lag, noise) for lag, noise in by_joint], -1)
    padded = [np.pad(x, ((half, half), (0, 0)), mode="edge") for x in (q, v)]
    lagged = np.stack(
        [np.stack([x[lag : lag + len(grid)] for lag in range(2 * half + 1)]) for x in padded]
    )  # [position | velocity, lag, tick, joint]
    state = np.einsum("oklj,kltj->otj", weights, lagged)
    held = np.clip(np.searchsorted(time, grid + 0.3 * period, side="right") - 1, 0, len(time) - 1)
    velocity = log.array("joint/velocity")[held] if "joint/velocity" in log else v
    control = (log.array("joint/position")[held], velocity)
    inputs = {signal: log.array(key)[held] for key, signal in COMMAND_CHANNELS.items() if key in log}
    if "bus_voltage" in inputs:
        inputs["bus_voltage"] = _interpolated(log.array("joint/voltage"), time, grid)
    tilt = stand_tilt(log) or (0.0, 0.0)
    sway = None
    if "imu/angular_velocity" in log:
        rate = _interpolated(log.array("imu/angular_velocity"), time - GYRO_LAG, grid)
        slopes = [np.asarray(savgol_filter(rate, 2 * half + 1, 3, n, period, axis=0)) for n in (1, 2)]
        sway = np.stack(slopes, 1)
    rough = _roughness(state, lagged, period, sensing)
    states = (state[0], state[1], state[2])
    return SmoothLog(log, period, grid, *states, readings, control, rough, inputs, tilt, sway)


def _roughness(state: np.ndarray, lagged: np.ndarray, period: float, sensing: VelocitySensing) -> np.ndarray:
    """Largest misfit of a joint's parabola through a smoothed state, in standard deviations of a reading, ``[tick]``.

    Args:
        state: position, velocity and acceleration, ``[order, tick, joint]``.
        lagged: readings around each tick, ``[position | velocity, lag, tick, joint]``.
        period: time between ticks [s].
        sensing: delay and noise of the velocities.
    """
    half = len(lagged[0]) // 2
    t = np.arange(-half, half + 1)[:, None, None] * period
    position, velocity, acceleration = state
    late = t - sensing.lag
    misfit = np.stack(
        [
            (lagged[0] - position - velocity * t - 0.5 * acceleration * t**2) / POSITION_NOISE,
            (lagged[1] - velocity - acceleration * late) / sensing.noise,
        ]
    )
    return np.sqrt(np.square(misfit).mean((0, 1)).max(1))


def _interpolated(values: np.ndarray, time: np.ndarray, grid: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(grid, time, column) for column in values.T], 1)
