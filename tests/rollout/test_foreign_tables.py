"""Tables as other programs write them: names of topics, blank cells, counts, and columns that are no joint's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from op3.rollout import LogError, Rollout, read_log
from op3.rollout.importing import side_path
from op3.rollout.proposal import as_yaml, propose

TIME = np.arange(0, 8, 0.01)
ABOUT = "joints: [hip, knee]\nrobot: real\nmount: stand\nrate: 100\n"
COUNT = 2 * np.pi / 4096


def target(time: np.ndarray) -> np.ndarray:
    """Targets [time, joint]."""
    return np.stack([0.5 * np.sin(2 * time), 0.4 * np.cos(1.7 * time)], axis=1)


TARGET, POSITION = target(TIME), np.round(0.98 * target(TIME - 0.045) / COUNT) * COUNT


def write(folder: Path, header: list[str], rows: list, about: str = "") -> Path:
    """A CSV; a number that is none is a blank cell."""
    path = folder / "run.csv"
    cells = [["" if isinstance(v, float) and np.isnan(v) else str(v) for v in row] for row in rows]
    path.write_text("\n".join(map(",".join, [header, *cells])) + "\n")
    if about:
        side_path(path).write_text(about)
    return path


def imported(path: Path, robot: str | None = None) -> Rollout:
    """The log with the YAML that is proposed for it."""
    side_path(path).write_text(as_yaml(*propose(path, robot)))
    return read_log(path)


@pytest.mark.parametrize("period", [0.008, 0.02, 0.05])
def test_streams_stamped_apart_in_one_table_are_two(tmp_path, period):
    """Rows hold a state or a command; each counts from its own time."""
    issued = np.arange(0.003, 8, period)
    rows = [[t, *angles, np.nan, np.nan] for t, angles in zip(TIME, POSITION, strict=True)]
    rows += [[t, np.nan, np.nan, *goal] for t, goal in zip(issued, target(issued), strict=True)]
    names = ["time", "hip.position", "knee.position", "hip.target", "knee.target"]
    log = read_log(write(tmp_path, names, sorted(rows), ABOUT))
    assert log.rows == pytest.approx(len(TIME), abs=3)
    off = log.array("command/position") - target(log.array("time")[:, 0])
    assert np.abs(off).max() < 1.2 * (period + 0.005)


def test_a_command_holds_until_the_next_cell_that_has_one(tmp_path):
    """Also behind its last one."""
    rows = np.arange(len(TIME))
    steps = np.sign(np.sin(1.5 * TIME))[:, None] * [0.3, 0.2]
    sparse = np.where((rows % 50 == 0)[:, None] & (rows < 600)[:, None], steps, np.nan)
    held = steps[np.minimum(rows // 50 * 50, 550)]
    angle = np.zeros_like(held)
    for row in rows[1:]:
        angle[row] = angle[row - 1] + 0.1 * (held[row - 1] - angle[row - 1])
    table = np.column_stack([TIME, sparse, np.round(angle / COUNT) * COUNT]).tolist()
    log = read_log(
        write(tmp_path, ["time", "hip.target", "knee.target", "hip.position", "knee.position"], table, ABOUT)
    )
    assert np.array_equal(log.array("command/position"), held)


@pytest.mark.parametrize(
    "names",
    [
        ("/joint_states/{}/position", "/arm_controller/commands/{}/position"),
        ("/joint_states/position/{}", "/cmd/position/{}"),
        ("/ctrl/state/{}/actual/position", "/ctrl/state/{}/desired/position"),
    ],
)
def test_names_of_topics(tmp_path, names):
    """PlotJuggler's: the joint is a part of the path, and the topic says whether it is a command."""
    header = ["__time", *(name.format(joint) for name in names for joint in ("hip", "knee"))]
    log = imported(write(tmp_path, header, np.column_stack([1.7e9 + TIME, POSITION, TARGET]).tolist()))
    assert log.joints == ("hip", "knee")
    assert np.abs(log.array("command/position") - TARGET).max() < 1e-6
    assert log.findings == ()


def test_what_rostopic_prints_is_read_by_the_names_in_its_cells(tmp_path):
    """A name in a row belongs to the numbers of the same index; one that changes is refused."""
    header = ["%time", "field.header.frame_id", *(f"field.joint_names{i}" for i in (0, 1))]
    header += [f"field.{kind}.positions{i}" for kind in ("desired", "actual", "error") for i in (0, 1)]
    rows = [
        [int(1.7e18 + 1e9 * t), "base", "knee", "hip", *goal[::-1], *angle[::-1], 0.1, 0.2]
        for t, goal, angle in zip(TIME, TARGET, POSITION, strict=True)
    ]
    log = imported(write(tmp_path, header, rows))
    assert log.joints == ("knee", "hip")
    assert np.abs(log.array("joint/position")[:, ::-1] - POSITION).max() < 1e-9
    assert log.duration == pytest.approx(TIME[-1])
    rows[400][2:4] = ["hip", "knee"]
    with pytest.raises(LogError, match=r"row 401, column field.joint_names0: the joint name changes"):
        imported(write(tmp_path, header, rows))


