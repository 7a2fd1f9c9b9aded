"""Units of logs, and identification of a unit from its factor.

Registers: control tables of Dynamixel X, MX and XL series (ROBOTIS e-Manual) and of Feetech STS and HLS servos.
"""

from __future__ import annotations

import math

from op3.rollout.errors import LogError
from op3.rollout.schema import Quantity

_DEG, _TURN, _RPM = math.pi / 180, 2 * math.pi, 2 * math.pi / 60

TURN_COUNTS = 4096
"""Counts per turn of most encoders of hobby servos."""

COUNTS = f"counts of {TURN_COUNTS} a turn"
"""Unit of their angles."""

UNITS: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rad": {
        "rad": 1.0,
        "deg": _DEG,
        "0.1 deg": 0.1 * _DEG,
        "mrad": 1e-3,
        "turn": _TURN,
        COUNTS: _TURN / TURN_COUNTS,
        "counts of 1024 a turn": _TURN / 1024,
        "counts of 65536 a turn": _TURN / 65536,
        "counts of 1024 in 300 deg": 300 * _DEG / 1024,
    },
    "rad/s": {
        "rad/s": 1.0,
        "deg/s": _DEG,
        "mrad/s": 1e-3,
        "rpm": _RPM,
        "turn/s": _TURN,
        "counts of 0.229 rpm": 0.229 * _RPM,
        "counts of 0.111 rpm": 0.111 * _RPM,
        "counts of 0.732 rpm": 0.732 * _RPM,
        f"{COUNTS} per second": _TURN / TURN_COUNTS,
    },
    "A": {"A": 1.0, "mA": 1e-3, "counts of 2.69 mA": 2.69e-3, "counts of 4.5 mA": 4.5e-3, "counts of 6.5 mA": 6.5e-3},
    "": {"": 1.0, "percent": 0.01, "counts of 885": 1 / 885, "counts of 1000": 1e-3, "counts of 1023": 1 / 1023},
    "V": {"V": 1.0, "0.1 V": 0.1, "mV": 1e-3},
    "C": {"C": 1.0, "K": 1.0, "F": 5 / 9},
    "m/s2": {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3},
    "kg": {"kg": 1.0, "g": 1e-3, "mg": 1e-6, "t": 1e3, "lb": 0.4536},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "km": 1e3},
    "A/rad": {"A/rad": 1.0, "mA/rad": 1e-3, "A/deg": 1 / _DEG},
    "A s/rad": {"A s/rad": 1.0, "mA s/rad": 1e-3, "A s/deg": 1 / _DEG},
}
"""Sizes of units by SI unit, the most common unit first."""

OFFSETS = {"K": -273.15, "F": -160 / 9}
"""Offsets of temperature units, added after the factor."""

_ALIASES = {"degrees": "deg", "°": "deg", "degree": "deg", "radian": "rad", "radians": "rad", "rev": "turn"}
_ALIASES |= {"dps": "deg/s", "deg_s": "deg/s", "rad_s": "rad/s", "rps": "turn/s", "°/s": "deg/s", "%": "percent"}
_ALIASES |= {"µs": "us", "usec": "us", "nsec": "ns", "msec": "ms", "sec": "s", "seconds": "s", "°C": "C"}
_ALIASES |= {"m/s^2": "m/s2"}


def canonical(name: str) -> str:
    """The name in `UNITS` of a unit in any spelling."""
    return _ALIASES.get(name, name)


def factor(unit: str | float, quantity: Quantity, column: str) -> tuple[float, float]:
    """Factor and offset that turn numbers in a unit into the quantity's SI unit.

    Args:
        unit: Name in `UNITS`, or the size of the unit in SI units as a number.
        quantity: The measured quantity.
        column: Column named in the error.

    Raises:
        LogError: if the unit is unknown or measures something else.
    """
    if isinstance(unit, int | float) and not isinstance(unit, bool) and math.isfinite(unit) and unit:
        return float(unit), 0.0
    known = UNITS.get(quantity.unit, {quantity.unit: 1.0})
    name = canonical(str(unit))
    if name not in known:
        there = ", ".join(n for n in known if n) or "1"
        remedy = f"write one of {there}, or the size of the unit in {quantity.unit or 'full scale'} as a number"
        raise LogError(f"unit {str(unit)[:40]!r} does not fit", remedy, column=column)
    return known[name], OFFSETS.get(name, 0.0)


def likely_unit(ratio: float, si_unit: str, tolerance: float = 0.12) -> str | None:
    """The unit whose numbers are `ratio` times the SI value; None if no known unit is close.

    Args:
        ratio: Recorded number divided by the number in the SI unit.
        si_unit: Key of `UNITS`.
        tolerance: Largest relative difference between `ratio` and the ratio of the unit.
    """
    if not 1e-12 < abs(ratio) < 1e12:
        return None
    others = {name: abs(math.log(abs(ratio) * size)) for name, size in UNITS.get(si_unit, {}).items() if size != 1}
    name = min(others, key=others.__getitem__, default=None)
    return name if name is not None and others[name] < tolerance else None


def plausible_unit(value: float, si_unit: str, typical: float) -> tuple[str, float] | None:
    """The unit in which a number is closest to a typical value, with the number in SI; None if no unit is close."""
    sizes = [item for item in UNITS[si_unit].items() if item[0] not in ("in", "lb")]
    name, size = min(sizes, key=lambda item: abs(math.log(abs(value) * item[1] / typical)))
    return (name, value * size) if 0.02 < abs(value) * size / typical < 50 and size != 1 else None
