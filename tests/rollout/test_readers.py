"""Every format of logs: what it holds arrives in SI on one clock, and damage is told in one sentence."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rollout_logs import SERVO_BENCH

from op3.rollout import LogError, read_episodes, read_log, read_logs
from op3.rollout.readers import readers
from op3.rollout.readers.reader import Recording, Stream

JOINTS = ("shoulder", "elbow")
ROWS, RATE = 250, 50.0
TIME = np.arange(ROWS) / RATE
FOREIGN = SERVO_BENCH.parent / "foreign"


def position(time: np.ndarray = TIME) -> np.ndarray:
    """Measured angles [time, joint] in rad: targets, 0.1 s late."""
    return target(time - 0.1)


def target(time: np.ndarray = TIME) -> np.ndarray:
    """Targets [time, joint] in rad."""
    return np.stack([0.5 * np.sin(2 * time), 0.4 * np.cos(1.7 * time)], axis=1)


def velocity(time: np.ndarray = TIME) -> np.ndarray:
    """Measured velocities [time, joint] in rad/s."""
    time = time - 0.1
    return np.stack([np.cos(2 * time), -0.68 * np.sin(1.7 * time)], axis=1)


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
                "episode_index": np.full(ROWS, number),
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
    kinds = store.types
    plugin = rosbag2.StoragePlugin.SQLITE3 if storage == "sqlite3" else rosbag2.StoragePlugin.MCAP
    path = folder / f"bag_{storage}"
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
        _fill(bag, store, kinds, lambda kind, message: store.serialize_cdr(message, kind))
    return path


def ros1(folder: Path) -> Path:
    """The same in a bag of ROS 1."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    path = folder / "run.bag"
    with rosbag1.Writer(path) as bag:
        _fill(bag, store, store.types, lambda kind, message: store.serialize_ros1(message, kind), sequence={"seq": 0})
    return path


def _fill(bag, store, kinds, serialise, sequence=None) -> None:
    vector, quaternion = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]
    state, imu = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
    trajectory, point = "trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/JointTrajectoryPoint"
    lines = {
        kind: bag.add_connection(topic, kind, typestore=store)
        for topic, kind in (("/joint_states", state), ("/arm/joint_trajectory", trajectory), ("/imu", imu))
    }
    duration = kinds["builtin_interfaces/msg/Duration"]
    empty = np.zeros(0)
    for t, q, w, goal in zip(TIME, position(), velocity(), target(), strict=True):
        at = stamp(sec=100 + int(t), nanosec=round((t % 1) * 1e9))
        head = header(**(sequence or {}), stamp=at, frame_id="")
        now = round((100 + t) * 1e9)
        message = kinds[state](header=head, name=list(JOINTS), position=q, velocity=w, effort=empty)
        bag.write(lines[state], now, serialise(state, message))
        points = [
            kinds[point](
                positions=goal,
                velocities=empty,
                accelerations=empty,
                effort=empty,
                time_from_start=duration(sec=0, nanosec=0),
            )
        ]
        none = header(**(sequence or {}), stamp=stamp(sec=0, nanosec=0), frame_id="")
        message = kinds[trajectory](header=none, joint_names=list(JOINTS), points=points)
        bag.write(lines[trajectory], now + 1000, serialise(trajectory, message))
        message = kinds[imu](
            header=head,
            orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(x=0.0, y=0.0, z=0.0),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(x=0.0, y=0.0, z=9.81),
            linear_acceleration_covariance=np.zeros(9),
        )
        bag.write(lines[imu], now, serialise(imu, message))


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
    fine = np.arange(2 * ROWS) / (2 * RATE)
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


@pytest.mark.parametrize("kind", FORMATS)
def test_a_format_arrives_in_si_on_one_clock(tmp_path, kind):
    """Positions and targets come with their joints, units and delay; nothing is found to be wrong."""
    log = read_log(FORMATS[kind](tmp_path))
    time = log.column("time") - (log.column("time")[0] if "ros" in kind else 0.0)
    assert log.joints == JOINTS
    assert log.rows > ROWS - 3
    assert log.findings == ()
    assert np.abs(log.array("joint/position") - position(time)).max() < 1e-4
    # a command between two rows counts from the nearer one: within half a row, 10 ms
    assert np.abs(log.array("command/position") - target(time)).max() < 0.011
    assert log.metadata.rate == pytest.approx(RATE, rel=0.01)
    if "joint/velocity" in log:
        assert np.abs(log.array("joint/velocity") - velocity(time)).max() < 1e-6


def test_the_delay_of_commands_is_kept(tmp_path):
    """Commands stamped 7 ms after the states are not shifted by a row."""
    log = read_log(sage(tmp_path))
    shifts = np.linspace(-0.03, 0.03, 61)
    errors = [np.abs(log.array("command/position") - target(log.column("time") + s)).mean() for s in shifts]
    assert abs(shifts[int(np.argmin(errors))]) < 0.008


