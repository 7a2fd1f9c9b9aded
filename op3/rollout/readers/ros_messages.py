"""Messages of ROS bags, read by the rosbags package: numbers of joints and of the trunk by column."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import needed

COMMAND_WORDS = ("command", "cmd", "target", "goal", "desired", "reference")
_KINDS = {"position": "position", "velocity": "velocity", "effort": "load"}
ARRAYS = ("Float64MultiArray", "Float64")

Points = tuple[np.ndarray, np.ndarray]
"""Times of a trajectory's points from its start [point], and positions [point, joint]."""


def messages(path: Path) -> Iterator[tuple[str, str, float, Any]]:
    """Topic, type, bag time [s] and content of messages that may describe joints or the trunk."""
    highlevel, typesys = (needed(f"rosbags.{name}", "ros", path) for name in ("highlevel", "typesys"))
    store = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            for connection, time, raw in reader.messages():
                kind = connection.msgtype.rpartition("/")[2]
                if kind in ("JointState", "Imu", *ARRAYS) or "Trajectory" in kind or "Controller" in kind:
                    yield connection.topic, kind, time * 1e-9, reader.deserialize(raw, connection.msgtype)
    except Exception as error:  # a damaged bag may raise any error in the parsers of three formats
        problem = f"the bag cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        mcap = path.suffix == ".mcap" or any(path.glob("*.mcap"))
        command = "rosbag reindex" if path.suffix == ".bag" else "mcap recover" if mcap else "ros2 bag reindex"
        raise LogError(problem, f"copy all its files again, or repair it with `{command}`", source=path) from None


def samples(topic: str, kind: str, message: Any) -> Iterator[tuple[dict[str, float], Points | None]]:
    """Numbers in a message by column, and the points of a trajectory."""
    commanded = any(word in topic.lower() for word in COMMAND_WORDS)
    for part in ("goal", "trajectory"):
        message = getattr(message, part, message)
    joints = [
        name.strip("/").replace("/", "_") for name in getattr(message, "joint_names", getattr(message, "name", ()))
    ]
    if kind == "Imu":
        yield trunk(message), None
    elif kind == "JointState":
        for name, ours in [("position", "target")] if commanded else _KINDS.items():
            numbers = getattr(message, name)
            if len(numbers) == len(joints) > 0:
                yield {f"{joint}.{ours}": number for joint, number in zip(joints, numbers, strict=True)}, None
    elif kind in ARRAYS:
        if commanded and np.size(message.data):
            yield {f"#{number}": value for number, value in enumerate(np.atleast_1d(message.data))}, None
    elif hasattr(message, "joint_names"):
        columns = [f"{joint}.target" for joint in joints]
        wanted = (p for name in ("reference", "desired") if (p := getattr(message, name, None)) is not None)
        points = list(getattr(message, "points", []))
        path = [point for point in points or list(wanted)[:1] if len(point.positions) == len(columns) > 0]
        if path:
            goals = np.array([point.positions for point in path], dtype=float)
            times = np.array([seconds(point.time_from_start) if points else 0.0 for point in path])
            yield dict(zip(columns, map(float, goals[-1]), strict=True)), (times, goals) if points else None


def seconds(stamp: Any) -> float:
    """A ROS time in s."""
    return float(stamp.sec) + float(stamp.nanosec) * 1e-9


def trunk(message: Any) -> dict[str, float]:
    """Readings of an IMU message by column; angles only if its orientation is valid."""
    sensed, q = {"gyro": message.angular_velocity, "acc": message.linear_acceleration}, message.orientation
    readings = {f"imu.{sensor}_{axis}": getattr(vector, axis) for sensor, vector in sensed.items() for axis in "xyz"}
    if message.orientation_covariance[0] != -1 and 0.7 < math.hypot(q.w, q.x, q.y, q.z) < 1.4:
        angles = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX").tolist()
        readings |= zip(("imu.yaw", "imu.pitch", "imu.roll"), angles, strict=True)
    return readings