def test_a_column_without_an_angle_is_no_joint(tmp_path):
    """A computed velocity is the lone servo's, or left out where several might have it."""
    lone = np.column_stack([TIME, TARGET[:, 0], POSITION[:, 0], np.gradient(POSITION[:, 0], TIME)]).tolist()
    names = ["time[s]", "setpoint[rad]", "position[rad]", "velocity_computed[rad/s]"]
    log = imported(write(tmp_path, names, lone))
    assert log.joints == ("servo",)
    assert ("joint", "velocity") in log
    several = np.column_stack([TIME, TARGET, POSITION, np.gradient(POSITION[:, 0], TIME)]).tolist()
    names = ["time", "hip_target", "knee_target", "hip_pos", "knee_pos", "speed_filtered"]
    assert imported(write(tmp_path, names, several)).joints == ("hip", "knee")


@pytest.mark.parametrize(("middle", "size"), [(2048, COUNT), (512, np.deg2rad(300) / 1024), (32768, COUNT / 16)])
@pytest.mark.parametrize("ending", ["", "_ticks"])
def test_counts_are_known_by_where_they_stand_and_doubted(tmp_path, middle, size, ending):
    """Around 2048 of 4096 a turn, 512 of 1024 in 300 degrees, or 32768 of 65536 a turn."""
    names = ["time", *(f"{joint}_{kind}{ending}" for kind in ("goal", "pos") for joint in ("hip", "knee"))]
    counts = np.round(middle + np.hstack([TARGET, POSITION]) / size)
    path = write(tmp_path, names, np.column_stack([TIME, counts]).tolist())
    assert ("are assumed to be those of" if middle == 512 else "are assumed to be counts of") in propose(path)[2][0]
    log = imported(path)
    assert np.ptp(log.array("joint/position"), axis=0) == pytest.approx(np.ptp(POSITION, axis=0), rel=0.02)


def test_counts_of_other_servos_than_the_robot_s_are_doubted(tmp_path):
    """Around 512, with a robot of 4096 a turn."""
    counts = np.round(512 + np.hstack([TARGET, POSITION]) / (np.deg2rad(300) / 1024))
    names = ["time", *(f"{joint}_{kind}" for kind in ("goal", "pos") for joint in ("elbow_flex", "wrist_flex"))]
    path = write(tmp_path, names, np.column_stack([TIME, counts]).tolist())
    assert "but arm has other servos" in propose(path, "arm")[2][0]


def test_numbers_of_servos_are_their_ids_on_the_bus(tmp_path):
    """Of a robot whose file gives them; its servo says what a count is, and where its zero lies."""
    phase = np.arange(6)
    goal = 0.3 * np.sin(2 * TIME[:, None] + phase)
    angle = 0.3 * np.sin(2 * (TIME[:, None] - 0.045) + phase)
    table = np.round(2048 + np.hstack([goal, 0.97 * angle]) / COUNT)
    names = ["timestamp_ms", *(f"ID{i}_{kind}_position" for kind in ("goal", "present") for i in range(1, 7))]
    log = imported(write(tmp_path, names, np.column_stack([1e3 * TIME, table]).tolist()), "arm")
    assert log.joints[0] == "shoulder_pan"
    assert np.abs(log.array("command/position") - goal).max() < COUNT


def test_names_are_guessed_beside_metadata_too(tmp_path):
    """As they are without them, and that is said."""
    names = ["t", "hip.cmd_pos", "knee.cmd_pos", "hip.q", "knee.q"]
    log = read_log(write(tmp_path, names, np.column_stack([TIME, TARGET, POSITION]).tolist(), ABOUT))
    assert np.array_equal(log.array("joint/position"), POSITION)
    assert ["the meanings of these columns were guessed" in one.problem for one in log.findings] == [True]


@pytest.mark.parametrize(
    ("target", "position", "other"),
    [
        ("{}_target", "{}", "index"),
        ("{}_des", "{}_act", "{}_des_vel"),
        (
            "/arm/state/reference/positions[{n}]",
            "/arm/state/feedback/positions[{n}]",
            "/arm/state/error/positions[{n}]",
        ),
    ],
)
def test_a_bare_name_is_a_position_and_an_error_is_none(tmp_path, target, position, other):
    """In any order of the columns; a date names the time."""
    header, table = ["date"], [TIME]
    for name, values in ((other, TARGET - POSITION), (target, TARGET), (position, POSITION)):
        for n, joint in enumerate(("hip", "knee")):
            if (column := name.format(joint, n=n)) not in header:
                header.append(column)
                table.append(values[:, n])
    log = imported(write(tmp_path, header, np.column_stack(table).tolist()))
    assert np.array_equal(log.array("joint/position"), POSITION)
    assert np.array_equal(log.array("command/position"), TARGET)
    assert log.findings == ()