def test_a_bag_carries_its_imu(tmp_path):
    """Specific force and orientation arrive with the joints."""
    log = read_log(ros2(tmp_path))
    assert log.array("imu/linear_acceleration")[5].tolist() == [0, 0, 9.81]
    assert np.abs(log.array("imu/orientation")).max() == 0


def test_a_single_mcap_file_is_a_bag(tmp_path):
    """The file in the bag's folder can be named itself."""
    file = next(ros2(tmp_path, "mcap").glob("*.mcap"))
    assert read_log(file).joints == JOINTS


def test_episodes_of_a_dataset(tmp_path):
    """Several episodes are several logs, and of equal length a batch."""
    path = lerobot(tmp_path, episodes=3)
    assert [log.rows for log in read_logs(path)] == [ROWS] * 3
    assert read_log(path).data.batch_size == (3, ROWS)


def test_normalised_units_come_with_the_calibration(tmp_path):
    """A joint's range tells what 100 means: (3072 - 1024) / 2 counts of 4096 a turn are a quarter turn."""
    path = lerobot(tmp_path)
    entry = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1024, "range_max": 3072}
    (path / "calibration.json").write_text(json.dumps(dict.fromkeys(JOINTS, entry)))
    scale = (np.pi / 2 / 100) / np.deg2rad(1)
    assert np.abs(read_log(path).array("joint/position") - scale * position()).max() < 1e-4


@pytest.mark.parametrize(("module", "make", "extra"), [("pyarrow", lerobot, "lerobot"), ("rosbags", ros2, "ros")])
def test_a_missing_package_is_named(tmp_path, monkeypatch, module, make, extra):
    """Without the optional package one sentence says what to install."""
    path = make(tmp_path)
    for name in (module, f"{module}.parquet", f"{module}.highlevel"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(LogError, match=rf"pip install 'op3\[{extra}\]'"):
        read_log(path)


def test_another_package_adds_a_format(tmp_path, monkeypatch):
    """A class named by an entry point of op3.readers reads its files."""

    class Lines:
        title, paths = "lines", "<name>.lines"

        def claims(self, path):
            return path.suffix == ".lines"

        def read(self, path):
            columns = {
                f"{j}.{k}": v[:, i]
                for k, v in (("position", position()), ("target", target()))
                for i, j in enumerate(JOINTS)
            }
            return [Recording([Stream(TIME, columns)], {"robot": "real", "mount": "stand"})]

    class Entry:
        name = "lines"

        def load(self):
            return Lines

    monkeypatch.setattr("op3.rollout.readers.entry_points", lambda group: [Entry()] if group == "op3.readers" else [])
    readers.cache_clear()
    (tmp_path / "a.lines").write_text("")
    assert read_log(tmp_path / "a.lines").joints == JOINTS
    readers.cache_clear()


@pytest.mark.skipif(not FOREIGN.is_dir(), reason=f"no foreign logs in {FOREIGN}")
def test_foreign_recordings_read_as_they_are():
    """The SO-101's eight excitations and the HLS servo: only the jaw's velocity is set aside."""
    for log in read_logs(FOREIGN / "so101"):
        assert log.joints == ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
        assert set(log.metadata.set_aside) <= {"Jaw.velocity"}
        assert log.metadata.rate == pytest.approx(49.85, rel=0.01)
    for log in read_logs(FOREIGN / "hls"):
        assert "joint/current" in log
        assert log.findings == ()


@functools.cache
def _sound(kind: str, folder: str) -> tuple[Path, tuple[Path, ...]]:
    path = FORMATS[kind](Path(folder))
    return path, tuple(sorted(file for file in Path(folder).rglob("*") if file.is_file()))


@pytest.mark.parametrize("kind", FORMATS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_is_read_or_refused(tmp_path_factory, kind, data):
    """A file with some bytes replaced, cut or added gives logs or a LogError of one line, and nothing else."""
    base = tmp_path_factory.getbasetemp() / f"sound {kind}"
    base.mkdir(exist_ok=True)
    path, files = _sound(kind, str(base))
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(base, folder, dirs_exist_ok=True)
    file = folder / data.draw(st.sampled_from(files)).relative_to(base)
    raw = file.read_bytes()
    start = data.draw(st.integers(0, len(raw)))
    end = min(len(raw), start + data.draw(st.sampled_from([0, 1, 4, 40, len(raw)])))
    file.write_bytes(raw[:start] + data.draw(st.binary(max_size=12)) + raw[end:])
    assert "\n" not in _refuse_or_read(folder / path.relative_to(base))
    shutil.rmtree(folder)


def _refuse_or_read(path: Path) -> str:
    """The sentence of the LogError, or nothing where the file is good."""
    try:
        read_episodes(path)
    except LogError as error:
        return str(error)
    return ""
