"""ROS bags without ROS: ROS 2 (sqlite3 and MCAP, a folder or a single file) and ROS 1, by the rosbags package.

States come from `JointState`, commands from every message with joint names and positions (`JointTrajectory`,
controller states, `JointState` on a command topic, arrays in the order of the states), the trunk from `Imu`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Recording, Stream

_COMMAND_WORDS = ("command", "cmd", "target", "goal", "desired", "reference")
_KINDS = {"position": "position", "velocity": "velocity", "effort": "load"}
_TRAJECTORY_STEP = 0.01

Samples = dict[tuple[str, ...], list[tuple[float, float, list[float]]]]
"""By the columns they fill: time of the header, of the bag, and the numbers."""


class Ros:
    """A bag of ROS 1 or 2."""

    title = "ROS 1 and ROS 2 bags (needs op3[ros])"
    paths = "<bag folder>, <name>.mcap, <name>.db3, <name>.bag"

    def claims(self, path: Path) -> bool:
        """By the ending, or the files in the folder."""
        return path.suffix in (".bag", ".mcap", ".db3") or (path.is_dir() and any(path.glob("*.[dm][bc][3a]*")))

    def read(self, path: Path) -> list[Recording]:
        """One recording; joints are those with a state and a command."""
        samples: Samples = {}
        for topic, kind, received, message in _messages(path):
            for stamp, after, columns, numbers in _samples(topic, kind, message, samples):
                header = stamp + after if stamp > 0 else math.nan
                samples.setdefault(columns, []).append((header, received + after, numbers))
        streams = _streams(samples)
        if not streams:
            remedy = "record sensor_msgs/JointState"
            raise LogError("the bag holds no joint states", remedy, source=path)
        streams.sort(key=lambda s: (not any(n.endswith(".position") for n in s.columns), -len(s.time)))
        return [Recording(streams, {"robot": "real", "mount": "stand"})]


def _messages(path: Path) -> Iterator[tuple[str, str, float, Any]]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        remedy = "install it with `pip install 'op3[ros]'`"
        raise LogError("bags are read with the package rosbags, which is missing", remedy, source=path) from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            for connection, time, raw in reader.messages():
                kind = connection.msgtype.rpartition("/")[2]
                if _wanted(kind):
                    yield connection.topic, kind, time * 1e-9, reader.deserialize(raw, connection.msgtype)
    except LogError:
        raise
    except Exception as error:  # a damaged bag fails anywhere in the parsers of three formats
        problem = f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        raise LogError(problem, "copy it again, or repair it with `ros2 bag reindex`", source=path) from None


def _wanted(kind: str) -> bool:
    return kind in ("JointState", "Imu", "Float64MultiArray") or "Trajectory" in kind or "Controller" in kind


def _samples(
    topic: str, kind: str, message: Any, seen: Samples
) -> Iterator[tuple[float, float, tuple[str, ...], list[float]]]:
    """Stamp, seconds after it, columns and numbers; none where a message is not about joints or the trunk."""
    header = getattr(message, "header", None)
    stamp = _seconds(header.stamp) if header is not None else 0.0
    message = getattr(message, "goal", message)
    message = getattr(message, "trajectory", message)
    if kind == "Imu":
        yield stamp, 0.0, *_imu(message)
    elif kind == "JointState":
        commanded = any(word in topic.lower() for word in _COMMAND_WORDS)
        for field, ours in _KINDS.items():
            numbers = [float(x) for x in getattr(message, field)]
            if numbers and len(numbers) == len(message.name) and not (commanded and field != "position"):
                ours = "target" if commanded else ours
                yield stamp, 0.0, tuple(f"{joint}.{ours}" for joint in message.name), numbers
    elif kind == "Float64MultiArray":
        states = [columns for columns in seen if all(c.endswith(".position") for c in columns)]
        fits = [columns for columns in states if len(columns) == len(message.data)]
        if fits and any(word in topic.lower() for word in _COMMAND_WORDS):
            columns = tuple(c.replace(".position", ".target") for c in fits[0])
            yield stamp, 0.0, columns, [float(x) for x in message.data]
    elif hasattr(message, "joint_names"):
        columns = tuple(f"{joint}.target" for joint in message.joint_names)
        wanted = next((p for n in ("reference", "desired") if (p := getattr(message, n, None)) is not None), None)
        points = list(getattr(message, "points", [])) or ([wanted] if wanted is not None else [])
        for after, numbers in _path(points, len(columns)):
            yield stamp, after, columns, numbers


def _path(points: list[Any], joints: int) -> Iterator[tuple[float, list[float]]]:
    """Seconds after the start and positions along a trajectory, interpolated as controllers do."""
    points = [p for p in points if len(p.positions) == joints]
    if len(points) < 2:
        yield from ((0.0, [float(x) for x in p.positions]) for p in points)
        return
    times = np.array([_seconds(p.time_from_start) for p in points])
    table = np.array([p.positions for p in points], dtype=float)
    for after in np.arange(times[0], min(times[-1], times[0] + 3600), _TRAJECTORY_STEP):
        yield float(after), [float(np.interp(after, times, column)) for column in table.T]
    yield float(times[-1]), [float(x) for x in table[-1]]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def _imu(message: Any) -> tuple[tuple[str, ...], list[float]]:
    rate, force, q = message.angular_velocity, message.linear_acceleration, message.orientation
    names = [f"imu.{sensor}_{axis}" for sensor in ("gyro", "acc") for axis in "xyz"]
    numbers = [rate.x, rate.y, rate.z, force.x, force.y, force.z]
    if message.orientation_covariance[0] != -1 and q.w**2 + q.x**2 + q.y**2 + q.z**2 > 0.5:
        names += ["imu.roll", "imu.pitch", "imu.yaw"]
        numbers.append(math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x**2 + q.y**2)))
        numbers.append(math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x)))))
        numbers.append(math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2)))
    return tuple(names), [float(x) for x in numbers]


def _streams(samples: Samples) -> list[Stream]:
    """Streams on one clock: that of the headers where all have one that agrees with the bag's, else the bag's."""
    rows = {columns: (np.array([s[:2] for s in found]), found) for columns, found in samples.items()}
    offsets = [float(np.median(clock[:, 0] - clock[:, 1])) for clock, _ in rows.values()]
    headers = all(abs(offset) < 1.0 for offset in offsets if not math.isnan(offset))
    streams = []
    for columns, (clock, found) in rows.items():
        time = np.where(np.isnan(clock[:, 0]) | (not headers), clock[:, 1], clock[:, 0])
        keep = np.append(time[1:] != time[:-1], True)
        if columns[0].endswith(".target"):  # what a later trajectory replaced was never commanded
            keep = np.append(time[:-1] < np.minimum.accumulate(time[::-1])[::-1][1:], True)
        table = np.array([numbers for _, _, numbers in found])
        streams.append(Stream(time[keep], {name: table[keep, i] for i, name in enumerate(columns)}))
    start = min((float(stream.time[0]) for stream in streams), default=0.0)
    return [Stream(stream.time - start, stream.columns) for stream in streams]
