"""Importer of servo-bench recordings: one servo that drives a pendulum, as `.json` or `.json.xz`.

A file is a mapping with `mass` [kg], `length` [m], `kp` [firmware units], `vin` [V], `motor`, `trajectory`
and `entries`, one per sample. What differs between servos is data: `BENCH_SERVOS`. The bus voltage comes in
volts or in units of 0.1 V; the one nearer to the supply `vin` is meant, and a reading far from both is refused.
"""

from __future__ import annotations

import json
import lzma
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.metadata import Metadata
from op3.rollout.rollout import Rollout
from op3.rollout.schema import Key

JOINT = "servo"
"""The one joint of a servo bench."""


@dataclass(frozen=True)
class BenchServo:
    """What a bench recording of one servo type holds.

    Attributes:
        full_duty: PWM register at full duty, or None where `load` was not read.
        has_temperature: Whether `temp` was read [C].
    """

    full_duty: float | None
    has_temperature: bool


BENCH_SERVOS = {
    # Feetech STS3032: load and temperature were not read and stand as zeros.
    "sts3032": BenchServo(full_duty=None, has_temperature=False),
    # Dynamixel XL330: load is Present PWM, a 16-bit two's complement, 885 = 100 % (ROBOTIS e-manual).
    "xl330": BenchServo(full_duty=885.0, has_temperature=True),
}

_HEADER = ("mass", "length", "kp", "vin", "motor", "trajectory", "entries")
_ENTRY = ("timestamp", "goal_position", "position", "speed", "torque_enable", "input_volts", "load", "temp")
_COLUMNS: dict[str, Key] = {
    "timestamp": "time",
    "goal_position": ("command", "position"),
    "torque_enable": ("command", "torque_enable"),
    "position": ("joint", "position"),
    "speed": ("joint", "velocity"),
}


def read_servo_bench(path: str | Path) -> Rollout:
    """Read one recording; the time stamps are kept as recorded, and the rate is the mean number of rows per second.

    `kp` becomes the metadata's `firmware_gain` and the channel command/firmware_gain.
    """
    path = Path(path)
    header, entries = _parse(path)
    servo = BENCH_SERVOS.get(header["motor"]) if isinstance(header["motor"], str) else None
    if servo is None:
        remedy = f"known are {', '.join(BENCH_SERVOS)}; add others to BENCH_SERVOS"
        raise LogError(f"unknown motor {str(header['motor'])[:60]!r}", remedy, source=path, column="field motor")
    table = _table(entries, path)
    arrays = {key: table[name] for name, key in _COLUMNS.items()}
    metadata = _metadata(header, arrays["time"], path)
    arrays["joint", "voltage"] = table["input_volts"] * _volt_scale(table["input_volts"], metadata, path)
    arrays["command", "firmware_gain"] = np.full_like(arrays["time"], metadata.firmware_gain)
    if servo.full_duty is not None:
        arrays["joint", "duty"] = _signed(table["load"], path) / servo.full_duty
    if servo.has_temperature:
        arrays["joint", "temperature"] = table["temp"]
    shaped = {key: values[:, None] for key, values in arrays.items()}
    return Rollout.from_arrays(shaped, metadata, path).check(path)


def looks_like_servo_bench(path: str | Path) -> bool:
    """Whether a readable JSON file holds a recording at all (other JSON may lie beside the recordings)."""
    values = _load(Path(path))
    return isinstance(values, dict) and "entries" in values


def _load(path: Path) -> Any:
    again = "copy or download the file again"
    try:
        raw = path.read_bytes()
        text = lzma.decompress(raw) if path.suffix == ".xz" else raw
    except OSError as error:
        raise LogError(f"the file cannot be read ({error.strerror})", "check the path", source=path) from None
    except (lzma.LZMAError, EOFError):
        raise LogError("the xz data is broken or cut short", again, source=path) from None
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        problem = f"the JSON is broken or cut short at line {error.lineno} ({error.msg})"
        raise LogError(problem, again, source=path) from None
    except (ValueError, RecursionError):
        raise LogError("the file is not JSON", again, source=path) from None


