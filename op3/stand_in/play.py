"""Records a motion on a stand-in robot in the same way as the computer on a real robot.

Variable-gain PD in current at 125 Hz with zero-order hold (paper, section "Variable Gain PD"). A row holds the
sensors at its time and then the command issued at that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.common.settings import CONTROL_PERIOD
from op3.motions import Excitation, Motion
from op3.motions.motion import gain_rows, sample
from op3.motions.motion_checks import check_targets
from op3.rollout import Metadata, Rollout
from op3.stand_in.sensors import Sensors

FALL_ANGLE = np.deg2rad(45)
"""A trunk that rolls or pitches further has fallen [rad]."""

REST_TIME = 0.2
"""Time for which a robot stands still before a recording starts [s]."""

PATIENCE = 3.0
"""Longest wait for standstill [s], because a servo may oscillate around a reading forever."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrunkPush:
    """A push of the trunk: force [xyz] in N, in the world's axes, from `start` for `duration` [s]."""

    start: float
    force: tuple[float, float, float]
    duration: float = 0.08


@dataclass(frozen=True, eq=False)
class FloorExcitation(Excitation):
    """An excitation of a robot on the floor: its gain may be one per row, and the trunk may be pushed."""

    pushes: tuple[TrunkPush, ...] = ()


def play(
    robot: Any,
    motion: Motion,
    p_gain: ArrayLike = 6.0,
    d_gain: ArrayLike = 0.1,
    *,
    recording: str | None = None,
    settle: float = 1.5,
    still: bool = True,
    pushes: Sequence[TrunkPush] = (),
    metadata: dict[str, Any] | None = None,
    **placed: Any,
) -> Rollout:
    """Follow a motion with the PD of the robot's computer and record it.

    Args:
        robot: a `StandIn`.
        motion: targets; other joints stay in the pose "stand".
        p_gain: one number, [joint], or [row, joint] with one row per tick of 8 ms [A/rad].
        d_gain: one number or array, as for `p_gain` [A s/rad].
        recording: identifier of the recording.
        settle: time for which the first pose is held before the recording starts [s].
        still: whether the recording waits, after `settle`, until the joints are at rest.
        pushes: pushes of the trunk, in the order of their times since the recording began.
        metadata: further fields of the log's metadata, such as a pendulum's mass and length.
        placed: arguments of `StandIn.reset`.

    Returns:
        A rollout at 125 Hz, whose first rows are at rest if `still` is set.
    """
    if not 0 <= settle < np.inf:
        raise ValueError(f"settle must be at least 0 s and finite, got {settle}")
    targets = sample(motion, CONTROL_PERIOD, robot.joints, robot.rest)
    check_targets(motion.name, robot.joints, robot.limits, np.arange(len(targets)) * CONTROL_PERIOD, targets)
    given = {name: gain_rows(name, value, targets.shape) for name, value in (("p_gain", p_gain), ("d_gain", d_gain))}
    robot.reset(targets[0], by_hand=True, **placed)
    _settle(robot, targets[0], given["p_gain"][0], given["d_gain"][0], settle, still)
    begin, due, time, readings = robot.time, list(pushes), [], []
    for target, p, d in zip(targets, given["p_gain"], given["d_gain"], strict=True):
        time.append(robot.time - begin)
        if due and time[-1] >= due[0].start:
            robot.push(due[0].force, due.pop(0).duration)
        readings.append(_tick(robot, target, p, d))
    laws = [make.position_law for make in robot.makes]
    if robot.loops:
        gains = {"firmware_gain": np.tile([law.gain.si if law else 0.0 for law in laws], (len(targets), 1))}
    else:
        gains = given
    return _rollout(robot, motion, recording, np.array(time), readings, targets, gains, metadata or {})


def _settle(robot: Any, target: Array, p_gain: Array, d_gain: Array, settle: float, still: bool) -> None:
    """Hold the first pose for `settle` [s], and on until all joints have read zero speed for `REST_TIME`."""
    quiet = 0.0
    while robot.time < settle - 0.5 * CONTROL_PERIOD or (
        still and quiet < REST_TIME and robot.time < settle + PATIENCE
    ):
        sensors = _tick(robot, target, p_gain, d_gain)
        quiet = 0.0 if sensors.velocity.any() else quiet + CONTROL_PERIOD


def _tick(robot: Any, target: Array, p_gain: Array, d_gain: Array) -> Sensors:
    """Read, command, wait for the next tick."""
    sensors = robot.read_sensors()
    robot.send(target if robot.loops else p_gain * (target - sensors.position) - d_gain * sensors.velocity)
    robot.wait(CONTROL_PERIOD)
    return sensors


def _rollout(
    robot: Any,
    motion: Motion,
    recording: str | None,
    time: Array,
    readings: list[Sensors],
    targets: Array,
    gains: dict[str, Array],
    metadata: dict[str, Any],
) -> Rollout:
    names = ["position", "velocity", "voltage"]
    names += [name for name in ("current", "temperature") if all(getattr(make.counts, name) for make in robot.makes)]
    arrays: dict[Any, Array] = {
        ("joint", name): np.stack([getattr(reading, name) for reading in readings]) for name in names
    }
    fallen = None
    if readings[0].orientation is not None:
        for name in ("orientation", "angular_velocity", "linear_acceleration"):
            arrays["imu", name] = np.stack([getattr(reading, name) for reading in readings])
        fallen = robot.scene.floating and bool((np.abs(arrays["imu", "orientation"][:, :2]) > FALL_ANGLE).any())
    arrays["command", "position"] = targets
    arrays.update({("command", name): gain for name, gain in gains.items()})
    known: dict[str, Any] = dict(
        joints=robot.joints,
        robot="simulated",
        mount=robot.scene.mount,
        rate=1 / CONTROL_PERIOD,
        robot_file=robot.known.reference,
        battery=robot.known.supply,
        servo=robot.makes[0].name,
        motion=motion.name,
        recording=recording,
        seed=robot.seed,
        fallen=fallen,
        extra={"world": robot.world_id},
    )
    return Rollout.from_arrays({"time": time, **arrays}, Metadata(**{**known, **metadata}))
