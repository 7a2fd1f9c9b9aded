"""Logs that are wrong in the ways people's logs are: each is refused, mended by an option, or a channel set aside."""

from __future__ import annotations

import bz2
import dataclasses
import gzip
import io
import lzma
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from op3.robot.servo_make import load_servo
from op3.rollout import LogError, Metadata, Rollout, read_episodes, read_log
from op3.rollout.health import examine, merge_findings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robot"))
from robots import write_robot

RATE = 125.0


def bench_log(joints: int = 1, **changes) -> Rollout:
    """Eight seconds of joints that follow slow sines with a lag and gravity's sag, as quantised sensors see them."""
    time = np.arange(1000) / RATE
    names = tuple(f"joint_{i}" for i in range(joints))
    phase = np.arange(joints)
    rates = 2.0 + 0.37 * phase
    target = 0.6 * np.sin(rates * time[:, None] + phase)
    position = 0.57 * np.sin(rates * (time[:, None] - 0.03) + phase) + 0.02
    velocity = 0.57 * rates * np.cos(rates * (time[:, None] - 0.03) + phase)
    step = 2 * np.pi / 4096
    tilt = 0.2 * np.sin(np.array([3.0, 4.1, 5.3]) * time[:, None])
    roll, pitch, _ = tilt.T
    rate = np.gradient(tilt, time, axis=0)
    gyro = np.stack(
        [
            rate[:, 0] - rate[:, 2] * np.sin(pitch),
            rate[:, 1] * np.cos(roll) + rate[:, 2] * np.sin(roll) * np.cos(pitch),
            rate[:, 2] * np.cos(roll) * np.cos(pitch) - rate[:, 1] * np.sin(roll),
        ],
        axis=1,
    )
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    arrays = {
        "time": time,
        "command/position": target,
        "joint/position": np.round(position / step) * step,
        "joint/velocity": np.round(velocity / 0.024) * 0.024,
        "command/firmware_gain": np.full((1000, joints), 32.0),
        "imu/orientation": tilt,
        "imu/angular_velocity": gyro,
        "imu/linear_acceleration": 9.81 * up,
    }
    about = dict(mass=0.535, length=0.15, battery=7.4, firmware_gain=32)
    return Rollout.from_arrays(arrays, Metadata(names, "rig", "pendulum", RATE, **{**about, **changes}))


Table = dict[str, np.ndarray]
Change = Callable[[Table], None]


def write(folder: Path, change: Change = lambda table: None, side: str = "", joints: int = 1) -> Path:
    """A CSV of the log with its columns changed, and lines added to its sidecar."""
    path = bench_log(joints).to_csv(folder / "run.csv")
    header, *rows = path.read_text().splitlines()
    table = dict(zip(header.split(","), np.array([row.split(",") for row in rows], dtype=float).T, strict=True))
    change(table)
    lines = [",".join(table), *(",".join(map(repr, row)) for row in np.array(list(table.values())).T.tolist())]
    path.write_text("\n".join(lines) + "\n")
    sidecar = path.with_suffix(".yaml")
    sidecar.write_text(sidecar.read_text() + side)
    return path


