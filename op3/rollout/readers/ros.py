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
from scipy.spatial.transform import Rotation

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Recording, Stream, needed

_COMMAND_WORDS = ("command", "cmd", "target", "goal", "desired", "reference")
_KINDS = {"position": "position", "velocity": "velocity", "effort": "load"}
_TRAJECTORY_STEP = 0.01

Found = dict[tuple[str, str, tuple[str, ...]], list[list[float]]]
"""By topic, kind and columns: the header's time, the bag's time, and numbers."""


class Ros:
    """A bag of ROS 1 or 2."""

    title = "ROS 1 and ROS 2 bags (needs op3[ros])"
    paths = "<bag folder>, <name>.mcap, <name>.db3, <name>.bag"

    def claims(self, path: Path) -> bool:
        """By the ending, or the files in the folder."""
        return path.suffix in (".bag", ".mcap", ".db3") or (path.is_dir() and is_bag(path))

    def read(self, path: Path) -> list[Recording]:
        """One recording; joints are those with a state and a command."""
        found: Found = {}
        orders: dict[frozenset[str], tuple[str, ...]] = {}  # in which names came first
        for topic, kind, received, message in _messages(path):
            names = getattr(message, "name", getattr(message, "joint_names", ()))
            if len(set(names)) < len(names):
                twice = next(name for name in names if list(names).count(name) > 1)
                problem = f"{topic} names {twice} twice in one message"
                raise LogError(problem, "give every joint a name of its own where it is published", source=path)
            stamp = _seconds(message.header.stamp) if hasattr(message, "header") else 0.0
            for after, told in _samples(topic, kind, message, [columns for *_, columns in found]):
                columns = orders.setdefault(frozenset(told), tuple(told))
                clocks = [stamp + after if stamp > 0 else math.nan, received + after]
                row = [*clocks, *(float(told[name]) for name in columns)]
                found.setdefault((topic, kind, columns), []).append(row)
        streams = _streams({columns: np.array(rows) for columns, rows in _one_source(found, path).items()})
        if not streams:
            raise LogError("the bag holds no joint states", "record sensor_msgs/JointState", source=path)
        streams.sort(key=lambda s: (not any(n.endswith(".position") for n in s.columns), -len(s.time)))
        return [Recording(streams, dict(robot="real", mount="stand"))]


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag of ROS 2, whose `metadata.yaml` is its own."""
    about = folder / "metadata.yaml"
    if any(folder.glob("*.[dm][bc][3a]*")):
        return True
    return about.is_file() and b"rosbag2_bagfile_information" in about.read_bytes()[:200]


def _one_source(found: Found, path: Path) -> dict[tuple[str, ...], list[list[float]]]:
    """Rows by columns, of one topic each: relays are left out, two that differ and states without commands
    refused."""
    chosen: dict[tuple[str, ...], tuple[str, str, list[list[float]]]] = {}
    for (topic, kind, columns), rows in sorted(found.items(), key=lambda item: -len(item[1])):
        for others, (other, its, known) in chosen.items():
            if kind == its and topic != other and (shared := [name for name in columns if name in others]):
                said, known_as = (_content(*one, shared) for one in ((columns, rows), (others, known)))
                if 2 * len(said & known_as) <= len(rows):
                    problem = f"{topic} and {other} tell it, and differ"
                    remedy = "keep one of the topics, as `ros2 bag convert` or `mcap filter` do"
                    raise LogError(problem, remedy, source=path, column=shared[0])
        if columns not in chosen:
            chosen[columns] = topic, kind, rows
    names = {name for columns in chosen for name in columns}
    states, told = (
        [n.rpartition(".")[0] for n in sorted(names) if n.endswith(end)] for end in (".position", ".target")
    )
    if states and not told:
        problem = "no topic commands these joints"
        remedy = f"record the topic of the commands, whose name holds one of {', '.join(_COMMAND_WORDS)}"
        raise LogError(problem, remedy, source=path, column="command/position")
    alike = {} if {*states} & {*told} else {t: [s for s in states if _behind(s, t) or _behind(t, s)] for t in told}
    named = {f"{t}.target": f"{s[0]}.target" for t, s in alike.items() if len(s) == 1}
    return {tuple(named.get(name, name) for name in columns): rows for columns, (_, _, rows) in chosen.items()}


def _behind(name: str, other: str) -> bool:
    """Whether a name is the other behind a namespace."""
    return name.endswith(f"_{other}")


def _content(columns: tuple[str, ...], rows: list[list[float]], names: list[str]) -> set[tuple[float, ...]]:
    """What rows say in some columns and when, whenever they were received."""
    places = [2 + columns.index(name) for name in names]
    return {(0.0 if math.isnan(row[0]) else row[0], *(row[place] for place in places)) for row in rows}


def _messages(path: Path) -> Iterator[tuple[str, str, float, Any]]:
    """Topic, kind, time in the bag [s] and content of the messages that may be about joints or the trunk."""
    highlevel, typesys = (needed(f"rosbags.{name}", "ros", path) for name in ("highlevel", "typesys"))
    store = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            for connection, time, raw in reader.messages():
                kind = connection.msgtype.rpartition("/")[2]
                if kind in ("JointState", "Imu", "Float64MultiArray") or "Trajectory" in kind or "Controller" in kind:
                    yield connection.topic, kind, time * 1e-9, reader.deserialize(raw, connection.msgtype)
    except Exception as error:  # a damaged bag fails anywhere in the parsers of three formats
        problem = f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        mcap = path.suffix == ".mcap" or any(path.glob("*.mcap"))
        mends = "rosbag reindex" if path.suffix == ".bag" else "mcap recover" if mcap else "ros2 bag reindex"
        raise LogError(problem, f"copy all its files again, or repair it with `{mends}`", source=path) from None


def _samples(topic: str, kind: str, message: Any, seen: list[tuple[str, ...]]) -> Iterator[tuple[float, Any]]:
    """Numbers by column in a message, so long after its stamp [s]; arrays without names are of joints `seen` before."""
    commanded = any(word in topic.lower() for word in _COMMAND_WORDS)
    for part in ("goal", "trajectory"):
        message = getattr(message, part, message)
    if kind == "Imu":
        yield 0.0, _imu(message)
    elif kind == "JointState":
        for field, ours in [("position", "target")] if commanded else _KINDS.items():
            numbers = getattr(message, field)
            if len(numbers) == len(message.name) > 0:
                yield 0.0, {f"{_joint(name)}.{ours}": numbers[i] for i, name in enumerate(message.name)}
    elif kind == "Float64MultiArray":
        fits = (c for c in seen if len(c) == len(message.data) and all(name.endswith(".position") for name in c))
        if commanded and (names := next(fits, ())):
            targets = (name.replace(".position", ".target") for name in names)
            yield 0.0, dict(zip(targets, message.data, strict=True))
    elif hasattr(message, "joint_names"):
        columns = [f"{_joint(name)}.target" for name in message.joint_names]
        wanted = (p for name in ("reference", "desired") if (p := getattr(message, name, None)) is not None)
        points = list(getattr(message, "points", [])) or list(wanted)[:1]
        points = [point for point in points if len(point.positions) == len(columns) > 0]
        times = np.array([_seconds(point.time_from_start) for point in points if len(points) > 1] or [0.0])
        between = np.arange(times[0], min(times[-1], times[0] + 3600), _TRAJECTORY_STEP)  # as controllers do
        for after in [*between, times[-1]] if points else ():
            goals = (np.interp(after, times, way) for way in np.array([p.positions for p in points], dtype=float).T)
            yield float(after), dict(zip(columns, map(float, goals), strict=True))


def _joint(name: str) -> str:
    """A joint's name without its namespaces' strokes."""
    return name.strip("/").replace("/", "_")


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def _imu(message: Any) -> dict[str, float]:
    sensed, q = {"gyro": message.angular_velocity, "acc": message.linear_acceleration}, message.orientation
    told = {f"imu.{sensor}_{axis}": getattr(vector, axis) for sensor, vector in sensed.items() for axis in "xyz"}
    if message.orientation_covariance[0] != -1 and 0.7 < math.hypot(q.w, q.x, q.y, q.z) < 1.4:
        angles = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX").tolist()
        told |= zip(("imu.yaw", "imu.pitch", "imu.roll"), angles, strict=True)
    return told


def _streams(found: dict[tuple[str, ...], np.ndarray]) -> list[Stream]:
    """Streams on one clock: that of the headers where all have one that agrees with the bag's, else the bag's."""
    offsets = [float(np.median(table[:, 0] - table[:, 1])) for table in found.values()]
    headers = not any(abs(offset) >= 1.0 for offset in offsets)  # NaN: there is none
    streams = []
    for columns, table in found.items():
        time = np.where(np.isnan(table[:, 0]) | (not headers), table[:, 1], table[:, 0])
        keep = np.append(time[1:] != time[:-1], True)
        if columns[0].endswith(".target"):  # what a later trajectory replaced was never commanded
            keep = np.append(time[:-1] < np.minimum.accumulate(time[::-1])[::-1][1:], True)
        streams.append(Stream(time[keep], dict(zip(columns, table[keep, 2:].T, strict=True))))
    return [Stream(stream.time - min(s.time[0] for s in streams), stream.columns) for stream in streams]
