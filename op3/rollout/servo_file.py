"""What the columns of a servo's recordings mean, from `assets/servos/<make>.yaml`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from op3.robot.servo_make import ServoMake, load_servo, servo_files
from op3.rollout.errors import LogError


def find_servo(name: str | None) -> ServoMake | None:
    """The make that a recording names, also by an alias or without its variant; None where none is meant."""
    wanted = _plain(name or "")
    makes = [load_servo(known) for known in servo_files()] if wanted else []
    exact = [make for make in makes if wanted in map(_plain, (make.name, *make.aliases))]
    close = [make for make in makes if _plain(make.name).startswith(wanted)]
    return next(iter(exact + close), None)


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def bench_table(name: str, table: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """Channels of a servo-bench recording in SI, the voltage as it was read.

    A reading that stands at zero throughout was not taken. The load of a make whose file does not say that it was
    recorded as a duty stays in the recorders' unit; a control is the current where the servo's loop is one of current.

    Args:
        name: Motor, as the recording calls it.
        table: Columns beside position, speed, goal and torque switch, [time] each.
        path: Named in errors.
    """
    make = find_servo(name)
    table = {column: values for column, values in table.items() if values.any()}
    found = {
        ours: table[theirs] for theirs, ours in (("input_volts", "voltage"), ("current", "current")) if theirs in table
    }
    recorded = None if make is None else make.recorded
    if "temp" in table and (recorded is None or "temp" in recorded):
        found["temperature"] = table["temp"]
    if "load" in table and recorded is None:
        found["load"] = table["load"]
    elif "load" in table and make is not None and make.counts.duty and "load" in (recorded or ()):
        found["duty"] = _signed(table["load"], "load", path) / make.counts.duty.si
    if "control" in table and make is not None and make.loop == "current":
        found["current"] = table["control"]
    return found


def _signed(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    """16-bit two's complement read as unsigned, made signed."""
    wrong = (values != np.round(values)) | (values < -32768) | (values > 65535)
    if wrong.any():
        row = int(wrong.argmax())
        problem, remedy = f"{values[row]:g} is not a 16-bit register value", "write the raw register"
        raise LogError(problem, remedy, source=path, column=name, row=row + 1)
    return np.where(values > 32767, values - 65536, values)