def edit(pattern: str, how: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the columns whose names match."""

    def change(table: Table) -> None:
        table.update({name: how(values) for name, values in table.items() if re.fullmatch(pattern, name)})

    return change


def scale(pattern: str, factor: float) -> Change:
    """Multiply columns."""
    return edit(pattern, lambda values: values * factor)


def add(pattern: str, value: float, first: int = 0) -> Change:
    """A number is added from a row on."""
    return edit(pattern, lambda values: values + value * (np.arange(len(values)) >= first))


def gap(first: int, last: int) -> Change:
    """Rows are missing."""
    return edit(".*", lambda values: np.delete(values, slice(first, last)))


def put(column: str, value: float, first: int, last: int | None = None) -> Change:
    """Some rows have another number; NaN: that of the first of them."""

    def how(values: np.ndarray) -> np.ndarray:
        rows = np.isin(np.arange(len(values)), np.arange(first, last or first + 1))
        return np.where(rows, values[first] if np.isnan(value) else value, values)

    return edit(column, how)


def soft(share: float, unit: float) -> Change:
    """The joint moves by a share of what it did, and its encoder's steps are told in a unit [1/rad]."""

    def change(table: Table) -> None:
        step = 2 * np.pi / 4096
        table["joint_0.velocity"] = share * table["joint_0.velocity"]
        table["joint_0.position"] = np.round(share * table["joint_0.position"] / step) * (step * unit)

    return change


def swap(one: str, other: str) -> Change:
    """Two columns are exchanged."""

    def change(table: Table) -> None:
        table[one], table[other] = table[other], table[one]

    return change


def rotate(channel: str) -> Change:
    """Every one of three joints has the numbers of the next."""

    def change(table: Table) -> None:
        names = [f"joint_{joint}.{channel}" for joint in (0, 1, 2)]
        table.update(zip(names, [table[name] for name in names[1:] + names[:1]], strict=True))

    return change


def copy(one: str, other: str) -> Change:
    """A column holds the numbers of another one."""
    return lambda table: table.update({other: table[one]})


def swings_around_pi(table: Table) -> None:
    """Zero lies at the far side."""
    table["joint_0.position"] = table["joint_0.position"] % (2 * np.pi) - np.pi
    table["joint_0.target"] = table["joint_0.target"] + np.pi


def lost_unevenly(table: Table) -> None:
    """Rows are missing, and the intervals of the others are not the same."""
    random = np.random.default_rng(0)
    table["time"] = table["time"] + random.normal(0, 0.06 / RATE, 1000)
    edit(".*", lambda v: v[np.random.default_rng(1).random(1000) > 0.3])(table)


def slow_and_jumps(table: Table) -> None:
    """A joint that moves by a step of its encoder now and then is elsewhere from one row to the next."""
    step = 2 * np.pi / 4096
    edit("joint_0.(position|target|velocity)", lambda v: 0.1 * v)(table)
    edit("joint_0.position", lambda v: np.round(v / step) * step + 0.4 * (np.arange(1000) >= 400))(table)


REFUSED: dict[str, tuple[Change, str]] = {
    "clock set forward": (
        add("time", 3600, 500),
        r"row 501, column time: time jumps .* the clock was adjusted here; split",
    ),
    "clock set back": (add("time", -2.0, 500), r"row 501, column time: time decreases"),
    "a second is missing": (gap(400, 525), r"row 401, column time: .* about 12\d rows are missing"),
    "a quarter of a second is missing": (gap(400, 432), r"about 3\d rows are missing"),
    "another turn": (
        add("joint_0.position", -2 * np.pi, 500),
        r"row 501, .* jumps by one turn .* at row 501; .*unwrap",
    ),
    "around pi": (swings_around_pi, r"position jumps by one turn .*unwrap: true.*shift"),
    "a turn off": (add("joint_0.position", 2 * np.pi), r"position is \+6\.\d+ rad away .* about \+1 turn"),
    "position in degrees": (scale(".*position", 6.5), r"position: the position moves 6\.\d+ times as far"),
    "both in degrees": (scale(".*(position|target|velocity)", 57.29578), r"in steps of 0\.08789.* were in deg"),
    "position in counts": (scale(".*position", 4096 / 2 / np.pi), r"as if it were in counts of 4096 a turn"),
    "position of a soft servo in degrees": (
        soft(0.7, 57.29578),
        r"moves 38\.\d times .*, as if it were in deg;",
    ),
    "position of a soft servo in counts": (
        soft(0.8, 4096 / 2 / np.pi),
        r"moves 49\d times .*, as if it were in counts of 4096 a turn",
    ),
    "targets of a soft servo in degrees": (
        edit(".*target", lambda v: 57.29578 * v / 0.7),
        r"moves 0\.0116 times .*, as if the command were in deg",
    ),
    "gyroscope in counts of 16.4": (
        scale("imu.gyro_.", 939.65),
        r"reads 9\d\d times the derivative of the orientation; write `unit:`",
    ),
    "gyroscope in degrees": (scale("imu.gyro_.", 57.3), r"gyro_x: the gyroscope reads 57\.\d times .* in deg/s"),
    "gyroscope turned": (scale("imu.gyro_y", -1), r"gyro_y: the gyroscope reads -(1|0.99\d*) .* sign reversed"),
    "gyroscope's axes": (swap("imu.gyro_x", "imu.gyro_y"), r"axes are swapped"),
    "accelerometer downwards": (scale("imu.acc_.", -1), r"all axes read downwards"),
    "velocity in counts": (scale(".*velocity", 1 / 0.02398), r"counts of 0\.229 rpm"),
    "velocity in rpm": (scale(".*velocity", 9.549), r"in rpm"),
    "velocity turned": (scale(".*velocity", -1), r"velocity is -(1|0.99\d*) times .* sign reversed"),
    "position turned": (scale(".*(position|velocity)", -1), r"position moves opposite to its command"),
    "a slow joint's jump": (slow_and_jumps, r"row 401, column joint_0.position: position jumps by \+0\.4"),
    "a spike": (put("joint_0.position", 2.9, 300), r"row 301, .* position jumps by \+\d.* in one row, faster"),
    "a dead sensor": (scale("joint_0.position", 0), r"position stays at 0 rad while its command moves by"),
    "repeated rows": (
        put("imu.*|.*(position|velocity)", np.nan, 400, 440),
        r"row 401, .* all sensor values are constant for 40 rows",
    ),
    "milliseconds": (scale("time", 1e3), r"the time looks like milliseconds"),
    "a counter set anew": (add("joint_0.position", -0.3, 500), r"row 501, .* jumps by -0\.3\d+ rad in one row, faster"),
    "turns": (scale(".*(position|target|velocity)", 0.5 / np.pi), r"as if they were in turn"),
    "the goal recorded": (copy("joint_0.target", "joint_0.position"), r"every value equals the command"),
    "a Unix time as float32": (
        edit("time", lambda v: np.float32(v + 1.7e9) * 1.0),
        r"as in \d+ rows.* more digits",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_right_is_refused(tmp_path, case):
    """One sentence says where it is, what it likely is, and what mends it."""
    change, expected = REFUSED[case]
    with pytest.raises(LogError, match=expected):
        read_log(write(tmp_path, change))


def test_small_degrees_without_velocity(tmp_path):
    """Degrees so small that no number is implausible show against the command, by their factor."""

    def change(table: Table) -> None:
        scale(".*(position|target)", 0.1)(table)
        scale(".*position", 57.3)(table)
        del table["joint_0.velocity"]

    with pytest.raises(LogError, match=r"5\d\.\d times as far as its command, as if it were in deg"):
        read_log(write(tmp_path, change))


def test_a_joint_that_goes_round_is_read(tmp_path):
    """Its target and velocity say so too; degrees in one joint's position alone are refused."""

    def turns(table: Table) -> None:
        step = 2 * np.pi / 4096
        table["joint_1.target"] = table["joint_1.target"] + 2 * table["time"]
        table["joint_1.position"] = table["joint_1.position"] + np.round(2 * (table["time"] - 0.03) / step) * step
        table["joint_1.velocity"] = table["joint_1.velocity"] + 2.0

    log = read_log(write(tmp_path, turns, joints=3))
    assert log.array("joint/position")[:, 1].max() > 10
    assert not log.findings
    (tmp_path / "other").mkdir()
    with pytest.raises(LogError, match=r"joint_1\.position: .* as if it were in deg;"):
        read_log(write(tmp_path / "other", scale("joint_1.position", 57.3), joints=3))


def test_a_clock_without_a_rate_beside_it(tmp_path):
    """Where the metadata do not tell the rate, one that no robot has tells the unit."""
    path = write(tmp_path, scale("time", 1e6))
    sidecar = path.with_suffix(".yaml")
    sidecar.write_text(sidecar.read_text().replace("rate: 125.0\n", ""))
    with pytest.raises(
        LogError, match=r"interval of 8000 s is implausible for a robot; the time looks like microseconds"
    ):
        read_log(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (swap("joint_0.position", "joint_2.position"), r"follows the command of joint_\d: the columns .* swapped"),
        (rotate("position"), r"follows the command of joint_\d: the columns .* swapped"),
        (copy("joint_0.position", "joint_1.position"), r"joint_1.position: every value equals that"),
    ],
)
def test_positions_of_other_joints(tmp_path, change, expected):
    """Joints whose positions were exchanged follow each other's commands; a copy is named."""
    with pytest.raises(LogError, match=expected):
        read_log(write(tmp_path, change, joints=3))


@pytest.mark.parametrize("sign", [1, -1])
def test_swapped_and_turned_round(tmp_path, sign):
    """Two joints each follow the other's command, one or both of them backwards."""

    def swap(table: Table) -> None:
        for kind in ("position", "velocity"):
            one, other = table[f"joint_0.{kind}"].copy(), table[f"joint_1.{kind}"].copy()
            table[f"joint_0.{kind}"], table[f"joint_1.{kind}"] = -other, sign * one

    said = "follows the command of joint_1: the columns of the two are swapped, and one sign is reversed"
    with pytest.raises(LogError, match=said):
        read_log(write(tmp_path, swap, joints=3))


def test_a_position_of_another_recording_is_told(tmp_path):
    """It moves, and not as it is told; a current that cannot be explained so is no second fault."""

    def another(table: Table) -> None:
        angle = 0.4 * np.sin(5.3 * table["time"] + 1.0)
        table["joint_1.position"], table["joint_1.velocity"] = angle, np.gradient(angle, table["time"])

    (found,) = read_log(write(tmp_path, another, joints=3)).findings
    assert found.column == "joint_1.position"
    assert "does not follow its command" in found.problem


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (lambda a, q: a * [1, -1, -1], "the sign of pitch and yaw were reversed"),
        (lambda a, q: np.rad2deg(a), "the angles were in degrees"),
        (lambda a, q: a[:, [1, 0, 2]], "roll and pitch were swapped"),
        (lambda a, q: q.inv().as_euler("ZYX")[:, ::-1], "the orientation of the world in the body's frame"),
        (
            lambda a, q: Rotation.from_quat(q.as_quat()[:, [3, 0, 1, 2]]).as_euler("ZYX")[:, ::-1],
            "had been written as w, x, y, z",
        ),
        (
            lambda a, q: Rotation.from_quat(q.as_quat()[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, ::-1],
            "had been written as x, y, z, w",
        ),
    ],
)
def test_an_orientation_that_both_other_sensors_contradict(tmp_path, read, said):
    """Where they agree it is the orientation that was read wrongly, and how is named."""

    def change(table: Table) -> None:
        axes = [f"imu.{axis}" for axis in ("roll", "pitch", "yaw")]
        angles = np.stack([table[axis] for axis in axes], axis=1)
        table.update(zip(axes, read(angles, Rotation.from_euler("ZYX", angles[:, ::-1])).T, strict=True))

    with pytest.raises(LogError, match=said) as error:
        read_log(write(tmp_path, change))
    assert error.value.column == "imu.roll"


def test_joints_that_differ_in_capital_letters_are_told():
    """One joint in two spellings; a log of our own has them apart."""
    log = bench_log(joints=2)
    about = dataclasses.replace(log.metadata, joints=("knee", "Knee"))
    found = examine(dataclasses.replace(log, metadata=about))
    assert any("knee and Knee differ only in capital letters" in finding.problem for finding in found)


def test_a_joint_that_goes_with_another_one_is_not_swapped_with_it(tmp_path):
    """One follows the command of another, which does something else: a soft robot that leans, not exchanged columns."""

    def lean(table: Table) -> None:
        other = 0.3 * np.sin(0.9 * table["time"] + 1.0)
        for joint, angle in ((0, table["joint_2.target"].copy()), (2, other)):
            table[f"joint_{joint}.position"] = angle
            table[f"joint_{joint}.velocity"] = np.gradient(angle, table["time"])

    assert not any("swapped" in finding.problem for finding in read_log(write(tmp_path, lean, joints=3)).findings)


def test_a_joint_that_holds_and_is_shaken_is_not_swapped_with_the_one_that_shakes_it(tmp_path):
    """One holds still and gives way to the motion of another, which follows its own command: a robot that falls."""

    def shaken(table: Table) -> None:
        table["joint_0.target"] = np.zeros_like(table["time"])
        table["joint_0.position"] = 0.1 * (table["joint_2.position"] - table["joint_2.position"].mean())
        table["joint_0.velocity"] = np.gradient(table["joint_0.position"], table["time"])

    assert not any("swapped" in finding.problem for finding in read_log(write(tmp_path, shaken, joints=3)).findings)


GYRO_AND_ANGLES = ("imu.gyr", "imu.rol", "imu.pit", "imu.yaw")

WARNED: dict[str, tuple[Change, str]] = {
    "16 bits without sign": (edit(".*velocity", lambda v: np.where(v < 0, v + 65536 * 0.024, v)), "16-bit"),
    "16 bits of mA without sign": (
        lambda t: t.update({"joint_0.current": np.round(1e3 * 0.3 * t["joint_0.velocity"]) % 65536 / 1e3}),
        "negative values of a 16-bit register",
    ),
    "a wrong reading": (put("joint_0.velocity", 40.0, 300), "a single reading of 40 is far from its neighbours"),
    "held": (edit("joint_0.(position|velocity)", lambda v: v[np.arange(1000) // 10 * 10]), "only every 10 rows"),
    "a short hole": (gap(400, 412), "about 12 rows are missing before this one"),
    "a slower clock": (edit("time", lambda v: v + np.maximum(v - 4.5, 0)), "the intervals become 2 times as long"),
    "lost rows of an uneven clock": (lost_unevenly, "the rows are missing, one at a time"),
    "no target": (
        put("joint_0.target", np.nan, 0, 1000),
        "target stays at 0 rad in every row while the joint moves by",
    ),
    "a gyroscope that is late": (edit("imu.gyro_.", lambda v: np.roll(v, 80)), "does not follow the change of orient"),
    "a single rate": (put("imu.gyro_y", 34.9, 300), "a single reading of 34.9 is far from its neighbours"),
    "a single angle": (put("imu.pitch", -0.9, 300), "a single reading of -0.9 is far from its neighbours"),
    "a gyroscope that stops": (
        put("imu.gyro_.", np.nan, 500, 1000),
        "values of angular velocity are constant for 499 rows",
    ),
    "an orientation that stops": (
        put("imu.(roll|pitch|yaw)", np.nan, 500, 1000),
        "values of orientation are constant for 499",
    ),
    "another zero of a bench": (add("joint_0.position", 0.5), "0.548 rad from its command in every pose"),
    "a velocity of nothing for a while": (
        put("joint_0.velocity", 0.0, 380, 418),
        "position and integrated velocity diverge",
    ),
    "wrong velocities in a row": (
        put("joint_0.velocity", 12.0, 500, 503),
        "position and integrated velocity diverge by",
    ),
    "a position that stands for a while": (put("joint_0.position", np.nan, 380, 418), "integrated velocity diverge by"),
    "an accelerometer's scale": (scale("imu.acc_.", 0.8), "m/s2, but gravity alone is 9.81"),
    "a gyroscope's scale": (scale("imu.gyro_.", 0.55), "the gyroscope reads 0.55"),
    "gains that were exchanged": (
        lambda t: t.update({"joint_0.p_gain": 0.1 + 0 * t["time"], "joint_0.d_gain": 6 + 0 * t["time"]}),
        "the columns may be swapped",
    ),
    "a trunk that is read rarely": (
        edit("imu.*", lambda v: v[np.arange(len(v)) // 10 * 10]),
        "the trunk's sensor has new values only every 10 rows",
    ),
    "a bias of the gyroscope": (
        lambda t: t.update({n: 0 * v + 0.15 * (n == "imu.gyro_z") for n, v in t.items() if n[:7] in GYRO_AND_ANGLES}),
        "differs from the change of orientation by +0.15 rad/s on average",
    ),
    "lost rows": (
        edit(".*", lambda v: v[np.random.default_rng(0).random(1000) > 0.07]),
        "the rows are missing, one at a time",
    ),
}


@pytest.mark.parametrize("case", WARNED)
def test_what_is_suspicious_is_a_warning(tmp_path, case):
    """The log is used, and says what is strange about it."""
    change, expected = WARNED[case]
    assert any(expected in finding.problem for finding in read_log(write(tmp_path, change)).findings)


@pytest.mark.parametrize(
    ("columns", "channel"), [("imu.acc_.", "imu/linear_acceleration"), ("imu.gyro_.", "imu/angular_velocity")]
)
def test_a_lost_sensor_of_the_trunk_is_not_used(tmp_path, columns, channel):
    """An accelerometer without gravity, and a gyroscope that stands while the robot tilts, are set aside."""
    assert channel not in read_log(write(tmp_path, scale(columns, 0)))


@pytest.mark.parametrize("value", [0.25, -0.3, np.pi])
def test_another_zero_is_a_warning(tmp_path, value):
    """One joint of several that stands off its command in every pose."""
    (finding,) = read_log(write(tmp_path, add("joint_2.position", value), joints=5)).findings
    assert (finding.column, finding.check, finding.set_aside) == ("joint_2.position", "constant offset", False)


@pytest.mark.parametrize(("share", "found"), [(1.0, 0), (0.0, 1)])
def test_a_soft_joint_that_yields_has_no_other_zero(tmp_path, share, found):
    """Its current is gain times the angle that it stands off; where the servo feels nothing of it, the zero is off."""

    def soft(table: Table) -> None:
        for joint in [f"joint_{number}" for number in range(5)]:
            off = 0.4 if joint == "joint_2" else 0.0
            pulled = table[f"{joint}.target"] - table[f"{joint}.position"] - share * off
            table[f"{joint}.position"] = table[f"{joint}.position"] + off
            table |= {f"{joint}.p_gain": np.ones(1000), f"{joint}.current": pulled}

    findings = read_log(write(tmp_path, soft, joints=5)).findings
    assert [one.column for one in findings if one.check == "constant offset"] == ["joint_2.position"] * found


def test_a_wrong_axis_takes_its_vector_along():
    """Roll and yaw are not put in the place of a pitch that leaps: a robot on its stand would lean."""
    log = bench_log()
    log.data["imu", "orientation"][400, 1] = 1.2
    checked = log.check()
    assert "joint_0.position" not in checked.metadata.set_aside
    assert checked.metadata.set_aside == ("imu.pitch",)
    assert ("imu", "orientation") not in checked


def test_a_dead_position_of_one_joint_is_set_aside(tmp_path):
    """The command stands in its place, and the joint does not count as measured."""
    log = read_log(write(tmp_path, scale("joint_1.position", 0), joints=3))
    assert log.measured("joint/position").tolist() == [True, False, True]


@pytest.mark.parametrize(("columns", "rows"), [("joint_1.velocity", 97), ("joint_1.velocity", 1), ("imu.*", 5)])
def test_cells_without_a_number_set_a_channel_aside(tmp_path, columns, rows):
    """A velocity or an inertial sensor that was not read in every row is not used; the rest is."""
    unread = edit(columns, lambda values: np.where(np.arange(1000) % rows, values, np.nan))
    path = write(tmp_path, unread, joints=3)
    path.write_text(path.read_text().replace("nan", ""))
    log = read_log(path)
    assert {finding.check for finding in log.findings} == {"no number"}
    assert log.measured("joint/velocity").tolist() == [True, "joint" not in columns, True]


SIDES = {
    "grams": ("mass: 535\n", r"field mass: 535 kg is impossible; 535 g would be 0\.535 kg; write mass: 0\.535"),
    "millimetres": ("length: 150\n", r"field length: 150 m is impossible; 150 mm would be 0\.15 m"),
    "millivolts": ("battery: 7400\n", r"field battery: 7400 V is impossible; 7400 mV would be 7\.4 V"),
    "a key twice in one line": ("extra: {a: 1, a: 2}\n", r"field a: the key is on line \d+ and again"),
    "two batteries": (
        "battery: 11.1\nbattery: 12\n",
        r"field battery: the key is on line \d+ and again on line \d+",
    ),
    "another robot": ("robot_file: op3\n", r"field joints: joint_0 is not a joint of op3"),
    "another gain": ("firmware_gain: 3\n", r"firmware_gain is 3 in the metadata but 32 in the column"),
}


@pytest.mark.parametrize("case", SIDES)
def test_a_sidecar_that_cannot_be_right_is_refused(tmp_path, case):
    """The field, its value and the likely unit are named."""
    text, expected = SIDES[case]
    path = write(tmp_path)
    sidecar = path.with_suffix(".yaml")
    said = {line.split(":")[0] for line in text.splitlines()}
    lines = [line for line in sidecar.read_text().splitlines() if line.split(":")[0] not in said]
    sidecar.write_text("\n".join(lines) + "\n" + text)
    with pytest.raises(LogError, match=expected):
        read_log(path)


def test_a_robot_that_is_not_there_is_told(tmp_path):
    """Its log can be read all the same; the field and the known robots are named."""
    path = write(tmp_path)
    sidecar = path.with_suffix(".yaml")
    sidecar.write_text(sidecar.read_text() + "robot_file: nosuch\n")
    (finding,) = [finding for finding in read_log(path).findings if finding.column == "field robot_file"]
    assert "nosuch" in finding.problem
    assert not finding.set_aside


def test_exponents_are_numbers(tmp_path):
    """150e-3 is a number, as in every other language."""
    path = write(tmp_path)
    sidecar = path.with_suffix(".yaml")
    sidecar.write_text(
        sidecar.read_text().replace("length: 0.15", "length: 150e-3").replace("mass: 0.535", "mass: 5.35E-1")
    )
    assert (read_log(path).metadata.length, read_log(path).metadata.mass) == (0.15, 0.535)


def test_a_sidecars_gain_counts_for_every_row(tmp_path):
    """Without a column of its own the gain of the sidecar is the command's."""
    path = write(tmp_path, lambda table: table.__delitem__("joint_0.firmware_gain"))
    assert set(read_log(path).column("joint_0.firmware_gain")) == {32.0}


ASIDE: dict[str, Change] = {
    "stands still": scale("joint_1.velocity", 0),
    "another joint's": copy("joint_0.velocity", "joint_1.velocity"),
    "late": edit("joint_1.velocity", lambda values: np.roll(values, 60)),
    "in degrees": scale("joint_1.velocity", 57.3),
    "turned": scale("joint_1.velocity", -1),
    "2.3 times": scale("joint_1.velocity", 2.3),
    "early": edit("joint_1.velocity", lambda values: np.roll(values, -40)),
    "off by a constant": add("joint_1.velocity", 1.5),
    "dead from the middle on": put("joint_1.velocity", 0.5, 500, 1000),
    "noise": edit("joint_1.velocity", lambda _: np.random.default_rng(0).normal(0, 1, 1000)),
}


@pytest.mark.parametrize("case", ASIDE)
def test_one_joints_bad_velocity_is_set_aside(tmp_path, case):
    """The channel of that joint does not count as measured; all others do, and the log is used."""
    log = read_log(write(tmp_path, ASIDE[case], joints=3))
    assert log.metadata.set_aside == ("joint_1.velocity",)
    assert log.measured("joint/velocity").tolist() == [True, False, True]
    assert [f.column for f in log.findings if f.set_aside][:1] == ["joint_1.velocity"]
    assert np.abs(log.column("joint_1.velocity") - np.gradient(log.column("joint_1.position"), 1 / RATE)).max() < 1e-9


def driven(table: Table) -> None:
    """Currents are gain times error."""
    for joint in ("joint_0", "joint_1", "joint_2"):
        error = table[f"{joint}.target"] - table[f"{joint}.position"]
        table |= {f"{joint}.p_gain": np.full(1000, 4.0), f"{joint}.current": 4.0 * error}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (rotate("current"), "current belongs to joint_2"),
        (edit("joint_1.current", np.abs), "current was recorded without its sign"),
        (put("joint_1.current", 0.0, 0, 1000), "current stays at 0 in every row"),
        (edit("joint_1.current", lambda v: np.full(1000, 0.31)), "current stays at 0.31 in every row"),
        (put("joint_1.current", np.nan, 300, 1000), "values of current are constant for 699 rows"),
    ],
)
def test_one_joints_bad_current_is_set_aside(tmp_path, change, expected):
    """Exchanged, without its sign, or standing: it does not count as measured, and the cause is named."""

    def both(table: Table) -> None:
        driven(table)
        change(table)

    log = read_log(write(tmp_path, both, joints=3))
    (finding,) = [finding for finding in log.findings if finding.column == "joint_1.current"]
    assert expected in finding.problem
    assert log.measured("joint/position").all()


@pytest.mark.parametrize("factor", [1e-300, 1e-310, 1e-323])
def test_velocities_in_no_unit_at_all(factor, tmp_path):
    """Velocities whose factor has no inverse are told like others that do not fit the positions."""
    log = read_log(write(tmp_path, scale("joint_1.velocity", factor), joints=3))
    (finding,) = [finding for finding in log.findings if finding.column == "joint_1.velocity"]
    assert re.search("times the derivative of the position|hardly changes|stays", finding.problem)
    assert not log.measured("joint/velocity")[1]


def test_the_only_joints_bad_velocity_is_gone(tmp_path):
    """A bench log without a usable velocity has none."""
    log = read_log(write(tmp_path, scale(".*velocity", 0)))
    assert "joint/velocity" not in log
    assert log.metadata.set_aside == ("joint_0.velocity",)


@st.composite
def wrongs(draw: st.DrawFn) -> tuple[Change, str, str]:
    """A change of one joint's channels, the column in which it shows, and what is said of it."""
    joint, row = f"joint_{draw(st.integers(0, 2))}", draw(st.integers(200, 700))
    position, velocity, target = (f"{joint}.{channel}" for channel in ("position", "velocity", "target"))
    unit, size = draw(st.sampled_from([("deg", 57.2958), ("rpm", 9.5493), ("turn", 0.159155), ("sign reversed", -1.0)]))
    turns, jump = draw(st.sampled_from([-2, -1, 1, 2])), draw(st.floats(0.2, 2.0)) * draw(st.sampled_from([-1, 1]))
    factor, late = draw(st.floats(2.2, 40)), draw(st.integers(20, 80))
    delayed = "lags the change of position|that of|hardly changes|stays|follow"
    return draw(
        st.sampled_from(
            [
                (scale(velocity, size), velocity, unit),
                (scale(velocity, factor), velocity, "times the derivative of the position"),
                (
                    edit(velocity, lambda v: np.roll(v, late)),
                    velocity,
                    delayed,
                ),
                (edit(velocity, np.abs), velocity, "without its sign"),
                (put(velocity, np.nan, row, row + 250), velocity, "hardly changes|stays|times the derivative"),
                (put(velocity, 45.0, row), velocity, "single reading"),
                (add(position, 2 * np.pi * turns, row), position, "jumps by"),
                (add(target, 2 * np.pi * turns), position, "turn"),
                (add(position, jump, row), position, "jumps by"),
                (put(position, jump + 3, row, row + 3), position, "jumps by"),
                (edit(position, lambda v: np.round(v / 0.1) * 0.1), position, "steps of 0.1"),
                (scale(position, 57.2958), position, "deg"),
                (scale(f"{joint}.(position|velocity)", -1), position, "opposite to its command"),
                (edit("time", lambda v: v - 5 * (np.arange(1000) >= row)), "time", f"row {row + 1}, .*decreases"),
                (edit("time", lambda v: v + 5 * (np.arange(1000) >= row)), "time", "the clock was adjusted here"),
            ]
        )
    )


@settings(max_examples=60, deadline=None)
@given(wrongs())
def test_wrong_in_any_joint_at_any_row(wrong):
    """Whatever joint, row and size it has, what is wrong is told in its column, with its cause."""
    change, column, expected = wrong
    log = bench_log(3)
    table = {name: log.column(name).copy() for key in log.channels for name in log._columns(key)}
    change(table)
    arrays = {key: np.stack([table[name] for name in log._columns(key)], axis=-1) for key in log.channels}
    try:
        said = [str(finding.error(None)) for finding in examine(Rollout.from_arrays(arrays, log.metadata))]
    except LogError as error:
        said = [str(error)]
    assert any(column in sentence and re.search(expected, sentence) for sentence in said), said


def test_a_sound_log_has_no_findings(tmp_path):
    """The log that the cases are made from is silent."""
    for joints in (1, 3):
        (tmp_path / str(joints)).mkdir()
        assert read_log(write(tmp_path / str(joints), joints=joints)).findings == ()


def test_unwrap_and_shift(tmp_path):
    """One line in the YAML unwraps positions and moves their zero, and the log is what it was."""
    path = write(tmp_path, swings_around_pi, f"shift: {{joint_0: {-np.pi!r}}}\n")
    there, sound = read_log(path), bench_log()
    assert np.abs(there.array("joint/position") - sound.array("joint/position")).max() < 1e-9
    assert np.abs(there.array("command/position") - sound.array("command/position")).max() < 1e-9


@pytest.mark.parametrize("turns", [-1, 1, 2])
def test_unwrap(tmp_path, turns):
    """Turns that the encoder lost or won are taken out."""
    there = read_log(write(tmp_path, add("joint_0.position", 2 * np.pi * turns, 500), "unwrap: true\n"))
    assert np.abs(there.array("joint/position") - bench_log().array("joint/position")).max() < 1e-9


@pytest.mark.parametrize("change", [gap(400, 525), add("time", 3600, 500), add("time", -3.9, 500)])
def test_split(tmp_path, change):
    """A log with a hole is read as its parts."""
    parts = read_episodes(write(tmp_path, change, "split: true\n"))
    assert [part.metadata.recording for part in parts] == ["run/part-0", "run/part-1"]
    assert all(np.diff(part.column("time")).max() < 0.01 for part in parts)


def test_a_folder_of_ours_takes_no_options(tmp_path):
    """They would be passed over without a word."""
    bench_log().save(tmp_path / "a")
    with pytest.raises(LogError, match="a rollout folder is read unchanged, so unwrap does not apply"):
        read_episodes(tmp_path / "a", {"unwrap": True, "shift": None})


def test_options_name_what_they_do_not_know(tmp_path):
    """An option for a joint that is not there is refused."""
    with pytest.raises(LogError, match=r"field shift: knee.*joint_0"):
        read_log(write(tmp_path, side="shift: {knee: 1.0}\n"))


def test_scale(tmp_path):
    """A factor in the YAML mends a unit."""
    assert (
        read_log(write(tmp_path, scale(".*velocity", 57.29578), "scale: {joint_0.velocity: 0.01745329}\n")).findings
        == ()
    )


FORMS: dict[str, Callable[[str], bytes]] = {
    "semicolons and decimal commas": lambda text: _marks(text, ";").encode(),
    "tabs and decimal commas": lambda text: _marks(text, "\t").encode(),
    "tabs": lambda text: text.replace(",", "\t").encode(),
    "spaces": lambda text: text.replace(",", " ").encode(),
    "quoted decimal commas": lambda text: _marks(text, '","', '"').encode(),
    "UTF-16": lambda text: text.encode("utf-16"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "times of the day": lambda text: re.sub(r"(?m)^\d", lambda digit: f"23:05:0{digit[0]}", text).encode(),
    "dates": lambda text: re.sub(r"(?m)^\d", lambda digit: f"2026-01-15T23:05:0{digit[0]}", text).encode(),
    "a byte order mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "remarks": lambda text: ("# made on a Monday\n" + text + "# end\n").encode(),
    "remarks with commas": lambda text: ("# on a Monday, at noon\n% 1, 2\n" + text).encode(),
    "a header of numpy": lambda text: ("# " + text).encode(),
    "a header of numpy and dates": lambda text: re.sub(r"(?m)^\d", "2026-01-15T23:05:0\\g<0>", "# " + text).encode(),
    "a line for Excel": lambda text: ("sep=,\n" + text).encode(),
    "row numbers of pandas": lambda text: _numbered(text).encode(),
    "rows that pandas kept": lambda text: _numbered(text, 3).encode(),
    "commas at the end": lambda text: text.replace("\n", ",\n").encode(),
    "carriage returns": lambda text: text.replace("\n", "\r").encode(),
    "lines of spaces": lambda text: (text + "\n  \n\t\r\n").encode(),
    "packed by gzip": lambda text: gzip.compress(text.encode()),
    "packed by xz": lambda text: lzma.compress(text.encode()),
    "packed by bzip2": lambda text: bz2.compress(text.encode()),
}


def _marks(text: str, mark: str, quote: str = "") -> str:
    header, *rows = text.splitlines()
    lines = [quote + row.replace(",", ";").replace(".", ",").replace(";", mark) + quote for row in rows]
    return "\n".join([quote + header.replace(",", mark) + quote, *lines])


def _numbered(text: str, step: int = 1) -> str:
    return "\n".join(f"{(n - 1) * step if n else ''},{line}" for n, line in enumerate(text.splitlines()))


@pytest.mark.parametrize("form", FORMS)
def test_other_forms_of_csv(tmp_path, form):
    """What spreadsheets, numpy and pandas write is read as it is."""
    path = write(tmp_path)
    path.write_bytes(FORMS[form](path.read_text()))
    assert np.array_equal(read_log(path).array("joint/position"), bench_log().array("joint/position"))


def test_a_spreadsheet_is_no_table(tmp_path):
    """A zip archive, as of a spreadsheet, says so whatever its name is."""
    path, stream = write(tmp_path), io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("run.csv", path.read_text())
    path.write_bytes(stream.getvalue())
    with pytest.raises(LogError, match=r"run.csv: the file is a zip archive or a spreadsheet; unpack it, or export"):
        read_log(path)


def test_a_table_without_a_header(tmp_path):
    """Its first row is numbers, and the sentence says so."""
    path = write(tmp_path)
    path.write_text(path.read_text().partition("\n")[2])
    with pytest.raises(LogError, match=r"row 1: there is no header; the first row contains numbers"):
        read_log(path)


def test_folders_are_checked_too(tmp_path):
    """A rollout folder with a fault is refused as a CSV is, and a bad channel set aside."""
    log = bench_log(3)
    arrays = {key: log.array(key).copy() for key in log.channels}
    arrays["joint", "velocity"][:, 1] = 0
    Rollout.from_arrays(arrays, log.metadata).save(tmp_path / "a")
    assert read_log(tmp_path / "a").metadata.set_aside == ("joint_1.velocity",)
    arrays["joint", "position"] *= 57.3
    Rollout.from_arrays(arrays, log.metadata).save(tmp_path / "b")
    with pytest.raises(LogError, match=r"as if it were in deg"):
        read_log(tmp_path / "b")


def test_a_joint_that_hardly_moves_at_first_tells_no_clock(tmp_path):
    """A few hundredths of a radian by which it sags ahead of its target are no clock that runs apart."""

    def change(table: Table) -> None:
        time, early = table["time"], np.arange(len(table["time"])) < 340
        for name, ahead in (("target", 0.0), ("position", 0.4)):
            later = 3 * (table[f"joint_0.{name}"] - table[f"joint_0.{name}"][340])
            table[f"joint_0.{name}"] = np.where(early, 0.02 * np.sin(2 * (time + ahead)), later)
        table["joint_0.velocity"] = np.gradient(table["joint_0.position"], time)

    assert not any("clocks" in finding.problem for finding in read_log(write(tmp_path, change, joints=3)).findings)


def test_a_battery_of_two_cells_is_none_of_three(tmp_path):
    """Half as much again is measured as the metadata say."""
    volts = 1.5 * (bench_log().metadata.battery or 0.0)
    change: Change = lambda table: table.update({"joint_0.voltage": np.full(len(table["time"]), volts)})  # noqa: E731
    findings = read_log(write(tmp_path, change)).findings
    assert any("does not fit the battery of" in finding.problem for finding in findings)


@pytest.mark.parametrize(
    ("volts", "celsius", "told"),
    [
        ((11.8, 5.0), (40.0, 35.0), ()),
        ((11.8, 7.4), (40.0, 35.0), ("right.voltage",)),
        ((5.0, 5.0), (40.0, 35.0), ("left.voltage",)),
        ((11.8, 5.0), (104.0, 35.0), ("left.temperature",)),  # 40 C as a scale of Fahrenheit has it
    ],
)
def test_each_joint_has_the_limits_of_its_own_servo(tmp_path, volts, celsius, told):
    """A small servo behind a converter has another voltage than the battery, and none works beyond its shutdown."""
    mixed = {"servo: xm430-w210": "servo: xm430-w350\nloop: firmware", "right:": "right: {servo: xl330-m288}"}
    robot = write_robot(tmp_path, "base", mixed)
    time = np.arange(200)[:, None] / 125
    angle = 0.3 * np.sin(4 * time) * [1.0, 0.9]
    arrays = {"time": time, "command/position": angle, "joint/position": angle + 1e-4 * np.sin(9 * time)}
    arrays |= {"joint/voltage": np.full((200, 2), volts) + 0.01 * np.sin(time)}
    arrays |= {"joint/temperature": np.full((200, 2), celsius) + 0.1 * time}
    about = Metadata(("left", "right"), "real", "stand", 125.0, battery=11.1, robot_file=str(robot))
    found = [one for one in examine(Rollout.from_arrays(arrays, about)) if one.check == "supply and temperature"]
    assert tuple(one.column for one in found) == told
    assert all("F would be 40 C" in one.problem for one in found if "temperature" in (one.column or ""))


def test_an_orientation_upside_down_is_no_fault_of_the_accelerometer():
    """A quaternion whose parts were taken in another order: turning the accelerometer round would hide it."""
    log = bench_log()
    log.data["imu", "orientation"][:, 0] += np.pi
    (error,) = [one for one in examine(log) if one.check == "gravity"]
    assert "hangs upside down" in error.problem
    assert (error.column, error.severity) == ("imu.roll", "error")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (scale("joint_.*current", 0.5), "times gain times error"),
        (add("joint_1.current", 0.3), "current differs from gain times error by +0.3 A"),
        (edit("joint_.*current", np.abs), "current was recorded without its sign"),
    ],
)
def test_currents_that_are_not_the_laws(tmp_path, change, expected):
    """A gain of another size, another zero, and a size without its sign."""

    def lawful(table: Table) -> None:
        for joint in ("joint_0", "joint_1"):
            table[f"{joint}.p_gain"] = np.full(len(table["time"]), 6.0)
            table[f"{joint}.current"] = 6.0 * (table[f"{joint}.target"] - table[f"{joint}.position"])
        change(table)

    path = write(tmp_path, lawful, joints=2)
    assert any(expected in finding.problem for finding in read_log(path).findings)


def delay(pattern: str, rows: int) -> Change:
    """Columns come rows late."""
    return edit(pattern, lambda values: np.concatenate([np.repeat(values[:1], rows), values[:-rows]]))


def noise(pattern: str, size: float) -> Change:
    """White noise is added."""
    return edit(pattern, lambda values: values + size * np.random.default_rng(0).standard_normal(len(values)))


def rounded(pattern: str, step: float) -> Change:
    """Numbers lie on another grid."""
    return edit(pattern, lambda values: np.round(values / step) * step)


def held(rows: int) -> Change:
    """Sensors are read in every so many rows."""
    pattern = r"joint_\d\.(position|velocity)|imu.*"
    return edit(pattern, lambda values: values[np.arange(len(values)) // rows * rows])


COUNT = 2 * np.pi / 4096


@pytest.mark.parametrize(
    ("change", "column", "expected"),
    [
        (scale("joint_2.velocity", 1.1), "joint_2.velocity", "the velocity is 1.1 times"),
        (scale("joint_2.(position|target)", 1.1), "joint_2.velocity", "the velocity is 0.91"),
        (
            add("joint_2.velocity", 0.15),
            "joint_2.velocity",
            r"velocity differs from the change of position by \+0.15 rad/s",
        ),
        (delay("joint_2.velocity", 6), "joint_2.velocity", "velocity lags the change of position by 0.048 s"),
        (delay("joint_2.position", 6), "joint_2.velocity", "velocity leads the change of position by 0.048 s"),
        (noise("joint_2.velocity", 0.3), "joint_2.velocity", "scatters by 0.2"),
        (put("joint_2.velocity", 0.0, 580, 620), "joint_2.velocity", "diverge by"),
        (put("joint_2.velocity", 9.0, 500, 503), "joint_2.velocity", "diverge by"),
        (
            edit("joint_2.velocity", lambda values: values * (np.arange(1000) % 25 > 0)),
            "joint_2.velocity",
            r"is 0 in \d\d single rows",
        ),
        (scale("joint_2.position", 0.5), "joint_2.position", "and the velocity agrees with the command"),
        (
            edit("joint_2.target", lambda values: values * (np.arange(1000) % 5 > 0)),
            "joint_2.target",
            r"is 0 in \d+ single rows",
        ),
        (scale("joint_2.(position|velocity)", 1.6), "joint_2.position", r"moves 1.5\d times as far as its command"),
        (swap("imu.acc_x", "imu.acc_y"), "imu.acc_x", "the two axes are swapped"),
        (put("joint_2.position", np.nan, 580, 610), "joint_2.velocity", "diverge by"),
        (add("joint_2.position", 0.0), None, ""),
        (
            edit("joint_2.position", lambda values: values + 0.08 * (np.arange(1000) == 500)),
            "joint_2.position",
            "single",
        ),
        (put("joint_2.target", 3.0, 500), "joint_2.target", "a target of 3 is far from its neighbours"),
        (put("joint_2.target", 0.0, 550, 553), "joint_2.target", "a target of 0 is far from its neighbours"),
        (put("joint_2.target", np.nan, 500, 1000), "joint_2.target", "target does not change for 499 rows"),
        (
            rounded("joint_2.position", np.pi * 300 / 180 / 1023),
            "joint_2.position",
            "scaled, or come from another servo",
        ),
        (rounded("joint_2.(position|velocity)", 1.1 * COUNT), "joint_2.position", "scaled, or come from another servo"),
        (held(2), "time", "only every second row"),
        (add("imu.gyro_z", 0.1), "imu.gyro_z", r"differs from the change of orientation by \+0.10\d? rad/s"),
        (put("imu.acc_z", 150.0, 500), "imu.acc_z", "a single reading of 150"),
    ],
)
def test_mild_faults_of_one_joint_are_told(tmp_path, change, column, expected):
    """And nothing is said of the other joints."""
    side = "servo: xl330-m288\n" if "another servo" in expected else ""
    log = read_log(write(tmp_path, change, side, joints=5))
    told = {one.column for one in log.findings}
    assert told - {"field mass", "field servo"} == {column} - {None}  # those of another servo's pendulum
    assert all(re.search(expected, one.problem) for one in log.findings if one.column == column)


@pytest.mark.parametrize("column", ["imu.gyro_x", "imu.roll", "joint_0.position"])
def test_rows_in_which_nothing_was_read_are_told(tmp_path, column):
    """All axes, or all joints, are 0 in some rows."""
    names = (
        r"joint_\d.position"
        if "joint" in column
        else rf"{column[:-1]}."
        if "gyro" in column
        else r"imu.(roll|pitch|yaw)"
    )
    change = edit(names, lambda values: np.where(np.isin(np.arange(1000), [430, 431, 777]), 0.0, values))
    log = read_episodes(write(tmp_path, change, joints=2), check=False)[0]
    told = [one for one in examine(log) if "all values of the sensor are 0 in 3 rows" in one.problem]
    assert column in [one.column for one in told]


def test_a_number_that_stands_for_none_spares_the_position(tmp_path):
    """A velocity of -999 is set aside, and the position that stands meanwhile is not."""

    def change(table: Table) -> None:
        table |= {f"joint_1.{kind}": np.zeros(1000) for kind in ("target", "position", "velocity")}
        put("joint_1.velocity", -999.0, 300, 310)(table)

    assert read_log(write(tmp_path, change, joints=3)).metadata.set_aside == ("joint_1.velocity",)


def test_a_joint_that_follows_with_its_torque_off_is_told(tmp_path):
    """One that is led by hand, with targets that come 0.05 s after it, is not."""
    off: Change = lambda table: table.update({"joint_0.torque_enable": np.zeros(len(table["time"]))})  # noqa: E731
    assert any("its torque is off" in one.problem for one in read_log(write(tmp_path, off)).findings)

    def led(table: Table) -> None:
        off(table)
        table["joint_0.target"] = np.concatenate([np.zeros(6), table["joint_0.position"][:-6]])

    (other := tmp_path / "led").mkdir()
    assert not any("its torque is off" in one.problem for one in read_log(write(other, led)).findings)


def moving(rate: float, angle: Callable, velocity: Callable, seconds: float = 12, count: float = COUNT) -> Rollout:
    """A log of one joint, its position rounded to an encoder's count."""
    time = np.arange(round(seconds * rate)) / rate
    position = np.round(angle(time) / count) * count if count else angle(time)
    arrays = {"time": time, "command/position": 1.1 * angle(time)[:, None], "joint/position": position[:, None]}
    return Rollout.from_arrays(
        {**arrays, "joint/velocity": velocity(time, position)[:, None]}, Metadata(("joint",), "real", "stand", rate)
    )


def three_sines(time: np.ndarray) -> np.ndarray:
    """Slow enough for logs of a few rows per second."""
    return 0.5 * np.sin(2 * time) + 0.15 * np.sin(5.3 * time) + 0.05 * np.sin(9.1 * time)


ESTIMATORS: dict[str, Callable] = {
    "true": lambda time, _: np.cos(2 * time) + 0.795 * np.cos(5.3 * time) + 0.455 * np.cos(9.1 * time),
    "central": lambda time, position: np.gradient(position, time),
    "backward": lambda time, position: np.diff(position, prepend=position[0]) / (time[1] - time[0]),
    "forward": lambda time, position: np.diff(position, append=position[-1]) / (time[1] - time[0]),
}


@pytest.mark.parametrize("rate", [5.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0, 1000.0])
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_velocities_that_were_differences_are_sound_at_any_rate(rate, estimator):
    """A row more or less of delay, and what a difference over few rows loses, are no faults."""
    log = moving(rate, three_sines, ESTIMATORS[estimator], seconds=20)
    assert not [one for one in examine(log) if one.check == "velocity against position"]


@pytest.mark.parametrize("kind", ["absolute", "relative", "increments"])
def test_commands_that_say_how_far_to_go_are_refused(kind):
    """A target less the position there, as actions of learned policies often are, or less the target before."""
    log = moving(50 if kind == "relative" else 100, three_sines, ESTIMATORS["true"], seconds=20)
    goal = three_sines(log.array("time") + 0.12)
    less = {"absolute": 0.0, "relative": log.array("joint/position"), "increments": np.roll(goal, 1, 0)}
    found = examine(changed(log, command__position=goal - less[kind]))
    assert any("a relative movement, not a target position" in one.problem for one in found) == (kind != "absolute")


def test_a_position_that_is_the_command_some_rows_later_is_refused():
    """A controller's reference in the place of what was measured."""
    log = moving(100, three_sines, ESTIMATORS["true"], seconds=20)
    for noise, told in ((0.0, True), (0.002, False)):
        late = np.roll(log.array("command/position"), 5, 0) + noise * np.sin(np.arange(log.rows))[:, None]
        found = examine(changed(log, joint__position=late))
        assert any("every value equals the command" in one.problem for one in found) == told


def stepped(limit: float = np.inf) -> tuple[np.ndarray, ...]:
    """Time, target, position, velocity and current of a joint that rests for two seconds and is then told to step."""
    time = np.arange(1000) / 100
    target = np.where(time < 2, 0.0, np.where(np.floor(time / 2) % 2, 0.5, -0.4))
    angle, speed = np.zeros((2, len(time)))
    current = np.zeros(len(time))
    for row in range(1, len(time)):
        angle[row], speed[row] = angle[row - 1], speed[row - 1]
        for _ in range(10):
            current[row] = np.clip(8 * (target[row - 1] - angle[row]) - 0.3 * speed[row], -limit, limit)
            speed[row] += 1e-3 * (current[row] - 0.35 * speed[row] - 0.1 * np.tanh(speed[row] / 0.03)) / 0.02
            angle[row] += 1e-3 * speed[row]
    step = 2 * np.pi / 4096
    return time, target, np.round(angle / step) * step, speed, np.round(current / 0.00269) * 0.00269


@pytest.mark.parametrize("limit", [np.inf, 0.4])
def test_a_joint_that_rests_before_it_steps_is_sound(limit):
    """Also where a limit of the current decides how fast, and where its torque is off at first."""
    time, *arrays = stepped(limit)
    target, angle, speed, current = (array[:, None] for array in arrays)
    given = {"time": time[:, None], "command/position": target, "joint/position": angle, "joint/velocity": speed}
    given |= {"joint/current": current}
    for more in ({}, {"command/torque_enable": 1.0 * (time[:, None] >= 2)}):
        log = Rollout.from_arrays({**given, **more}, Metadata(("elbow",), "real", "stand", 100.0))
        assert not examine(log)


@pytest.mark.parametrize("joints", [1, 3])
def test_a_zero_that_is_a_quarter_turn_off_is_told(tmp_path, joints):
    """No servo yields by so much, whatever gravity does there."""
    log = read_log(write(tmp_path, add(r"joint_0.position", np.pi / 2), joints=joints))
    assert any("rad from its command in every pose" in one.problem for one in log.findings)


def test_a_cell_without_a_number_is_told_once(tmp_path, caplog):
    """What stands in the place of a channel that is set aside is not looked at."""
    path = write(tmp_path, lambda table: table.update({"joint_0.current": 0.4 * table["joint_0.velocity"]}))
    text = path.read_text().splitlines()
    index = text[0].split(",").index("joint_0.current")
    text[500] = ",".join("" if i == index else cell for i, cell in enumerate(text[500].split(",")))
    path.write_text("\n".join(text) + "\n")
    (found,) = (one for one in read_log(path).findings if one.column == "joint_0.current")
    assert found.problem == "1 of 1000 rows contain no number"
    assert "1 of 1000 rows contain no number" in caplog.text


def test_loads_with_their_sign_in_bit_ten_are_told(tmp_path):
    """As small servos of several makers tell them."""

    def change(table: Table) -> None:
        load = np.round(500 * np.sin(2 * table["time"]))
        table["joint_0.load"] = np.where(load < 0, 1024 - load, load)

    (found,) = (one for one in read_log(write(tmp_path, change)).findings if one.column == "joint_0.load")
    assert "have their sign in bit 10" in found.problem
    assert found.set_aside


def test_a_joint_that_goes_limp_is_told():
    """It stays within a step of its sensor, which its noise changes, while another one goes on."""
    log = moving(100, three_sines, ESTIMATORS["true"], seconds=20)
    rows, step = np.arange(log.rows), 2 * np.pi / 4096
    target, angle = (np.repeat(log.array(key), 2, axis=1) for key in ("command/position", "joint/position"))
    angle[1201:, 0] = angle[1200, 0] + step * (rows[1201:] % 7 == 0)
    arrays = {"time": log.array("time"), "command/position": target, "joint/position": angle}
    (found,) = examine(Rollout.from_arrays(arrays, dataclasses.replace(log.metadata, joints=("elbow", "wrist"))))
    assert (found.check, found.column) == ("torque lost", "elbow.position")
    assert found.rows is not None
    assert 1180 < found.rows[0] < 1280


def test_an_orientation_that_stops_is_set_aside():
    """While the gyroscope goes on to and fro; where it turns by its own zero only, the trunk may stand."""
    log = bench_log()
    angles = log.array("imu/orientation").copy()
    angles[400:] = angles[400]
    found = examine(changed(log, imu__orientation=angles))
    assert any("values of orientation are constant for 599 rows" in one.problem and one.set_aside for one in found)
    rates = np.where(np.arange(log.rows)[:, None] < 400, log.array("imu/angular_velocity"), 0.03)
    found = examine(changed(log, imu__orientation=angles, imu__angular_velocity=rates))
    assert not any("orientation keeps" in one.problem for one in found)


@pytest.mark.parametrize(("factor", "said"), [(180 / np.pi, "deg/s"), (-1.0, "gravity turns"), (1.0, "")])
def test_a_gyroscope_without_an_orientation_is_held_against_gravity(factor, said):
    """Unit and sign are told by how the trunk tilts."""
    log = bench_log()
    keys = [key for key in log.channels if key != ("imu", "orientation")]
    arrays = {key: log.array(key) * (factor if key == ("imu", "angular_velocity") else 1.0) for key in keys}
    found = [one for one in examine(Rollout.from_arrays(arrays, log.metadata)) if (one.column or "").startswith("imu")]
    assert any(said in one.problem for one in found) == bool(said)


@pytest.mark.parametrize("speed", [0.1, 0.2])
def test_friction_in_a_slow_motion_is_no_late_clock(speed):
    """A soft loop follows a triangle by what its friction asks for, which at a slow speed is a long time."""
    time = np.arange(3000) / 100
    target = np.abs((speed * time + 0.5) % 2 - 1) - 0.5
    position = target - 0.03 * np.sign(np.gradient(target)) - 0.02 * np.sin(target)
    arrays = {"time": time[:, None], "command/position": target[:, None], "joint/position": position[:, None]}
    assert not examine(Rollout.from_arrays(arrays, Metadata(("elbow",), "real", "stand", 100.0)))


def test_late_commands_are_no_turned_sign():
    """Several sines that come half a period late are against their position for the most part."""
    log = moving(100, three_sines, ESTIMATORS["true"], seconds=20)
    (found,) = examine(changed(log, command__position=three_sines(log.array("time") - 0.5)))
    assert "comes before its command" in found.problem


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sign_is_told_of_a_joint_that_follows_badly(sign):
    """Pushed about by what it carries as it walks, it is against its command for the most part."""
    time = np.arange(1500)[:, None] / 100
    target = 0.25 + 0.2 * np.sin(5 * time) + 0.2 * np.sin(3.1 * time)
    position = 0.25 + 0.2 * np.sin(5 * time - 0.3) + 0.2 * np.sin(3.1 * time - 0.2) + 0.15 * np.sin(11 * time)
    arrays = {"time": time, "command/position": target, "joint/position": sign * position}
    found = examine(Rollout.from_arrays(arrays, Metadata(("knee",), "real", "stand", 100.0)))
    assert ["moves opposite to its command" in one.problem for one in found] == [True] * (sign < 0)


def test_zeros_of_most_joints_are_told(tmp_path):
    """Of a robot that was not calibrated; what most have is no usual sag where it is so much."""
    log = read_log(write(tmp_path, add(r"joint_[0-3].position", 0.7), joints=6))
    told = {one.column for one in log.findings if "from its command in every pose" in one.problem}
    assert {f"joint_{i}.position" for i in range(4)} <= told


def test_an_accelerometer_that_reads_downwards_is_told_without_an_orientation(tmp_path):
    """And its gyroscope is not blamed for it."""

    def change(table: Table) -> None:
        for axis in "xyz":
            table[f"imu.acc_{axis}"] *= -1
        for axis in ("roll", "pitch", "yaw"):
            del table[f"imu.{axis}"]

    found = [one for one in read_log(write(tmp_path, change)).findings if (one.column or "").startswith("imu")]
    assert ["as if the trunk hung upside down" in one.problem for one in found] == [True]


def test_a_gyroscope_that_is_read_rarely_is_told(tmp_path):
    """Beside sensors that are read in every row; it is not cut off."""
    every_fifth = edit("imu.gyro.*", lambda values: values[np.arange(len(values)) // 5 * 5])
    told = {one.problem for one in read_log(write(tmp_path, every_fifth)).findings}
    assert "the trunk's sensor has new values only every 5 rows" in told
    assert not any("cut off" in problem for problem in told)


def test_a_clock_at_half_its_speed_is_told(tmp_path):
    """All velocities are twice the change of their positions."""
    side = "rate: 62.5"
    path = write(tmp_path, lambda table: table.update(time=2 * table["time"]), joints=3)
    path.with_suffix(".yaml").write_text(re.sub("rate: .*", side, path.with_suffix(".yaml").read_text()))
    told = [one.problem for one in read_log(path).findings if str(one.column).endswith("velocity")]
    assert told
    assert all("as if the clock ran at 2 times its speed" in problem for problem in told)


def test_a_misspelt_option_is_refused_by_its_name(tmp_path):
    """In the YAML and in a call."""
    with pytest.raises(LogError, match="'unwrapp': no such field; rename it to unwrap if that is what you mean"):
        read_log(write(tmp_path, side="unwrapp: true\n"))
    (tmp_path / "other").mkdir()
    with pytest.raises(LogError, match="'spllit' is not an import option; rename it to split"):
        read_episodes(write(tmp_path / "other"), {"spllit": True})


def test_a_sensor_that_is_tilted_in_the_trunk_is_told():
    """By how much; no sign would mend it."""
    log = bench_log()
    force = Rotation.from_euler("y", 0.35).apply(log.array("imu/linear_acceleration"))
    (found,) = (one for one in examine(changed(log, imu__linear_acceleration=force)) if one.check == "gravity")
    assert "0.35 rad apart: the sensor is mounted at an angle in the trunk" in found.problem


def test_rates_in_the_frame_of_the_world_are_refused():
    """As some simulators tell them; in the body they are others as soon as it has turned."""
    log = bench_log()
    turned = log.array("imu/orientation") * [1, 1, 0] + [0, 0, 1.2]
    rates = Rotation.from_euler("ZYX", turned[:, ::-1])
    body = np.diff(turned, axis=0, append=turned[-1:]) * RATE
    body[:-1] = (rates[:-1].inv() * rates[1:]).as_rotvec() * RATE
    force = rates.inv().apply([0, 0, 9.81])
    for read, told in ((body, False), (rates.apply(body), True)):
        arrays = dict(imu__orientation=turned, imu__angular_velocity=read, imu__linear_acceleration=force)
        found = examine(changed(log, **arrays))
        assert any("in the world frame" in one.problem for one in found) == told


def noised(time: np.ndarray, size: float) -> np.ndarray:
    """White noise."""
    return size * np.random.default_rng(0).standard_normal(len(time))


def rest_and_go(time: np.ndarray) -> np.ndarray:
    """Two moves of 1.5 s in ten, without jerk."""
    share = (np.clip((time[:, None] - [2.0, 6.0]) / 1.5, 0, 1)).T
    return (10 * share**3 - 15 * share**4 + 6 * share**5).sum(0)


def jump(time: np.ndarray) -> np.ndarray:
    """A leg that reaches 20 rad/s in 80 ms and is stopped."""
    return np.cumsum(np.where((time > 3) & (time < 3.08), 250 * (time - 3), 0.0)) * (time[1] - time[0])


@pytest.mark.parametrize(
    "log",
    [
        moving(200, rest_and_go, lambda t, p: np.gradient(rest_and_go(t), t), count=0.0),
        moving(100, jump, lambda t, p: np.where((t > 3) & (t < 3.08), 250 * (t - 3), 0.0)),
        moving(
            1000, lambda t: 0.3 * np.sin(0.2 * t), lambda t, p: 0.06 * np.cos(0.2 * t) + noised(t, 0.1), count=COUNT / 4
        ),
        moving(125, lambda t: 0.06 * np.sin(25 * t), lambda t, p: 1.342 * np.cos(25 * t - 0.4636)),
        moving(125, lambda t: 0.25 * np.sin(1.3 * t), lambda t, p: np.trunc(0.325 * np.cos(1.3 * t) / 0.0767) * 0.0767),
    ],
    ids=["rests", "jumps", "noisy and slow", "filtered", "truncated"],
)
def test_unusual_velocities_that_are_sound(log):
    """What the motion, the sensor's step and a usual filter explain is not told."""
    assert not [one for one in examine(log) if one.check == "velocity against position"]


def test_a_fault_at_the_end_of_a_short_log_is_told():
    """Windows are shorter there."""
    sine = lambda t: 0.5 * np.sin(6 * t)  # noqa: E731
    log = moving(125, sine, lambda t, p: np.where(np.abs(t - 0.88) < 0.015, 12.0, 3 * np.cos(6 * t)), seconds=0.96)
    assert any("diverge by" in one.problem for one in examine(log))


def test_a_velocity_that_was_smoothed_is_told(tmp_path):
    """By how a motion of several frequencies loses its fast ones."""
    time = np.arange(1000)[:, None] / RATE
    angle = 0.3 * np.sin(3 * time) + 0.1 * np.sin(11 * time)
    rate, window = np.gradient(angle[:, 0], 1 / RATE), np.ones(37) / 37
    for smoothed in (False, True):
        read = np.convolve(rate, window, "same") if smoothed else rate
        arrays = {"time": time, "command/position": 1.1 * angle, "joint/position": np.round(angle / COUNT) * COUNT}
        arrays["joint/velocity"] = np.round(read[:, None] / 0.024) * 0.024
        log = Rollout.from_arrays(arrays, Metadata(("joint",), "real", "stand", RATE))
        assert [one.problem for one in examine(log)] == ["velocity is smoothed over 0.2 s or more"] * smoothed


def test_rows_that_are_missing_without_a_gap_in_time(tmp_path):
    """Position and command leap together: the recorder counted rows."""

    def cut(table: Table) -> None:
        time = table["time"]
        table.update({name: np.delete(values, slice(380, 430)) for name, values in table.items()})
        table["time"] = time[: len(table["time"])]

    with pytest.raises(LogError, match="and so does its command: rows are missing there"):
        read_log(write(tmp_path, cut))


def test_a_servo_that_the_robot_does_not_have_is_told(tmp_path):
    """The robot's file says which it has."""
    time = np.arange(200)[:, None] / 125
    arrays = {"time": time, "command/position": 0.3 * np.sin(4 * time), "joint/position": 0.29 * np.sin(4 * time)}
    log = Rollout.from_arrays(arrays, Metadata(("r_knee",), "real", "stand", 125.0, robot_file="op3", servo="sts3032"))
    assert any("op3 has xm430-w350" in one.problem for one in examine(log))


def test_a_joint_that_the_named_robot_lacks_refuses_the_log():
    """The metadata contradict each other, which no use of the log can mend."""
    log = bench_log()
    log = Rollout(log.data, log.metadata.replace(mount="stand", robot_file="op3"))
    found = [(one.severity, one.problem) for one in examine(log)]
    assert ("error", "joint_0 is not a joint of op3") in found


@pytest.mark.parametrize(("sign", "told"), [(-1.0, False), (1.0, True)])
def test_a_joint_beyond_the_limits_of_its_robot_is_told(sign, told):
    """A knee that bends the wrong way all the time has its sign turned round, though its channels agree."""
    time = np.arange(500)[:, None] / 125
    angle = sign * (0.9 + 0.3 * np.sin(4 * time))
    arrays = {"time": time, "command/position": angle, "joint/position": angle + 1e-4 * np.sin(9 * time)}
    log = Rollout.from_arrays(arrays, Metadata(("r_knee",), "real", "stand", 125.0, robot_file="op3"))
    assert any("the limits of op3" in finding.problem for finding in examine(log)) == told


@pytest.mark.parametrize(("last", "told"), [(999, 3), (470, 2)])
def test_commands_that_stop_while_the_joints_go_on_are_told(tmp_path, last, told):
    """The recorder lost the stream of targets after a third, or for a second, after which one joint was back."""
    change = put(r"joint_\d.target", np.nan, 340, last)
    findings = read_log(write(tmp_path, change, joints=3)).findings
    assert sum("the target does not change for" in finding.problem for finding in findings) == told
    (tmp_path / "sound").mkdir()
    sound = read_log(write(tmp_path / "sound", joints=3)).findings
    assert not any("the target does not" in finding.problem for finding in sound)


def test_what_is_alike_in_several_joints_is_told_once():
    """The numbers differ, the cause does not; a fault of one joint beside it keeps its own line."""
    log = bench_log(joints=4)
    arrays = {key: log.array(key).copy() for key in log.channels}
    arrays["joint", "velocity"] *= 60 / (2 * np.pi)
    arrays["joint", "velocity"][:, 2] = arrays["joint", "velocity"][300, 2]
    found = examine(Rollout.from_arrays(arrays, log.metadata))
    assert len(found) == 4
    told = merge_findings(found)
    assert sorted(one.column for one in told) == ["joint_0.velocity", "joint_2.velocity"]
    assert next(one for one in told if one.column == "joint_0.velocity").problem.endswith("(also in joint_1, joint_3)")


def test_joints_that_sway_together_are_not_exchanged():
    """A standing robot's joints follow one another, round in no circle; where two columns were exchanged they do."""
    log = bench_log(joints=3)
    arrays = {key: log.array(key).copy() for key in log.channels}
    sway = arrays["command", "position"]
    other = np.roll(sway, 1, axis=1)
    arrays["joint", "position"] = np.stack([sway[:, 1], sway[:, 2], sway[:, 2]], 1)
    arrays["joint", "velocity"] = np.gradient(arrays["joint", "position"], arrays["time"][:, 0], axis=0)
    shaken = examine(Rollout.from_arrays(arrays, log.metadata))
    assert not [one for one in shaken if "are swapped" in one.problem]
    arrays["joint", "position"] = other
    arrays["joint", "velocity"] = np.gradient(other, arrays["time"][:, 0], axis=0)
    exchanged = [one for one in examine(Rollout.from_arrays(arrays, log.metadata)) if "are swapped" in one.problem]
    assert len(exchanged) == 3
    assert merge_findings(exchanged) == exchanged  # each is of another joint, though names differ in a number


def test_a_robot_that_stands_and_falls_has_an_orientation():
    """What the gyroscope says of the fall is no bias of the time before."""
    log = bench_log()
    arrays = {key: log.array(key).copy() for key in log.channels}
    falls = np.clip(arrays["time"][:, 0] - 7.0, 0.0, None) ** 2
    arrays["imu", "orientation"] = np.round(np.stack([0 * falls, falls, 0 * falls], 1) / 0.001745) * 0.001745
    arrays["imu", "angular_velocity"] = np.stack([0 * falls, np.gradient(falls, arrays["time"][:, 0]), 0 * falls], 1)
    rng = np.random.default_rng(0)
    arrays["imu", "angular_velocity"] += 0.004 * rng.standard_normal((1000, 3))
    arrays["imu", "linear_acceleration"] = 9.81 * np.stack([-np.sin(falls), 0 * falls, np.cos(falls)], 1)
    found = examine(Rollout.from_arrays(arrays, log.metadata))
    assert not [one for one in found if "orientation" in one.problem]


def test_a_velocity_of_one_count_is_not_cut_off():
    """A joint that sways by little reads its least velocity often; its angle is faster, and nothing limits it."""
    log = bench_log()
    arrays = {key: log.array(key).copy() for key in log.channels}
    sway = 0.02 * np.sin(9 * arrays["time"])
    arrays["command", "position"], arrays["joint", "position"] = sway, 0.9 * sway
    arrays["joint", "velocity"] = (
        0.024 * np.sign(np.cos(9 * arrays["time"])) * (np.abs(np.cos(9 * arrays["time"])) > 0.7)
    )
    found = examine(Rollout.from_arrays(arrays, log.metadata))
    assert not [one for one in found if one.check == "saturated"]


@pytest.mark.parametrize(("limited", "rest"), [(40, 0.015), (60, 0.015), (40, 0.0)])
def test_currents_that_the_supply_limits_are_in_their_unit(tmp_path, limited, rest):
    """Between steps a joint's current is gain times error; what a step wants is more than the supply gives."""

    def stepped(table: Table) -> None:
        time = np.arange(1000) % 100
        sign = 1 - 2 * (np.arange(1000) // 100 % 2)
        error = sign * np.where(time < limited, 0.5, np.where(time < limited + 20, 0.03, rest))
        for joint in ("joint_0", "joint_1", "joint_2"):
            table[f"{joint}.target"] = table[f"{joint}.position"] + error
            table |= {f"{joint}.p_gain": np.full(1000, 6.0), f"{joint}.current": np.clip(6.0 * error, -0.3, 0.3)}

    log = read_log(write(tmp_path, stepped, joints=3))
    assert not [one for one in log.findings if "times gain times error" in one.problem]


def test_a_joint_that_a_stuck_ones_loop_shakes_is_not_swapped_with_it(tmp_path):
    """One joint hardly follows a large command, and another without any is shaken in step with it, by a tenth of it."""

    def shaken(table: Table) -> None:
        wanted = 0.6 * np.sin(7 * table["time"])
        table |= {"joint_0.target": wanted, "joint_0.position": 0.2 * np.sin(7 * table["time"] - 1.2)}
        table |= {"joint_1.target": np.zeros(1000), "joint_1.position": 0.07 * np.roll(wanted, 4)}

    (tmp_path / "shaken").mkdir()
    assert not [
        one for one in read_log(write(tmp_path / "shaken", shaken, joints=3)).findings if "swapped" in one.problem
    ]

    def swapped(table: Table) -> None:
        shaken(table)
        table["joint_1.position"] = 0.9 * np.roll(table["joint_0.target"], 4)
        table["joint_0.position"] = np.zeros(1000)

    with pytest.raises(LogError, match="the columns of the two are swapped"):
        read_log(write(tmp_path, swapped, joints=3))


def test_a_slowly_estimated_velocity_at_its_peaks_is_not_cut_off():
    """A few rows of one count at the top of a sine, where the angle is faster by no more than its counts leave open."""
    log = bench_log()
    arrays = {key: log.array(key).copy() for key in log.channels}
    phase = 6 * arrays["time"]
    angle = 0.378 / 6 * np.sin(phase)
    arrays["command", "position"], arrays["joint", "position"] = angle, np.round(angle / 0.00153) * 0.00153
    arrays["joint", "velocity"] = np.round(0.315 * np.cos(phase - 0.1) / 0.024) * 0.024
    found = examine(Rollout.from_arrays(arrays, log.metadata))
    assert not [one for one in found if one.check == "saturated"]


def changed(log: Rollout, **channels: np.ndarray) -> Rollout:
    """The log with channels (`joint__position`) in the place of its own."""
    arrays = {key: log.array(key) for key in log.channels}
    return Rollout.from_arrays({**arrays, **{name.replace("__", "/"): v for name, v in channels.items()}}, log.metadata)


@pytest.mark.parametrize(("first", "last"), [(200, 800), (0, 1000)])
def test_a_position_that_stands_while_its_small_command_moves_is_told(first, last):
    """Half of what tells a blocked joint anywhere, in a robot that follows its commands far more closely."""
    log = bench_log(joints=3)
    target, position = 0.25 * log.array("command/position"), 0.25 * log.array("joint/position")
    sound = changed(log, command__position=target, joint__position=position, joint__velocity=0 * position)
    frozen = position.copy()
    frozen[first:last, 1] = frozen[first, 1]
    frozen = changed(sound, joint__position=frozen)
    told = [one for one in examine(frozen) if "position st" in one.problem or one.check == "torque lost"]
    assert [one.column for one in told] == ["joint_1.position"]
    assert not [one for one in examine(sound) if "position stays" in one.problem]


def test_a_weak_joint_that_sticks_is_not_dead():
    """Its command moves no further while it stands than its error does while it moves."""
    log = bench_log()
    position = log.array("joint/position").copy()
    for row in range(1, len(position)):  # moves only when its command is 0.15 rad away
        error = log.array("command/position")[row, 0] - position[row - 1, 0]
        position[row] = position[row - 1] + np.sign(error) * max(abs(error) - 0.15, 0.0)
    weak = changed(log, joint__position=position, joint__velocity=np.gradient(position, 1 / RATE, axis=0))
    assert not [one for one in examine(weak) if one.check == "stuck value"]


@pytest.mark.parametrize(("late", "told"), [(0.1, False), (0.5, True)])
def test_a_slow_motion_tells_a_delay_too(late, told):
    """Half a second is little beside a period of a minute, and still explains far more than what servos need."""
    log = bench_log()
    time = np.arange(0, 30, 0.02)
    wave = [0.3 * np.sin(0.1 * at) + 0.02 * np.sin(at) for at in (time, time - late)]
    target, position = (values[:, None] for values in wave)
    arrays = {"time": time, "command/position": target, "joint/position": np.round(position / 0.00153) * 0.00153}
    found = examine(Rollout.from_arrays(arrays, log.metadata.replace(rate=50.0, firmware_gain=None)))
    assert ["two clocks"] * told == [one.check for one in found]


def test_a_wrong_clock_is_the_only_cause_that_is_told(tmp_path):
    """What is computed with it is wrong as well, and says nothing."""
    path = write(tmp_path, scale("time", 1e-3))
    sidecar = path.with_suffix(".yaml")
    sidecar.write_text(sidecar.read_text().replace("rate: 125.0\n", "rate: 125000\n"))
    (log,) = read_episodes(path, check=False)
    (finding,) = examine(log)
    assert "as if milliseconds had been read as microseconds" in finding.remedy


@pytest.mark.parametrize("mirrored", [False, True])
def test_columns_that_were_exchanged_are_told_so(mirrored):
    """Two joints that move alike about other angles, or as mirror images: no offsets, and no signs turned round."""
    log = bench_log(joints=5)
    target, position = log.array("command/position").copy(), log.array("joint/position").copy()
    for values, lag in ((target, 0.0), (position, 0.03)):
        wave = 0.3 * np.sin(4 * (log.array("time")[:, 0] - lag))
        values[:, 1], values[:, 2] = 1.0 + wave, -1.0 - wave if mirrored else 0.5 + wave
    velocity = np.gradient(position, 1 / RATE, axis=0)
    sound = changed(log, command__position=target, joint__position=position, joint__velocity=velocity)
    assert not examine(sound)
    order = [0, 2, 1, 3, 4]
    swapped = changed(sound, joint__position=position[:, order], joint__velocity=velocity[:, order])
    found = [one for one in examine(swapped) if one.column in ("joint_1.position", "joint_2.position")]
    assert ["are swapped" in one.problem and one.severity for one in found] == ["error", "error"]


def test_a_joint_without_gain_does_not_follow(tmp_path):
    """A robot that was switched off lies as it fell; none of its joints has another zero."""

    def off(table: Table) -> None:
        driven(table)
        edit("joint_2.position", lambda values: values + 0.6)(table)
        edit("joint_2.target", lambda values: 0 * values)(table)
        edit(".*(p_gain|current)", lambda values: 0 * values)(table)

    assert not [one for one in read_log(write(tmp_path, off, joints=3)).findings if "stays" in one.problem]


def test_a_soft_joint_that_swings_yields_all_the_same():
    """Damping is as large as what pulls it, and has no mean."""
    log = bench_log(joints=5)
    position, ones = log.array("joint/position").copy(), np.ones((1000, 5))
    position[:, 2] += 0.4
    velocity = np.gradient(position, 1 / RATE, axis=0)
    current = 0.15 * (log.array("command/position") - position) - 0.1 * velocity
    gains = dict(command__p_gain=0.15 * ones, joint__current=current, joint__position=position)
    assert not [one for one in examine(changed(log, **gains)) if one.check == "constant offset"]


def test_a_knock_is_no_single_reading():
    """A velocity leaps for a row, and the position with it."""
    log = bench_log()
    time, position = log.array("time")[:, 0], 0 * log.array("joint/position")
    position[:, 0] = 0.08 * (time > 4.0) * np.exp(-4 * np.clip(time - 4.004, 0, None))
    velocity = np.diff(position, axis=0, prepend=position[:1]) * RATE
    knocked = changed(log, command__position=0 * position, joint__position=position, joint__velocity=velocity)
    assert np.abs(velocity).max() > 9.0
    assert not [one for one in examine(knocked) if one.check == "single readings"]


@pytest.mark.parametrize(("size", "told"), [(0.8, True), (0.9, True), (0.99, False), (1.1, True)])
def test_angles_that_were_scaled_show_in_the_velocities_of_all_joints(size, told):
    """No joint is so far off that it is a fault of its own; all of them together are."""
    log = bench_log(joints=3)
    scaled = changed(log, joint__position=size * log.array("joint/position"))
    found = [one.column for one in examine(scaled) if one.check == "velocity against position"]
    assert found == [f"joint_{joint}.velocity" for joint in (0, 1, 2)] * told


def pendulum(**about) -> Rollout:
    """An STS3032 that swings 0.45 kg slowly at 0.1 m, with some friction; gains and errors obey its law."""
    make = load_servo("sts3032")
    assert make.position_law is not None
    time = np.arange(1000) / RATE
    angle = 1.2 * np.sin(2 * time)
    speed, bend = 2.4 * np.cos(2 * time), -4.8 * np.sin(2 * time)
    torque = 0.45 * 0.1 * (9.81 * np.sin(angle) + 0.1 * bend) + 0.02 * np.tanh(speed / 0.2)
    duty = torque * make.motor.terminal_resistance.si / make.output_constant / 6.0
    target = angle + duty / (8 * make.position_law.error_gain.si)
    arrays = {"time": time, "command/position": target, "joint/position": np.round(angle / 0.00153) * 0.00153}
    said = {**dict(mass=0.45, length=0.1, battery=6.0, firmware_gain=8.0, servo="sts3032"), **about}
    table = {name: values[:, None] for name, values in arrays.items()}
    table["command/firmware_gain"] = np.full((1000, 1), said["firmware_gain"])
    return Rollout.from_arrays(table, Metadata(("servo",), "rig", "pendulum", RATE, **said))


@pytest.mark.parametrize(
    ("about", "told"),
    [({}, []), ({"mass": 0.99}, [0.45]), ({"firmware_gain": 0.8}, [0.1]), ({"length": 2.0}, [0.05])],
)
def test_a_servo_pushes_with_what_its_pendulum_weighs(about, told):
    """Pounds for kilograms, a tenth of the gain and another length show in what it pushes with."""
    found = [one.problem for one in examine(pendulum(**about)) if one.check == "weight of the pendulum"]
    pushed = [float(problem.partition("torque is ")[2].partition(" ")[0]) for problem in found]
    assert pushed == pytest.approx(told, rel=0.1)


def test_duty_is_the_firmwares_gain_times_error():
    """Where the servo tells its duty, a gain of 80 where 800 is meant shows in it."""
    log, law = bench_log(), load_servo("xl330-m288").position_law
    assert law is not None
    duty = 800 * law.error_gain.si * (log.array("command/position") - log.array("joint/position"))
    told = {(800.0, 1): None, (80.0, 1): "duty is 10 times gain times error", (800.0, 100): "as if it were in percent"}
    for (gain, unit), said in told.items():
        arrays = {key: log.array(key) for key in log.channels} | {("joint", "duty"): unit * duty}
        arrays["command", "firmware_gain"] = np.full_like(duty, gain)
        about = log.metadata.replace(servo="xl330", firmware_gain=gain, mount="stand")
        problems = [one.problem for one in examine(Rollout.from_arrays(arrays, about)) if "duty" in one.problem]
        assert [said is not None and said in one for one in problems] == [True] * (said is not None)


@pytest.mark.parametrize(("name", "told"), [("xl330", None), ("sts3302", "rename it to sts3"), ("acme", "use one of")])
def test_a_servo_of_which_nothing_is_known_is_told(name, told):
    """Its law and units are guesses then; the nearest name is named."""
    found = [one for one in examine(bench_log(servo=name)) if one.check == "unknown servo"]
    assert [told in one.remedy for one in found] == [True] * (told is not None)


def test_a_few_rows_are_told():
    """Hardly any check looks at them."""
    (part,) = [bench_log().between(0.0, 4.5 / RATE)]
    assert [one.problem for one in examine(part)] == ["5 rows are too few for the checks"]


def trunk_log(mount: str, turns: float, noise: float) -> Rollout:
    """Three joints that move while the trunk nods by so much [rad], seen by all inertial sensors."""
    log, rng = bench_log(joints=3), np.random.default_rng(0)
    time = log.array("time")[:, 0]
    pitch = turns / 2 * np.sin(3 * time)
    zero = np.zeros(1000)
    force = 9.81 * np.stack([-np.sin(pitch), zero, np.cos(pitch)], 1) + noise * rng.standard_normal((1000, 3))
    imu = dict(
        imu__orientation=np.stack([zero, pitch, zero], 1),
        imu__angular_velocity=np.stack([zero, 1.5 * turns * np.cos(3 * time), zero], 1),
        imu__linear_acceleration=force,
    )
    there = changed(log, **imu)
    return Rollout.from_arrays({k: there.array(k) for k in there.channels}, there.metadata.replace(mount=mount))


@pytest.mark.parametrize(
    ("mount", "turns", "noise", "told"),
    [("stand", 0.3, 0.05, True), ("stand", 0.01, 0.05, False), ("floor", 0.3, 0.5, False), ("floor", 0.0, 0.05, True)],
)
def test_what_holds_the_robot_shows_in_its_trunk(mount, turns, noise, told):
    """It is still on a stand while the joints move, and on its feet it is not."""
    found = [one.column for one in examine(trunk_log(mount, turns, noise))]
    assert found == ["field mount"] * told


def test_an_accelerometers_axis_that_is_turned_shows_where_the_trunk_leans():
    """Upright it reads next to nothing in that axis, and the direction of gravity tells no sign."""
    log = trunk_log("floor", 0.3, 0.5)
    assert not examine(log)
    (finding,) = examine(changed(log, imu__linear_acceleration=log.array("imu/linear_acceleration") * [-1, 1, 1]))
    assert finding.column == "imu.acc_x"
    assert "the sign of x is reversed" in finding.problem


def test_currents_in_another_unit_are_told_once(tmp_path):
    """Milliamperes in all joints are one line, and no coarse steps beside it."""

    def milliamperes(table: Table) -> None:
        driven(table)
        edit(".*current", lambda values: np.round(values * 1e3 / 2.69) * 2.69)(table)

    (finding,) = merge_findings(read_log(write(tmp_path, milliamperes, joints=3)).findings)
    assert "as if it were in mA (also in joint_1, joint_2)" in finding.problem


def test_columns_that_moved_on_by_one_joint_are_told_so():
    """Where every joint has the column of the next, none is left that says how well this robot follows."""
    log = bench_log(joints=5)
    pose = np.array([0.0, 0.9, -0.7, 1.6, -1.4])
    target, position = (0.3 * log.array(name) + pose for name in ("command/position", "joint/position"))
    velocity = np.gradient(position, 1 / RATE, axis=0)
    moved = {"joint__position": np.roll(position, 1, axis=1), "joint__velocity": np.roll(velocity, 1, axis=1)}
    found = [one for one in examine(changed(log, command__position=target, **moved)) if one.severity == "error"]
    assert [one.problem for one in found] == [
        f"the position follows the command of joint_{(joint - 1) % 5}: the columns of several joints are swapped"
        for joint in range(5)
    ]


@pytest.mark.parametrize(("unit", "told"), [(1.0, []), (180 / np.pi, ["imu.gyro_x", "imu.gyro_y", "imu.gyro_z"])])
def test_the_noise_of_a_gyroscope_in_degrees_is_no_turning(unit, told):
    """On a stand the accelerometer is as still as the orientation, which is therefore not dead."""
    log, rng = trunk_log("stand", 0.0, 0.05), np.random.default_rng(1)
    slow = np.cumsum(0.002 * rng.standard_normal((1000, 3)), axis=0)
    noisy = changed(log, imu__angular_velocity=unit * (slow - slow.mean(0) + 0.01 * rng.standard_normal((1000, 3))))
    found = examine(noisy)
    assert [one.column for one in found if one.check == "gyroscope against orientation"] == told
    assert not [one for one in found if "orientation stays" in one.problem]
