"""ROS bags without ROS: ROS 2 (sqlite3 and MCAP, a folder or a single file) and ROS 1, by the rosbags package.

States come from `JointState`, commands from every message with joint names and positions (`JointTrajectory`,
controller states, `JointState` on a command topic, arrays in the order of the states), the trunk from `Imu`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Recording, Stream

_COMMAND_WORDS = ("command", "cmd", "target", "goal", "desired", "reference")
_KINDS = {"position": "position", "velocity": "velocity", "effort": "load"}
_TRAJECTORY_STEP = 0.01

Sample = tuple[float, Sequence[str], Sequence[float]]
"""Seconds after the message's stamp, columns, and their numbers."""


class Ros:
    """A bag of ROS 1 or 2."""

    title = "ROS 1 and ROS 2 bags (needs op3[ros])"
    paths = "<bag folder>, <name>.mcap, <name>.db3, <name>.bag"

    def claims(self, path: Path) -> bool:
        """By the ending, or the files in the folder."""
        return path.suffix in (".bag", ".mcap", ".db3") or (path.is_dir() and any(path.glob("*.[dm][bc][3a]*")))

    def read(self, path: Path) -> list[Recording]:
        """One recording; joints are those with a state and a command."""
        found: dict[tuple[str, ...], list[list[float]]] = {}  # by columns: header's time, bag's time, numbers
        for topic, kind, received, message in _messages(path):
            header = getattr(message, "header", None)
            stamp = _seconds(header.stamp) if header is not None else 0.0
            for after, columns, numbers in _samples(topic, kind, message, list(found)):
                clocks = [stamp + after if stamp > 0 else math.nan, received + after]
                found.setdefault(tuple(columns), []).append([*clocks, *map(float, numbers)])
        streams = _streams({columns: np.array(rows) for columns, rows in found.items()})
        if not streams:
            raise LogError("the bag holds no joint states", "record sensor_msgs/JointState", source=path)
        streams.sort(key=lambda s: (not any(n.endswith(".position") for n in s.columns), -len(s.time)))
        return [Recording(streams, {"robot": "real", "mount": "stand"})]


def _messages(path: Path) -> Iterator[tuple[str, str, float, Any]]:
    """Topic, kind, time in the bag [s] and content of the messages that may be about joints or the trunk."""
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
                if kind in ("JointState", "Imu", "Float64MultiArray") or "Trajectory" in kind or "Controller" in kind:
                    yield connection.topic, kind, time * 1e-9, reader.deserialize(raw, connection.msgtype)
    except LogError:
        raise
    except Exception as error:  # a damaged bag fails anywhere in the parsers of three formats
        problem = f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        raise LogError(problem, "copy it again, or repair it with `ros2 bag reindex`", source=path) from None


def _samples(topic: str, kind: str, message: Any, seen: Sequence[tuple[str, ...]]) -> Iterator[Sample]:
    """What a message says of joints or the trunk.

    Args:
        topic: It came by.
        kind: Name of its type.
        message: Its content.
        seen: Columns of the messages before, which tell what an array without names is of.
    """
    commanded = any(word in topic.lower() for word in _COMMAND_WORDS)
    message = getattr(message, "goal", message)
    message = getattr(message, "trajectory", message)
    if kind == "Imu":
        yield 0.0, *_imu(message)
    elif kind == "JointState":
        for field, ours in [("position", "target")] if commanded else _KINDS.items():
            numbers = getattr(message, field)
            if len(numbers) == len(message.name) > 0:
                yield 0.0, [f"{joint}.{ours}" for joint in message.name], numbers
    elif kind == "Float64MultiArray":
        states = (columns for columns in seen if all(c.endswith(".position") for c in columns))
        fits = next((columns for columns in states if len(columns) == len(message.data)), None)
        if fits and commanded:
            yield 0.0, [c.replace(".position", ".target") for c in fits], message.data
    elif hasattr(message, "joint_names"):
        columns = [f"{joint}.target" for joint in message.joint_names]
        wanted = next((p for n in ("reference", "desired") if (p := getattr(message, n, None)) is not None), None)
        points = list(getattr(message, "points", [])) or ([wanted] if wanted is not None else [])
        for after, numbers in _path([p for p in points if len(p.positions) == len(columns) > 0]):
            yield after, columns, numbers


def _path(points: list[Any]) -> Iterator[tuple[float, Sequence[float]]]:
    """Seconds after the start and positions along a trajectory, interpolated as controllers do."""
    if len(points) < 2:
        yield from ((0.0, point.positions) for point in points)
        return
    times = np.array([_seconds(p.time_from_start) for p in points])
    table = np.array([p.positions for p in points], dtype=float)
    for after in [*np.arange(times[0], min(times[-1], times[0] + 3600), _TRAJECTORY_STEP), times[-1]]:
        yield float(after), [float(np.interp(after, times, column)) for column in table.T]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def _imu(message: Any) -> tuple[list[str], list[float]]:
    rate, force, q = message.angular_velocity, message.linear_acceleration, message.orientation
    names = [f"imu.{sensor}_{axis}" for sensor in ("gyro", "acc") for axis in "xyz"]
    numbers = [rate.x, rate.y, rate.z, force.x, force.y, force.z]
    if message.orientation_covariance[0] != -1 and q.w**2 + q.x**2 + q.y**2 + q.z**2 > 0.5:
        names += ["imu.yaw", "imu.pitch", "imu.roll"]
        numbers += Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX").tolist()
    return names, numbers


def _streams(found: dict[tuple[str, ...], np.ndarray]) -> list[Stream]:
    """Streams on one clock: that of the headers where all have one that agrees with the bag's, else the bag's."""
    offsets = [float(np.median(table[:, 0] - table[:, 1])) for table in found.values()]
    headers = all(abs(offset) < 1.0 for offset in offsets if not math.isnan(offset))
    streams = []
    for columns, table in found.items():
        time = np.where(np.isnan(table[:, 0]) | (not headers), table[:, 1], table[:, 0])
        keep = np.append(time[1:] != time[:-1], True)
        if columns[0].endswith(".target"):  # what a later trajectory replaced was never commanded
            keep = np.append(time[:-1] < np.minimum.accumulate(time[::-1])[::-1][1:], True)
        streams.append(Stream(time[keep], dict(zip(columns, table[keep, 2:].T, strict=True))))
    start = min((float(stream.time[0]) for stream in streams), default=0.0)
    return [Stream(stream.time - start, stream.columns) for stream in streams]