def _parse(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    values = _load(path)
    if not isinstance(values, dict):
        remedy = "name a servo-bench recording"
        raise LogError("the JSON is not a mapping with header and entries", remedy, source=path)
    for name in _HEADER:
        if name not in values:
            raise LogError("the key is missing", f"add `{name}` to the header", source=path, column=f"field {name}")
    entries = values["entries"]
    if not isinstance(entries, list) or not entries:
        remedy = "record at least one sample"
        raise LogError("there are no entries", remedy, source=path, column="field entries", row=1)
    return values, entries


def _table(entries: list[dict[str, Any]], path: Path) -> dict[str, np.ndarray]:
    """Every entry's numbers by name, [time]."""
    table = {name: np.empty(len(entries)) for name in _ENTRY}
    for row, entry in enumerate(entries):
        for name in _ENTRY:
            value = entry.get(name) if isinstance(entry, dict) else None
            if value is None:
                remedy = "complete or remove the sample"
                raise LogError("the value is missing", remedy, source=path, column=name, row=row + 1)
            number = isinstance(value, int | float) and (name == "torque_enable" or not isinstance(value, bool))
            try:
                table[name][row] = value if number else math.nan
            except OverflowError:
                number = False
            if not number or not math.isfinite(table[name][row]):
                problem = f"{str(value)[:40]!r} is not a finite number"
                remedy = "repair or remove the sample"
                raise LogError(problem, remedy, source=path, column=name, row=row + 1)
    return table


def _metadata(header: dict[str, Any], time: np.ndarray, path: Path) -> Metadata:
    # On the XL330 intervals of 3.5 and 5.3 ms alternate irregularly, so a median would misname the rate.
    interval = float(time[-1] - time[0]) / max(len(time) - 1, 1)
    # A clock that stands still or runs back is named by row when the rollout is checked.
    rate = 1 / interval if interval > 0 else 1.0
    name = path.name.split(".")[0]
    stamp = re.fullmatch(r"(\d{4}-\d\d-\d\d)_(\d\d)h(\d\d)m(\d\d)", name)
    fields = dict(
        joints=[JOINT],
        robot="rig",
        mount="pendulum",
        rate=rate,
        mass=header["mass"],
        length=header["length"],
        battery=header["vin"],
        servo=header["motor"],
        firmware_gain=header["kp"],
        motion=header["trajectory"],
        recording=name or None,
        date=f"{stamp[1]}T{stamp[2]}:{stamp[3]}:{stamp[4]}" if stamp else None,
    )
    for field, key in (("battery", "vin"), ("firmware_gain", "kp"), ("motion", "trajectory")):
        if fields[field] is None:
            raise LogError("the key is empty", f"give `{key}` a value", source=path, column=f"field {key}")
    return Metadata.from_dict(fields, path)


def _volt_scale(volts: np.ndarray, metadata: Metadata, path: Path) -> float:
    """1 for volts or 0.1 for tenths, whichever brings the median nearer to the supply."""
    supply, median = metadata.battery or 0.0, float(np.median(volts))
    scales = [s for s in (1.0, 0.1) if supply / 2 < median * s < supply * 2]
    if not scales:
        problem = f"the median {median:g} fits the supply of {supply:g} V neither in V nor in 0.1 V"
        remedy = "correct `vin` or convert the readings to volts"
        raise LogError(problem, remedy, source=path, column="input_volts", row=1)
    return scales[0]


def _signed(load: np.ndarray, path: Path) -> np.ndarray:
    """16-bit two's complement read as unsigned, made signed."""
    wrong = (load != np.round(load)) | (load < -32768) | (load > 65535)
    if wrong.any():
        row = int(wrong.argmax())
        problem = f"{load[row]:g} is not a 16-bit register value"
        remedy = "write the raw Present PWM register"
        raise LogError(problem, remedy, source=path, column="load", row=row + 1)
    return np.where(load > 32767, load - 65536, load)
