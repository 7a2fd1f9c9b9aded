"""Servo-bench recordings (Rhoban): one servo that swings a pendulum, `.json` or `.json.xz`.

A file is a mapping with `mass` [kg], `length` [m], `kp` [firmware units], `motor`, `trajectory`, often `vin` [V], and
`entries`, one per sample. The file `assets/servos/<motor>.yaml` defines the meaning of a servo's columns; the load of a
motor without a file keeps the recorder's unit.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from op3.robot.servo_make import find_servo
from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import numbers, read_bytes, read_json, unpacked
from op3.rollout.schema import VOLTAGE

_HEADER = ("mass", "length", "kp", "motor", "trajectory", "entries")
_NAMES = {"goal_position": "target", "torque_enable": "torque_enable", "position": "position", "speed": "velocity"}
_ALWAYS = ("goal_position", "position")


class ServoBench:
    """A recording of any servo."""

    title = "servo-bench JSON"
    paths = "<name>.json, .json.xz"

    def claims(self, path: Path) -> bool:
        """Recognised by the file name extension."""
        return path.is_file() and unpacked(path).suffix == ".json"

    def holds(self, path: Path) -> bool:
        """Whether the file is a recording; other JSON files may be in the same folder."""
        try:
            return b'"entries"' in read_bytes(path)
        except LogError:
            return True  # reading it raises the error

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        header = read_json(path)
        for name in _HEADER:
            if header.get(name) in (None, []):
                remedy = f"record the log again, or add `{name}`"
                raise LogError("the key is missing or empty", remedy, source=path, column=f"field {name}")
        entries = header["entries"] if isinstance(header["entries"], list) else [header["entries"]]
        first = entries[0] if isinstance(entries[0], dict) else {}
        more = [name for name in first if name not in _NAMES and isinstance(first[name], int | float)]
        measured = [name for name in _NAMES if name in _ALWAYS or name in first]  # otherwise absent in every entry
        table = {
            name: numbers([e.get(name) if isinstance(e, dict) else None for e in entries], path, name)[:, 0]
            for name in dict.fromkeys(("timestamp", *measured, *more))
        }
        channels = {_NAMES[name]: table[name] for name in measured} | _sensed(header, table, path)
        columns = {"timestamp": table["timestamp"]}
        columns |= {f"servo.{channel}": values for channel, values in channels.items()}
        clock = {"timestamp": Column("time")}
        return [Recording([Stream(table["timestamp"], columns)], _metadata(header, path), clock)]


def _metadata(header: dict[str, Any], path: Path) -> dict[str, Any]:
    stamp = re.search(r"(\d{4}-\d\d-\d\d)_(\d\d)h(\d\d)m(\d\d)", path.name)
    known = {k: v for k, v in header.items() if k not in (*_HEADER, "vin") and isinstance(v, bool | int | float | str)}
    names = {"mass": "mass", "length": "length", "battery": "vin", "servo": "motor", "firmware_gain": "kp"}
    return dict(
        {ours: header.get(theirs) for ours, theirs in names.items()},
        joints=["servo"],
        robot="rig",
        mount="pendulum",
        motion=header["trajectory"],
        date=f"{stamp[1]}T{stamp[2]}:{stamp[3]}:{stamp[4]}" if stamp else None,
        extra=known,
    )


def _sensed(header: dict[str, Any], table: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """Further channels in SI units; readings that are always zero are omitted."""
    make = find_servo(str(header["motor"]))
    recorded = None if make is None else make.recorded
    read = {name: values for name, values in table.items() if values.any()}
    found = {}
    if "input_volts" in read:
        found["voltage"] = read["input_volts"] * _volts(read["input_volts"], header.get("vin"), path)
    if "temp" in read and (recorded is None or "temp" in recorded):
        found["temperature"] = read["temp"]
    if "load" in read and (recorded is None or "load" in recorded):
        registers = (read["load"] == np.round(read["load"])) & (np.abs(read["load"] - 16383.5) <= 49151.5)
        signed = np.where(read["load"] > 32767, read["load"] - 65536, read["load"])  # two's complement of 16 bits
        if recorded is None:
            found["load"] = signed if registers.all() else read["load"]
        elif not registers.all():
            problem = f"{read['load'][registers.argmin()]:g} is not a 16-bit register value"
            row = int(registers.argmin()) + 1
            raise LogError(problem, "write the raw register", source=path, column="load", row=row)
        elif make is not None and make.counts.duty:
            found["duty"] = signed / make.counts.duty.si
    if "current" in read:
        found["current"] = read["current"]
    if "control" in read and make is not None and make.loop == "current":
        found["current"] = -read["control"]  # its sign is opposite to the position's, as gravity and friction show
    return found


def _volts(volts: np.ndarray, supply: Any, path: Path) -> float:
    """1 for volts or 0.1 for tenths of a volt, depending on which brings the median near the supply."""
    median = float(np.median(volts))
    if not isinstance(supply, int | float) or not supply > 0:
        return 1.0 if median <= VOLTAGE.bound else 0.1
    for scale in (1.0, 0.1):
        if supply / 2 < median * scale < supply * 2:
            return scale
    problem = f"the median {median:g} fits the supply of {supply:g} V neither in V nor in 0.1 V"
    problem += ", which looks like mV" if supply / 2e3 < median < supply / 500 else ""
    raise LogError(problem, "correct `vin` or convert the readings to volts", source=path, column="input_volts", row=1)
