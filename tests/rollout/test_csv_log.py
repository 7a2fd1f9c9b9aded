"""The CSV importer: what it accepts, and one clear sentence for everything else."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from rollout_logs import assert_same, refusal, rollout

from op3.rollout import LogError, read_log

Lines = list[list[str]]

CONVERT = r"; .*(convert|divide|subtract|write|remove|add|correct|give|keep|complete|sort|rename|repair|move)"


def written(folder: Path) -> Path:
    """A good CSV of 30 rows and 2 joints with its sidecar."""
    return rollout(recording="run").to_csv(folder / "run.csv", overwrite=True)


def cell(column: str, row: int, value: str) -> Callable[[Lines], None]:
    """Put a text into one cell."""

    def change(lines: Lines) -> None:
        lines[row][lines[0].index(column)] = value

    return change


def scaled(pattern: str, factor: float, offset: float = 0.0) -> Callable[[Lines], None]:
    """Convert all columns that match to another unit."""

    def change(lines: Lines) -> None:
        for index, name in enumerate(lines[0]):
            if re.fullmatch(pattern, name):
                for cells in lines[1:]:
                    cells[index] = repr(float(cells[index]) * factor + offset)

    return change


def without(pattern: str) -> Callable[[Lines], None]:
    """Remove all columns that match."""

    def change(lines: Lines) -> None:
        keep = [i for i, name in enumerate(lines[0]) if not re.fullmatch(pattern, name)]
        lines[:] = [[cells[i] for i in keep] for cells in lines]

    return change


def renamed(old: str, new: str) -> Callable[[Lines], None]:
    """Rename a column."""
    return cell(old, 0, new)


def whole(column: str, text: Callable[[float], str]) -> Callable[[Lines], None]:
    """Write a column in another way."""

    def change(lines: Lines) -> None:
        index = lines[0].index(column)
        for cells in lines[1:]:
            cells[index] = text(float(cells[index]))

    return change


def decimal_commas(lines: Lines) -> None:
    """Numbers have them, and columns are separated by commas as well."""
    lines[1:] = [",".join(cell.replace(".", ",") for cell in cells).split(",") for cells in lines[1:]]


def clock(seconds: float, form: str) -> str:
    """A reading of a clock in a place's usual form."""
    return (datetime(2026, 3, 28, 23, 59, 59, 900000) + timedelta(seconds=seconds)).strftime(form)


def doubled_column(lines: Lines) -> None:
    """The position of the left knee comes twice."""
    index = lines[0].index("l_knee.position")
    for cells in lines:
        cells.append(cells[index])


# change of a good file: (column, row, what is wrong)
OFFENCES: dict[str, tuple[Callable[[Lines], object], str, str, str]] = {
    "unknown joint": (renamed("l_knee.duty", "l_kne.duty"), "l_kne.duty", "header", "unknown joint.*l_knee"),
    "unknown channel": (renamed("l_knee.duty", "l_knee.pwm"), "l_knee.pwm", "header", "unknown column"),
    "unnamed column": (renamed("l_knee.duty", ""), "('')", "header", "unknown column"),
    "no time": (without("time"), "time", "header", "required column is missing"),
    "no target": (without(".*target"), "l_knee.target", "header", "required column is missing"),
    "one joint alone": (without("r_knee.current"), "r_knee.current", "header", "missing, but l_knee.current exists"),
    "one axis of the gyroscope": (without("imu.gyro_y"), "imu.gyro_y", "header", "missing, but imu.gyro_x exists"),
    "gap in a vector": (without("policy.action_0"), "policy.action_0", "header", "missing, but policy.action_1 exists"),
    "doubled column": (doubled_column, "l_knee.position", "header", "twice"),
    "nan": (cell("l_knee.position", 7, "nan"), "l_knee.position", "row 7", "nan is not a finite"),
    "text": (cell("r_knee.velocity", 3, "fast"), "r_knee.velocity", "row 3", "'fast' is not a number"),
    "empty cell": (cell("r_knee.position", 3, ""), "r_knee.position", "row 3", "nan is not a finite"),
    "digit groups": (cell("r_knee.velocity", 3, "1_0"), "r_knee.velocity", "row 3", "'1_0' is not a number"),
    "thousands": (
        cell("r_knee.velocity", 3, '"1,234.5"'),
        "r_knee.velocity",
        "row 3",
        "without thousands separators",
    ),
    "decimal commas": (decimal_commas, "", "row 1", "as if decimal commas had split them"),
    "German date": (
        whole("time", lambda t: clock(t, "%d.%m.%Y %H:%M:%S.%f")),
        "time",
        "row 1",
        "write dates such as 2026-",
    ),
    "midnight": (whole("time", lambda t: clock(t, "%H:%M:%S.%f")), "time", "row 14", "the log passes midnight"),
    "spelled otherwise": (
        renamed("l_knee.target", "L_Knee target[deg]"),
        "L_Knee target",
        "header",
        "unit: deg}` under",
    ),
    "time twice": (cell("time", 5, repr(3 / 125)), "time", "row 5", "repeats the time of row 4"),
    "time too near": (cell("time", 5, repr(3 / 125 + 1e-12)), "time", "row 5", "repeats the time of row 4"),
    "another rate": (scaled("time", 2.0), "time", "row 2", "62.5 Hz, but the metadata state rate: 125"),
    "degrees per second": (scaled(".*velocity", 57.3), "l_knee.velocity", "row 1", "in deg/s"),
    "mg": (scaled("imu.acc_.", 1e3 / 9.81), "imu.acc_x", "row 1", "looks like mg"),
    "milliampere": (scaled(".*current", 1e3), "_knee.current", "row 1", "looks like mA"),
    "kelvin": (scaled(".*temperature", 1, 273.15), "l_knee.temperature", "row 1", "313.15.*kelvin"),
    "register gain": (scaled(".*p_gain", 133), "l_knee.p_gain", "row 1", "firmware units"),
    "ragged row": (lambda lines: lines[6].pop(), "", "row 6", "not have the .* cells of the header"),
    "too many cells": (lambda lines: lines[6].append("0"), "", "row 6", "not have the .* cells"),
    "truncated": (lambda lines: lines[-1].__delitem__(slice(3, None)), "", "row 30", "not have the .* cells"),
    "no rows": (lambda lines: lines.__delitem__(slice(1, None)), "", "row 1", "no row"),
}


