"""The same motion of two joints in every format that is read, written as its own programs write it."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest

JOINTS = ("shoulder", "elbow")
ROWS, RATE = 250, 50.0
TIME = np.arange(ROWS) / RATE


def target(time: np.ndarray | None = None) -> np.ndarray:
    """Targets [time, joint] in rad, at `TIME` where no other times are asked for."""
    time = TIME if time is None else time
    return np.stack([0.5 * np.sin(2 * time), 0.4 * np.cos(1.7 * time)], axis=1)


def position(time: np.ndarray | None = None) -> np.ndarray:
    """Measured angles [time, joint] in rad: targets, 0.1 s late."""
    return target((TIME if time is None else time) - 0.1)


def velocity(time: np.ndarray | None = None) -> np.ndarray:
    """Measured velocities [time, joint] in rad/s."""
    late = (TIME if time is None else time) - 0.1
    return np.stack([np.cos(2 * late), -0.68 * np.sin(1.7 * late)], axis=1)


def sage(folder: Path) -> Path:
    """Commands 7 ms after the states, both in microseconds."""
    path = folder / "wave"
    path.mkdir()
    (path / "joint_list.txt").write_text("\n".join(JOINTS))
    (path / "event.csv").write_text("type,timestamp,event\nEVENT,0,MOTION_START\n")
    state = ["type,timestamp,positions,velocities,torques"]
    control = ["type,timestamp,positions"]
    for t, q, w in zip(TIME, position(), velocity(), strict=True):
        state.append(f'STATE_MOTOR,{t * 1e6},"{q.tolist()}","{w.tolist()}","[0.1, 0.2]"')
        control.append(f'CONTROL,{(t + 0.007) * 1e6},"{target(np.array([t + 0.007]))[0].tolist()}"')
    (path / "state_motor.csv").write_text("\n".join(state))
    (path / "control.csv").write_text("\n".join(control))
    return path


def lerobot(folder: Path, version: str = "v3.0", episodes: int = 1) -> Path:
    """A dataset in degrees, with the layout of version 3 or 2.1."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    path = folder / f"dataset_{version}"
    (path / "meta").mkdir(parents=True)
    names = [f"{joint}.pos" for joint in JOINTS]
    feature = {"dtype": "float32", "shape": [2], "names": names if version == "v3.0" else {"motors": names}}
    info = {"codebase_version": version, "fps": RATE, "features": {"action": feature, "observation.state": feature}}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    tables = [
        pyarrow.table(
            {
                "timestamp": TIME.astype(np.float32),
                "episode_index": np.full(len(TIME), number),
                "action": np.rad2deg(target()).tolist(),
                "observation.state": np.rad2deg(position()).tolist(),
            }
        )
        for number in range(episodes)
    ]
    chunk = path / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pyarrow.concat_tables(tables), chunk / "file-000.parquet")
    else:
        for number, table in enumerate(tables):
            parquet.write_table(table, chunk / f"episode_{number:06d}.parquet")
    return path


def ros2(folder: Path, storage: str = "sqlite3") -> Path:
    """A bag with states, trajectories of one point and an IMU."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.SQLITE3 if storage == "sqlite3" else rosbag2.StoragePlugin.MCAP
    path = folder / f"bag_{storage}"
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
        _fill(bag, store, store.serialize_cdr, {})
    return path


def ros1(folder: Path) -> Path:
    """The same in a bag of ROS 1."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(folder / "run.bag") as bag:
        _fill(bag, store, store.serialize_ros1, {"seq": 0})
    return folder / "run.bag"


