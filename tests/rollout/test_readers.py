"""Every format of logs: what it holds arrives in SI on one clock, and damage is told in one sentence."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import foreign_logs
import numpy as np
import pytest
from foreign_logs import (
    FORMATS,
    JOINTS,
    RATE,
    ROWS,
    TIME,
    lerobot,
    long_csv,
    npz,
    position,
    ros2,
    sage,
    target,
    velocity,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rollout_logs import SERVO_BENCH, refusal, rollout

from op3.robot import load_robot
from op3.rollout import LogError, read_episodes, read_log, read_logs
from op3.rollout.guess import guess, guess_all
from op3.rollout.health import examine
from op3.rollout.importing import side_path
from op3.rollout.proposal import as_yaml, propose
from op3.rollout.readers import readers
from op3.rollout.readers.reader import Recording, Stream
from op3.rollout.readers.ros_messages import trunk

FOREIGN = SERVO_BENCH.parent / "foreign"


@pytest.mark.parametrize("kind", FORMATS)
def test_a_format_arrives_in_si_on_one_clock(tmp_path, kind):
    """Positions and targets come with their joints, units and delay; nothing is found to be wrong."""
    log = read_log(FORMATS[kind](tmp_path))
    time = log.column("time") - (log.column("time")[0] if "ros" in kind else 0.0)
    assert log.joints == JOINTS
    assert log.rows > ROWS - 3
    assert [one.check for one in log.findings] == ["unit of LeRobot"] * ("lerobot" in kind)
    assert np.abs(log.array("joint/position") - position(time)).max() < 1e-4
    # a command between two rows counts from the nearer one: within half a row, 10 ms
    assert np.abs(log.array("command/position") - target(time)).max() < 0.011
    assert log.metadata.rate == pytest.approx(RATE, rel=0.01)
    if "joint/velocity" in log:
        assert np.abs(log.array("joint/velocity") - velocity(time)).max() < 1e-6


@pytest.mark.parametrize("file", ["control.csv", "state_motor.csv", "joint_list.txt"])
def test_a_file_that_a_pair_lacks_is_named(tmp_path, file):
    """A folder with the two others is a pair still, and no folder of tables."""
    path = sage(tmp_path)
    next(path.glob(f"{file}*")).unlink()
    assert re.search(rf"{file}: the file cannot be read", refusal(path))


def test_the_delay_of_commands_is_kept(tmp_path):
    """Commands stamped 7 ms after the states are not shifted by a row."""
    log = read_log(sage(tmp_path))
    shifts = np.linspace(-0.03, 0.03, 61)
    errors = [np.abs(log.array("command/position") - target(log.column("time") + s)).mean() for s in shifts]
    assert abs(shifts[int(np.argmin(errors))]) < 0.008


def test_a_bag_carries_its_imu(tmp_path):
    """Specific force and orientation arrive with the joints, also from the bag's file alone."""
    log = read_log(next(ros2(tmp_path, "mcap").glob("*.mcap")))
    assert log.array("imu/linear_acceleration")[5].tolist() == [0, 0, 9.81]
    assert np.abs(log.array("imu/orientation")).max() == 0