@pytest.mark.parametrize("offence", OFFENCES)
def test_a_bad_table_gets_one_sentence(tmp_path, offence):
    """The sentence names file, column, row, what is wrong and what to do."""
    change, column, row, problem = OFFENCES[offence]
    path = written(tmp_path)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    change(lines)
    path.write_text("".join(",".join(cells) + "\n" for cells in lines))
    message = refusal(path)
    assert re.match(rf"{re.escape(str(path))}.*\b{row}\b.*\.$", message), message
    assert column in message
    assert re.search(problem, message), message
    assert re.search(CONVERT, message), message


SIDECARS = {
    "missing": (None, "sidecar is missing; write the metadata"),
    "not YAML": ("joints: [l_knee\nrate: 1", "line 2 is not valid YAML"),
    "empty": ("", "the file is empty, not a mapping"),
    "a list": ("- 1", "a list, not a mapping"),
    "no mount": ("joints: [l_knee, r_knee]\nrobot: real\nrate: 125", "field mount: the field is missing; add"),
    "rate is text": ("joints: [a]\nrobot: real\nmount: floor\nrate: fast", "field rate: 'fast' is not a number [Hz]"),
    "misspelt": ("joints: [a]\nrobots: real", "field 'robots': no such field; rename it to robot"),
    "unknown": ("joints: [a]\nweather: fine", "field 'weather': no such field; move it under `extra:`"),
    "wrong mount": ("joints: [a]\nrobot: real\nmount: wall\nrate: 125", "'wall' is not one of floor, stand"),
    "pendulum without mass": ("joints: [a]\nrobot: rig\nmount: pendulum\nrate: 125\nlength: 0.1", "add `mass:"),
    "impossible date": (
        "joints: [l_knee, r_knee]\nrobot: real\nmount: floor\nrate: 125\ndate: 2026-99-99",
        "field date: '2026-99-99' is not an ISO 8601 date",
    ),
    "other joints": ("joints: [l_knee]\nrobot: real\nmount: floor\nrate: 125", "column r_knee.target: unknown joint"),
}


@pytest.mark.parametrize("offence", SIDECARS)
def test_a_bad_sidecar_gets_one_sentence(tmp_path, offence):
    """The sentence names the sidecar, the field or line, and what to do."""
    text, expected = SIDECARS[offence]
    path = written(tmp_path)
    sidecar = path.with_suffix(".yaml")
    sidecar.unlink() if text is None else sidecar.write_text(text)
    message = refusal(path)
    assert expected in message
    assert "run.yaml" in message
    assert re.search(CONVERT, message), message


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "the file is empty"),
        (b"\xff\xfe\x00", "byte 0 is not UTF-8"),
        (b'time,"l_knee.posi\n', "not CSV"),
        (b"time\x00\n1\n", "required column is missing"),
    ],
)
def test_a_file_that_is_no_csv_gets_one_sentence(tmp_path, content, expected):
    """Empty, binary and foreign files are refused as such."""
    path = written(tmp_path)
    path.write_bytes(content)
    assert expected in refusal(path)