def _fill(bag, store, serialise, sequence) -> None:
    state, imu = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
    trajectory, point = "trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/JointTrajectoryPoint"
    topics = {state: "/joint_states", trajectory: "/arm/joint_trajectory", imu: "/imu"}
    lines = {kind: bag.add_connection(topic, kind, typestore=store) for kind, topic in topics.items()}
    none, nine = np.zeros(0), np.zeros(9)

    def make(kind: str, **fields):
        return store.types[kind](**fields)

    def head(seconds: float):
        stamp = make("builtin_interfaces/msg/Time", sec=int(seconds), nanosec=round((seconds % 1) * 1e9))
        return make("std_msgs/msg/Header", **sequence, stamp=stamp, frame_id="")

    def vector(x: float, y: float, z: float):
        return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    begin = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    level = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    sensed = dict(orientation=level, angular_velocity=vector(0.0, 0.0, 0.0), linear_acceleration=vector(0.0, 0.0, 9.81))
    sensed |= {f"{name}_covariance": nine for name in sensed}
    for t, q, w, goal in zip(100 + TIME, position(), velocity(), target(), strict=True):
        path = [make(point, positions=goal, velocities=none, accelerations=none, effort=none, time_from_start=begin)]
        messages = {
            state: make(state, header=head(t), name=list(JOINTS), position=q, velocity=w, effort=none),
            trajectory: make(trajectory, header=head(0.0), joint_names=list(JOINTS), points=path),
            imu: make(imu, header=head(t), **sensed),
        }
        for kind, message in messages.items():
            bag.write(lines[kind], round(t * 1e9), serialise(message, kind))


def npz(folder: Path) -> Path:
    """Arrays by name."""
    path = folder / "run.npz"
    np.savez(path, time=TIME, q=position(), dq=velocity(), q_des=target(), joints=np.array(JOINTS))
    return path


def sysid(folder: Path) -> Path:
    """Control and state as `mujoco.sysid` saves them, at rates of their own."""
    timeseries = pytest.importorskip("mujoco.sysid._src.timeseries")
    kinds = timeseries.SignalType
    path = folder / "run"
    path.mkdir()
    state = {f"{joint}_qpos": (kinds.MjStateQPos, np.array([i])) for i, joint in enumerate(JOINTS)}
    state |= {f"{joint}_qvel": (kinds.MjStateQVel, np.array([2 + i])) for i, joint in enumerate(JOINTS)}
    control = {f"{joint}_ctrl": (kinds.MjCtrl, np.array([i])) for i, joint in enumerate(JOINTS)}
    timeseries.TimeSeries(TIME, np.hstack([position(), velocity()]), state).save_to_disk(path / "state.npz")
    fine = np.arange(2 * len(TIME)) / (2 * RATE)
    timeseries.TimeSeries(fine, target(fine), control).save_to_disk(path / "control.npz")
    return path


SIDE = "robot: real\nmount: stand\n"


def long_csv(folder: Path) -> Path:
    """A row per joint and time, in degrees and milliseconds."""
    path = folder / "run.csv"
    lines = ["t_ms,joint,pos_deg,target_deg"]
    for t, q, goal in zip(TIME, np.rad2deg(position()), np.rad2deg(target()), strict=True):
        lines += [f"{1e3 * t},{joint},{q[i]},{goal[i]}" for i, joint in enumerate(JOINTS)]
    path.write_text("\n".join(lines))
    path.with_suffix(".yaml").write_text(SIDE)
    return path


def mapped_csv(folder: Path) -> Path:
    """A wide CSV with names, units and signs of its own, and what they mean beside it."""
    path = folder / "run.csv"
    lines = ["stamp,sh,el,sh_cmd,el_cmd,comment"]
    table = np.column_stack([1e6 * TIME, np.rad2deg(position()), -target()])
    lines += [",".join(map(repr, row)) + ",0" for row in table.tolist()]
    path.write_text("\n".join(lines))
    path.with_suffix(".yaml").write_text(
        SIDE + "columns:\n  stamp: {name: time, unit: us}\n  comment: null\n"
        "  sh: {name: shoulder.position, unit: deg}\n  el: {name: elbow.position, unit: 0.017453292519943295}\n"
        "  sh_cmd: {name: shoulder.target, sign: -1}\n  el_cmd: {name: elbow.target, sign: -1}\n"
    )
    return path


FORMATS = {
    "sage": sage,
    "lerobot 3": lerobot,
    "lerobot 2.1": functools.partial(lerobot, version="v2.1"),
    "ros 2 sqlite3": ros2,
    "ros 2 mcap": functools.partial(ros2, storage="mcap"),
    "ros 1": ros1,
    "npz": npz,
    "mujoco.sysid": sysid,
    "long csv": long_csv,
    "mapped csv": mapped_csv,
}
