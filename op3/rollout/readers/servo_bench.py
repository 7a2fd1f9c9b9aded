"""Servo-bench recordings (Rhoban): one servo that swings a pendulum, `.json` or `.json.xz`.

A file is a mapping with `mass` [kg], `length` [m], `kp` [firmware units], `motor`, `trajectory`, often `vin` [V],
and `entries`, one per sample. What the columns of a servo mean is said by its file `assets/servos/<motor>.yaml`; the
load of a motor without a file stays in the recorders' unit.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Recording, Stream
from op3.rollout.readers.text import ending, read_bytes
from op3.rollout.schema import VOLTAGE
from op3.rollout.servo_file import bench_table

JOINT = "servo"
"""The one joint of a servo bench."""

_HEADER = ("mass", "length", "kp", "motor", "trajectory", "entries")
_NAMES = {"goal_position": "target", "torque_enable": "torque_enable", "position": "position", "speed": "velocity"}


class ServoBench:
    """A recording of any motor."""

    title = "servo-bench JSON"
    paths = "<name>.json, .json.xz"

    def claims(self, path: Path) -> bool:
        """By the ending."""
        return path.is_file() and ending(path) == ".json"

    def holds(self, path: Path) -> bool:
        """Whether it is a recording at all: other JSON may lie beside recordings."""
        try:
            return b'"entries"' in read_bytes(path)
        except LogError:
            return True  # reading it says what is wrong

    def read(self, path: Path) -> list[Recording]:
        """One recording; the rate is the mean number of rows per second."""
        header, entries = _parse(path)
        given = entries[0] if isinstance(entries[0], dict) else {}
        extra = [name for name in given if name not in (*_NAMES, "timestamp") and _is_number(given[name])]
        table = {name: _numbers(entries, name, path) for name in ("timestamp", *_NAMES, *extra)}
        time = table.pop("timestamp")
        columns = {f"{JOINT}.{ours}": table.pop(name) for name, ours in _NAMES.items()}
        for channel, values in bench_table(str(header["motor"]), table, path).items():
            scale = _volts(values, header.get("vin"), path) if channel == "voltage" else 1.0
            columns[f"{JOINT}.{channel}"] = values * scale
        return [Recording([Stream(time, columns)], _metadata(header, path))]


def _parse(path: Path) -> tuple[dict[str, Any], list[Any]]:
    again = "copy or download the file again"
    raw = read_bytes(path)
    try:
        values = json.loads(raw)
    except json.JSONDecodeError as error:
        problem = f"the JSON is broken or cut short at line {error.lineno} ({error.msg})"
        raise LogError(problem, again, source=path) from None
    except (ValueError, RecursionError):
        raise LogError("the file is not JSON", again, source=path) from None
    if not isinstance(values, dict):
        remedy = "name a servo-bench recording"
        raise LogError("the JSON is not a mapping with header and entries", remedy, source=path)
    for name in _HEADER:
        if values.get(name) is None:
            raise LogError("the key is missing", f"add `{name}` to the header", source=path, column=f"field {name}")
    entries = values["entries"]
    if not isinstance(entries, list) or not entries:
        remedy = "record at least one sample"
        raise LogError("there are no entries", remedy, source=path, column="field entries", row=1)
    return values, entries


def _numbers(entries: list[Any], name: str, path: Path) -> np.ndarray:
    """One number of every entry, [time]."""
    numbers = np.empty(len(entries))
    for row, entry in enumerate(entries):
        value = entry.get(name) if isinstance(entry, dict) else None
        where: dict[str, Any] = dict(source=path, column=name, row=row + 1)
        if value is None:
            raise LogError("the value is missing", "complete or remove the sample", **where)
        number = _is_number(value) or (name == "torque_enable" and isinstance(value, bool))
        if not number or not abs(value) < 1e300:
            raise LogError(f"{str(value)[:40]!r} is not a finite number", "repair or remove the sample", **where)
        numbers[row] = value
    return numbers


def _metadata(header: dict[str, Any], path: Path) -> dict[str, Any]:
    stamp = re.search(r"(\d{4}-\d\d-\d\d)_(\d\d)h(\d\d)m(\d\d)", path.name)
    known = {k: v for k, v in header.items() if k not in (*_HEADER, "vin") and isinstance(v, bool | int | float | str)}
    return dict(
        joints=[JOINT],
        robot="rig",
        mount="pendulum",
        mass=header["mass"],
        length=header["length"],
        battery=header.get("vin"),
        servo=header["motor"],
        firmware_gain=header["kp"],
        motion=header["trajectory"],
        date=f"{stamp[1]}T{stamp[2]}:{stamp[3]}:{stamp[4]}" if stamp else None,
        extra=known,
    )


def _volts(volts: np.ndarray, supply: Any, path: Path) -> float:
    """1 for volts or 0.1 for tenths, whichever brings the median nearer to the supply."""
    median = float(np.median(volts))
    if not _is_number(supply) or not supply > 0:
        return 1.0 if median <= VOLTAGE.bound else 0.1
    scales = [scale for scale in (1.0, 0.1) if supply / 2 < median * scale < supply * 2]
    if not scales:
        problem = f"the median {median:g} fits the supply of {supply:g} V neither in V nor in 0.1 V"
        remedy = "correct `vin` or convert the readings to volts"
        raise LogError(problem, remedy, source=path, column="input_volts", row=1)
    return scales[0]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