def test_other_ways_of_a_clock_and_of_a_sidecar(tmp_path):
    """Dates without strokes, and a sidecar whose ending has three letters."""
    path = written(tmp_path)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    whole("time", lambda t: clock(t, "%Y%m%dT%H%M%S.%f"))(lines)
    path.write_text("".join(",".join(cells) + "\n" for cells in lines))
    path.with_suffix(".yaml").rename(path.with_suffix(".yml"))
    np.testing.assert_allclose(np.diff(read_log(path).array("time")[:, 0]), 1 / 125, atol=2e-6)


@pytest.mark.parametrize("change", [lambda line: f"{line},", lambda line: line.replace(",", "|")])
def test_other_tables(tmp_path, change):
    """Rows that end with a comma, unlike the header, and columns between strokes."""
    path = written(tmp_path)
    header, *rows = path.read_text().splitlines()
    header = header.replace(",", "|") if change(",") == "|" else header
    path.write_text("\n".join([header, *map(change, rows)]) + "\n")
    assert_same(read_log(path), rollout(recording="run"))


def test_aligned_columns_and_switches_in_words(tmp_path):
    """Spaces as many as it takes, and True and False for 1 and 0."""
    path = written(tmp_path)
    table = [line.split(",") for line in path.read_text().splitlines()]
    for joint in ("l_knee", "r_knee"):
        whole(f"{joint}.torque_enable", lambda value: str(value > 0))(table)
    path.write_text("\n".join("  ".join(f"{cell:>24}" for cell in cells) for cells in table) + "\n")
    assert_same(read_log(path), rollout(recording="run"))


def test_column_order_quotes_and_blank_lines_do_not_matter(tmp_path):
    """Columns may come in any order, quoted, with spaces, a byte order mark and a blank last line."""
    path = written(tmp_path)
    lines = [list(reversed(cells)) for cells in (line.split(",") for line in path.read_text().splitlines())]
    lines[0] = [f'"{name} "' for name in lines[0]]
    text = "\r\n".join(",".join(cells) for cells in lines) + "\r\n\r\n"
    path.write_text("\ufeff" + text, encoding="utf-8", newline="")
    assert_same(read_log(path), rollout(recording="run"))


def test_more_than_ten_vector_entries_keep_their_order(tmp_path):
    """Entry 10 of an observation comes after entry 9, not after entry 1."""
    log = rollout(recording="run")
    observation = np.arange(30.0 * 12).reshape(30, 12)
    arrays = {key: log.array(key) for key in log.channels}
    wide = type(log).from_arrays({**arrays, ("policy", "observation"): observation}, log.metadata)
    assert_same(read_log(wide.to_csv(tmp_path / "run.csv")), wide)


def test_csv_is_not_overwritten_unasked(tmp_path):
    """An existing CSV, or a foreign file in the sidecar's place, is left alone."""
    path = written(tmp_path)
    with pytest.raises(LogError, match="overwrite=True"):
        rollout().to_csv(path)
    (tmp_path / "other.yaml").write_text("mine")
    with pytest.raises(LogError, match=r"other\.yaml"):
        rollout().to_csv(tmp_path / "other.csv")
    assert not (tmp_path / "other.csv").exists()


HEADER = "time,l_knee.target,r_knee.target,l_knee.position,r_knee.position"
snippets = st.sampled_from(["time", "l_knee", ".", "position", ",", "\n", '"', "0", "1e5", "nan", "-", "_", ";", "é"])


anything = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@anything
@given(text=st.text() | st.lists(snippets).map("".join) | st.lists(snippets).map(lambda s: f"{HEADER}\n" + "".join(s)))
@example(text=HEADER + "\n0,0,0,0,0\n")
@example(text="\x00")
def test_any_text_is_read_or_refused(tmp_path, text):
    """Whatever a CSV holds, reading gives a rollout or a LogError of one line, and nothing else."""
    path = written(tmp_path)
    path.write_text(text, encoding="utf-8", errors="replace", newline="")
    assert "\n" not in refusal(path)


yaml_parts = ["joints", "rate", ": ", "\n", "- ", "[", "]", "{", "&a", "*a", "1", "!!", "2026-13-40"]


@anything
@given(text=st.text() | st.lists(st.sampled_from(yaml_parts)).map("".join))
def test_any_sidecar_is_read_or_refused(tmp_path, text):
    """Whatever a sidecar holds, reading gives a rollout or a LogError."""
    path = written(tmp_path)
    path.with_suffix(".yaml").write_text(text, encoding="utf-8", errors="replace")
    assert "\n" not in refusal(path)