def test_what_the_numbers_of_a_dataset_are(tmp_path, monkeypatch):
    """Degrees are known by an encoder's steps, and by the word of the user; else they may be normalised ones."""
    path = lerobot(tmp_path)
    assert "could be normalised values" in read_log(path).findings[0].problem
    side_path(path).write_text(as_yaml(*propose(path)))
    assert "# doubtful: numbers of up to 28.65 without a unit" in side_path(path).read_text()
    assert [one.check for one in read_log(path).findings] == ["unit of LeRobot"]
    side_path(path).write_text(side_path(path).read_text().replace("\n  # ", "\n  "))
    assert read_log(path).findings == ()
    step = 2 * np.pi / 4096
    rests = np.where(np.arange(ROWS)[:, None] < ROWS / 2, position()[ROWS // 2], position())
    monkeypatch.setattr(foreign_logs, "position", lambda: np.round(rests / step) * step)
    assert "unit of LeRobot" not in {one.check for one in read_log(lerobot(tmp_path / "stepped")).findings}


def test_a_gripper_without_its_calibration_is_told(tmp_path, monkeypatch):
    """LeRobot's run from 0 to 100, whatever the other joints are in."""
    monkeypatch.setattr(foreign_logs, "JOINTS", ("gripper", "elbow"))
    for name, late in (("target", 0.0), ("position", 0.03)):
        opened = np.deg2rad(50 + 48 * np.sin(3 * (foreign_logs.TIME - late)))
        values = np.stack([opened, 0.5 * np.sin(2 * (foreign_logs.TIME - late))], axis=1)
        monkeypatch.setattr(foreign_logs, name, lambda *_, values=values: values)
    told = [one.problem for one in read_log(lerobot(tmp_path)).findings if one.check == "unit of LeRobot"]
    assert told[0].startswith("gripper values from")


def test_a_log_of_some_joints_of_a_robot(tmp_path):
    """What is proposed names these, and is read."""
    path = rollout().to_csv(tmp_path / "run.csv")
    path.with_suffix(".yaml").unlink()
    about, columns, *_ = propose(path, "op3")
    assert about["joints"] == ["l_knee", "r_knee"]
    path.with_suffix(".yaml").write_text(as_yaml(about | {"rate": 125.0}, columns))
    assert read_log(path).joints == ("l_knee", "r_knee")


def test_episodes_of_a_dataset(tmp_path):
    """Several episodes are several logs, and none is read for all of them."""
    path = lerobot(tmp_path, episodes=3)
    assert [log.rows for log in read_logs(path)] == [ROWS] * 3
    with pytest.raises(LogError, match="it contains 3 recordings; read them all with read_logs"):
        read_log(path)


RANGES = {"left_shoulder": (1024, 3072), "elbow": (760, 3300), "wrist": (0, 4095), "left_gripper": (2030, 3500)}
"""First and last count of joints by LeRobot's calibration."""


def counted(folder: Path, unit: str, size: float, ranges: dict[str, tuple[int, int]] = RANGES) -> Path:
    """A dataset of joints of whole counts that move by so many radians, told as LeRobot tells them."""
    path = lerobot(folder)
    names = [f"{joint}.pos" for joint in ranges]
    rewrite(path / "meta" / "info.json", renamed(action=names, observation_state=names))
    table = {}
    for feature, late in (("action", 0.0), ("observation.state", 0.1)):
        columns = []
        for number, (joint, (first, last)) in enumerate(ranges.items()):
            angle = (1.0 if feature == "action" else 0.97) * size * np.sin((1 + 0.2 * number) * (TIME - late) + number)
            counts = np.round((first + last) / 2 + angle * 4096 / (2 * np.pi))
            if "gripper" in joint or joint == "tool":
                columns.append((counts - first) / (last - first) * 100)
            elif unit == "deg":
                columns.append((counts - (first + last) / 2) * 360 / 4095)
            else:
                columns.append((counts - first) / (last - first) * 200 - 100)
        table[feature] = np.float32(columns).T.tolist()
    rewrite(next(path.rglob("*.parquet")), lambda content: content.update(table))
    entries = {joint: {"range_min": first, "range_max": last} for joint, (first, last) in ranges.items()}
    (path / "calibration.json").write_text(json.dumps(entries))
    return path


@pytest.mark.parametrize("size", [0.1, 0.8])
@pytest.mark.parametrize("unit", ["deg", "normalised"])
@pytest.mark.parametrize("hand", ["left_gripper", "tool"])
def test_the_encoder_of_all_joints_says_the_unit_of_a_dataset(tmp_path, unit, size, hand):
    """Small and large motions, in degrees or in parts of the calibrated ranges; a gripper's are percent of its range,
    whatever it is called."""
    ranges = {hand if joint == "left_gripper" else joint: span for joint, span in RANGES.items()}
    log = read_log(counted(tmp_path, unit, size, ranges))
    assert log.joints == tuple(ranges)
    assert np.ptp(log.array("joint/position"), axis=0) == pytest.approx(2 * size, rel=0.05)
    assert log.findings == ()


def test_normalised_numbers_without_their_ranges_are_refused(tmp_path):
    """Steps of another size in every joint are no degrees; the YAML of an import leaves the decision to a calibration
    that is copied later."""
    path = counted(tmp_path, "normalised", 0.08)
    calibration = (path / "calibration.json").read_text()
    (path / "calibration.json").unlink()
    side_path(path).write_text(as_yaml(*propose(path)))
    with pytest.raises(LogError, match="they are normalised to the joints' ranges, which are unknown; copy"):
        read_log(path)
    (path / "calibration.json").write_text(calibration)
    assert np.ptp(read_log(path).array("joint/position"), axis=0) == pytest.approx(0.16, rel=0.05)


@pytest.mark.parametrize(("degrees", "factor"), [(True, 1.0), (False, 2048 / 4096 * 360 / 200)])
def test_what_a_dataset_says_of_its_unit_counts(tmp_path, degrees, factor):
    """Before any guess: 100 of a range of 2048 counts are 90 degrees."""
    path = lerobot(tmp_path)
    rewrite(path / "meta" / "info.json", lambda info: info.update(robot={"use_degrees": degrees}))
    entry = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1024, "range_max": 3072}
    (path / "calibration.json").write_text(json.dumps(dict.fromkeys(JOINTS, entry)))
    assert np.abs(read_log(path).array("joint/position") - factor * position()).max() < 1e-4


@pytest.mark.parametrize(("middle", "per_rad", "joints"), [(2048, 4096 / (2 * np.pi), 2), (0.5, 1.0, 1)])
def test_counts_are_no_degrees_and_an_opening_is_no_angle(tmp_path, monkeypatch, middle, per_rad, joints):
    """Whole numbers beyond a turn of degrees are counts; a gripper's from 0 to 1 are left out."""
    monkeypatch.setattr(foreign_logs, "JOINTS", ("gripper" if joints == 1 else "shoulder", "elbow"))
    path = lerobot(tmp_path)
    table = {}
    for feature, angles in (("action", target()), ("observation.state", 0.97 * position())):
        first = middle + angles[:, 0] * per_rad
        second = np.round(2048 + angles[:, 1] * per_rad) if joints == 2 else np.rad2deg(angles[:, 1])
        table[feature] = np.stack([np.round(first) if joints == 2 else first, second], axis=1).tolist()
    rewrite(next(path.rglob("*.parquet")), lambda content: content.update(table))
    log = read_log(path)
    assert log.joints == foreign_logs.JOINTS[-joints:]
    assert np.ptp(log.array("joint/position")[:, -1]) == pytest.approx(0.97 * np.ptp(position()[:, 1]), rel=0.01)


def test_a_calibration_of_lists(tmp_path):
    """LeRobot's until 2025: degrees, and percent of the gripper's range."""
    path = counted(tmp_path, "deg", 0.3)
    ends = np.array(list(RANGES.values())).T.tolist()
    modes = ["DEGREE"] * 3 + ["LINEAR"]
    old = {"motor_names": list(RANGES), "calib_mode": modes, "start_pos": ends[0], "end_pos": ends[1]}
    (path / "calibration.json").write_text(json.dumps(old))
    log = read_log(path)
    assert np.ptp(log.array("joint/position"), axis=0) == pytest.approx(0.6, rel=0.05)
    assert log.findings == ()


def test_the_gain_that_lerobot_writes_is_told(tmp_path):
    """Its arms do not run with the gain of the factory."""
    path = counted(tmp_path, "deg", 0.3)
    rewrite(path / "meta" / "info.json", lambda info: info.update(robot_type="so101_follower"))
    log = read_log(path)
    assert (log.array("command/firmware_gain") == 16).all()
    assert [one.column for one in log.findings] == ["field firmware_gain"]


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the description of a dataset, or the columns of its table."""
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    if path.suffix == ".json":
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
    else:
        table = parquet.read_table(path).to_pydict()
        change(table)
        parquet.write_table(pyarrow.table(table), path)


def test_a_dataset_in_radians(tmp_path):
    """Where no number is as large as a turn in radians, they are no degrees."""
    path = lerobot(tmp_path)

    def radians(table: dict[str, Any]) -> None:
        table |= {name: np.deg2rad(table[name]).tolist() for name in ("action", "observation.state")}

    rewrite(next(path.rglob("*.parquet")), radians)
    assert np.abs(read_log(path).array("joint/position") - position()).max() < 1e-4


def renamed(**names: list[str]) -> Callable[[dict[str, Any]], None]:
    """Features have other names."""

    def change(info: dict[str, Any]) -> None:
        for name, its in names.items():
            info["features"][name.replace("_", ".")]["names"] = its

    return change


@pytest.mark.parametrize(
    "names", [["Pitch", "main_elbow"], ["Pitch_deg", "elbow_deg"], ["Pitch.pos", "elbow_degrees.pos"]]
)
def test_bare_names_of_a_dataset_are_positions(tmp_path, names):
    """Also one that an angle of the trunk might have; a unit in a name is that of the numbers."""
    path = lerobot(tmp_path)
    rewrite(path / "meta" / "info.json", renamed(action=names, observation_state=names))
    log = read_log(path)
    assert np.abs(log.array("joint/position") - position()).max() < 1e-4
    assert log.joints[0] == "Pitch"


def test_velocities_of_a_dataset_in_degrees(tmp_path):
    """Beside positions in degrees they are in degrees per second."""
    path = lerobot(tmp_path)
    names = [f"{joint}.{kind}" for kind in ("pos", "vel") for joint in JOINTS]
    rewrite(path / "meta" / "info.json", renamed(observation_state=names))
    both = np.rad2deg(np.hstack([position(), velocity()])).tolist()
    rewrite(next(path.rglob("*.parquet")), lambda table: table.update({"observation.state": both}))
    assert np.abs(read_log(path).array("joint/velocity") - velocity()).max() < 1e-4


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("info.json", lambda info: info.update(total_frames=10**4), "states 10000 frames, but the parquet files have"),
        ("info.json", lambda info: info.update(fps=17), "the metadata state rate: 17 Hz"),
        ("info.json", renamed(action=["a.pos"]), "there are 1 names, but a row of action has 2 numbers"),
        ("*.parquet", lambda table: table.pop("episode_index"), "column episode_index: the column is missing"),
        ("calibration.json", lambda known: known.pop(JOINTS[0]), "the calibration does not have this joint"),
    ],
)
def test_what_contradicts_in_a_dataset_is_refused(tmp_path, file, change, said):
    """Counts, rates, names and calibrations."""
    path = lerobot(tmp_path)
    if file == "calibration.json":
        (path / file).write_text(json.dumps({joint: {"range_min": 0, "range_max": 4095} for joint in JOINTS}))
    rewrite(next(path.rglob(file)), change)
    with pytest.raises(LogError, match=said):
        read_log(path)


def test_a_part_of_a_sage_pair_names_the_folder(tmp_path):
    """A part is no CSV of its own."""
    path = sage(tmp_path)
    for name in ("control.csv", "state_motor.csv"):
        with pytest.raises(LogError, match=f"one part of a SAGE pair; name its folder, {path.name}"):
            read_log(path / name)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: {n: array.T for n, array in content.items()}, r"has shape \(2, \d+\)"),
        (lambda content: {**content, "joints": np.array(["a", "b", "c", "d", "e"])}, "and 5 joints"),
        (lambda content: {**content, "q": content["q"][:-5]}, "the column has 245 rows but its clock has 250"),
    ],
)
def test_archives_of_another_shape_are_refused(tmp_path, change, said):
    """The array and its shape are named."""
    path = npz(tmp_path)
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **change(content))
    with pytest.raises(LogError, match=said):
        read_log(path)


def test_archives_with_dates_and_bytes(tmp_path):
    """Names in bytes are names, and dates are times."""
    path = npz(tmp_path)
    with np.load(path) as archive:
        content = dict(archive)
    dates = np.datetime64("2026-01-01T10:00:00", "ns") + np.round(content["time"] * 1e9).astype("timedelta64[ns]")
    np.savez(path, **{**content, "time": dates, "joints": np.array(JOINTS, dtype="S")})
    assert read_log(path).joints == tuple(JOINTS)


def test_a_dataset_without_names(tmp_path):
    """Motors that have no name are joints by their number; a name that stands there twice is refused."""
    path = lerobot(tmp_path)
    features = ("action", "observation.state")
    rewrite(path / "meta" / "info.json", lambda info: [info["features"][name].pop("names") for name in features])
    assert read_log(path).joints == ("joint_0", "joint_1")
    rewrite(path / "meta" / "info.json", lambda info: info["features"]["action"].update(names=["a.pos", "a.pos"]))
    with pytest.raises(LogError, match=r"info.json, column action: the name 'a.pos' appears twice"):
        read_log(path)


def test_clocks_in_two_units(tmp_path):
    """Commands stamped in milliseconds beside states in microseconds are refused, and not cut to what they share."""
    path = sage(tmp_path)
    control = path / "control.csv"
    control.write_text(re.sub(r"CONTROL,([\d.]+)", lambda row: f"CONTROL,{float(row[1]) / 1e3}", control.read_text()))
    with pytest.raises(LogError, match=r"column time: one clock runs over .* as if one were in ms"):
        read_log(path)


def test_both_clocks_in_another_unit(tmp_path):
    """Milliseconds in both files are told as that and nothing else, and a line in the YAML reads them."""
    path = sage(tmp_path)
    sound = read_log(path)
    for file in (path / "control.csv", path / "state_motor.csv"):
        stamps = re.sub(r"(CONTROL|MOTOR),([\d.]+)", lambda row: f"{row[1]},{float(row[2]) / 1e3}", file.read_text())
        file.write_text(stamps)
    with pytest.raises(LogError, match=r"as if milliseconds had been read as microseconds; write the unit"):
        read_log(path)
    (log,) = read_episodes(path, check=False)
    assert len(examine(log)) == 1
    path.with_suffix(".yaml").write_text("columns: {timestamp: {name: time, unit: ms}}\n")
    assert np.abs(read_log(path).column("time") - sound.column("time")).max() < 1e-9


def test_commands_for_a_part_of_the_time(tmp_path):
    """Rows without commands are left out, and where these are most of the rows, that is said."""
    path = sage(tmp_path)
    control = path / "control.csv"
    control.write_text("\n".join(control.read_text().splitlines()[:60]))
    log = read_log(path)
    assert log.rows < 80
    assert [finding.check for finding in log.findings] == ["shared time"]


def test_a_joint_that_was_not_read_for_a_second(tmp_path):
    """Nothing is made up for the hole in one joint's readings."""
    path = long_csv(tmp_path)
    rows = path.read_text().splitlines()
    path.write_text("\n".join(row for number, row in enumerate(rows) if "elbow" not in row or not 200 < number < 300))
    with pytest.raises(LogError, match=r"column elbow.position: the column has no value from 1.98 to 2.98 s"):
        read_log(path)


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


@pytest.fixture(scope="module", params=FORMATS)
def sound(request, tmp_path_factory) -> tuple[Path, Path]:
    """A folder with a log of every format, and the log's path in it."""
    folder = tmp_path_factory.mktemp("sound")
    return folder, FORMATS[request.param](folder).relative_to(folder)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_is_read_or_refused(tmp_path_factory, sound, data):
    """A file with some bytes replaced, cut or added gives logs or a LogError of one line, and nothing else."""
    base, path = sound
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(base, folder, dirs_exist_ok=True)
    file = data.draw(st.sampled_from(sorted(file for file in folder.rglob("*") if file.is_file())))
    raw = file.read_bytes()
    start = data.draw(st.integers(0, len(raw)))
    end = min(len(raw), start + data.draw(st.sampled_from([0, 1, 4, 40, len(raw)])))
    file.write_bytes(raw[:start] + data.draw(st.binary(max_size=12)) + raw[end:])
    assert "\n" not in refusal(folder / path)
    shutil.rmtree(folder)


@pytest.mark.parametrize("size", [1e200, 3.0, 0.0])
def test_a_quaternion_that_is_none_gives_no_orientation(size):
    """One that is not normed to within two fifths is what a driver sends that has none, or damaged."""
    quaternion = SimpleNamespace(w=size, x=0.0, y=0.0, z=0.0)
    vector = SimpleNamespace(x=0.0, y=0.0, z=9.81)
    message = SimpleNamespace(
        orientation=quaternion, orientation_covariance=[0.0] * 9, angular_velocity=vector, linear_acceleration=vector
    )
    assert set(trunk(message)) == {f"imu.{sensor}_{axis}" for sensor in ("gyro", "acc") for axis in "xyz"}


def test_an_imported_log_is_in_its_robots_terms_once(tmp_path):
    """The same angles before its YAML is written and behind it, there also without its robot; another is refused."""
    arm = load_robot("arm")
    path, names = sage(tmp_path), [arm.file.joints[joint].log.name or joint for joint in arm.joints]
    (path / "joint_list.txt").write_text("\n".join(names))
    for file in ("state_motor.csv", "control.csv"):  # as many columns as joints
        text = (path / file).read_text()
        (path / file).write_text(re.sub(r"\[(.*?), (.*?)\]", r"[\1, \2, \1, \2, \1, \2]", text))
    before = read_log(path, "arm").array("joint/position")
    with pytest.raises(LogError, match=r"the log has none of the joints of op3: head_pan"):
        propose(path, "op3")
    side_path(path).write_text(as_yaml(*propose(path, "arm")))
    for robot in ("arm", None):
        log = read_log(path, robot)
        assert (log.joints, log.metadata.robot_file) == (arm.joints, "arm")
        assert np.abs(log.array("joint/position") - before).max() < 1e-9
    with pytest.raises(LogError, match="the log belongs to the robot 'arm', not to 'op3'"):
        read_log(path, "op3")
    (path / "joint_list.txt").write_text("\n".join(f"motor_{number}" for number in range(1, 7)))
    named = [column.name for column in propose(path, "arm")[1].values()]
    assert [f"{joint}.target" for joint in arm.joints] == [name for name in named if name and name.endswith("target")]


@pytest.mark.parametrize(
    ("name", "column", "unit"),
    [
        ("kneeJoint_mA", "knee.current", "mA"),
        ("knee_rpm", "knee.velocity", "rpm"),
        ("knee_mV", "knee.voltage", "mV"),
        ("i_knee [mA]", "knee.current", "mA"),
        ("q_meas_hip [deg]", "hip.position", "deg"),
        ("arm_hip_out_rpm", "hip.velocity", "rpm"),
        ("hip_position [°]", "hip.position", "deg"),
        ("hip_vel_degs", "hip.velocity", "deg/s"),
        ("hip current [A]", "hip.current", None),
        ("hip temperature (C)", "hip.temperature", None),
        ("hip_vel [deg]", "hip.velocity", "deg/s"),
        ("hip_present_position_ticks", "hip.position", "counts of 4096 a turn"),
        ("hip_actual", "hip.position", None),
        ("hip_temperature_degC", "hip.temperature", None),
        ("hip_current_A", "hip.current", None),
        ("hip_pwm_pct", "hip.duty", "percent"),
    ],
)
def test_a_unit_says_what_is_measured(name, column, unit):
    """Milliamperes are a current, in whatever case."""
    meaning = guess(name, ["knee", "hip"])
    assert (meaning.name, meaning.unit) == (column, unit)


def test_a_joint_as_near_to_two_is_neither():
    """A knee of no side stays what it is called."""
    assert guess("knee_pos", ["l_knee", "r_knee"]).name == "knee.position"
    assert guess("l_kne_pos", ["l_knee", "r_knee"]).name == "l_knee.position"


def test_what_is_told_to_turn_is_no_target_of_a_position():
    """Targets of velocities, torques and currents, and errors, leave a position and its target to those that are."""
    names = ["hip_cmd_vel", "dq_des_hip", "tau_des_hip", "hip_current_target", "hip_pos_error", "hip_q", "hip_q_des"]
    meanings = guess_all(names, ["hip"])
    assert {name: one.name for name, one in meanings.items() if one.name} == {
        "hip_q": "hip.position",
        "hip_q_des": "hip.target",
    }


def test_a_log_ends_where_one_joint_stops_reporting(tmp_path):
    """No position is made up behind a joint's last one; a command counts on for a while."""
    time, lines = np.arange(300) * 0.01, ["time,joint,position,target"]
    for row, now in enumerate(time):
        angle = np.sin(3 * now)
        lines += [
            f"{now},{joint},{angle},{np.sin(3 * now + 0.05)}"
            for joint in ("hip", "knee")
            if joint == "hip" or row < 200
        ]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    (tmp_path / "run.yaml").write_text("robot: real\nmount: stand\n")
    log = read_log(tmp_path / "run.csv")
    assert log.rows == 200
    assert np.abs(log.array("joint/position")[:, 1] - np.sin(3 * time[:200])).max() < 1e-6
