"""Tables as plain headers and rows, and formatting of numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from op3.common.plain_names import words
from op3.identify.intervals import at_bound
from op3.report.style import unit_text
from op3.rollout import CHANNELS
from op3.rollout.schema import key_name, normal_key
from op3.servo import Parameter, RobotModel
from op3.servo.conditions import split_name

Cell = str | int | float | bool | None
TableRows = tuple[Sequence[str], Sequence[Sequence[Cell]]]
"""Header and rows, as for `Page.table`."""


def number(value: float, digits: int = 4) -> str:
    """A number with this many significant digits, a true minus sign, and a power of ten only if necessary.

    Integers are written with all digits, and numbers such as 0.25 with no more digits than they need.
    """
    if abs(value) < 1e-15:
        text = "0"
    elif isinstance(value, int):
        text = f"{value:d}"
    elif not math.isfinite(value):
        text = str(value)
    elif 1e-4 <= abs(value) < 1e6:
        # uses the power of ten of the rounded number: 9.9996 has one more digit before the point after rounding
        power = int(f"{value:.{digits - 1}e}".split("e")[1])
        text = f"{value:.{max(0, digits - 1 - power)}f}"
        short = text.rstrip("0").rstrip(".") if "." in text else text
        text = short if float(short) == value else text
    else:
        text = f"{value:.{digits - 1}e}"
    return text.replace("-", "−", 1) if text.startswith("-") else text


def span(value: Any, digits: int = 3) -> str | None:
    """A value with its interval, given as an `Estimate` or as three numbers; None without a value."""
    middle = value.value if hasattr(value, "value") else None if value is None else value[0]
    if middle is None or not math.isfinite(middle):
        return None
    return _within(float(middle), *_interval(value), digits) + ends(value, " (", ")", digits)


def ends(value: Any, before: str = "", after: str = "", digits: int = 3) -> str:
    """The interval of an `Estimate`, or of the last two numbers, as text; empty if there is none."""
    low, high = _interval(value)
    if low is None or high is None:
        return ""
    return f"{before}{_within(low, low, high, digits)} to {_within(high, low, high, digits)}{after}"


def _interval(value: Any) -> tuple[float | None, float | None]:
    low, high = (value.low, value.high) if hasattr(value, "low") else (None, None) if value is None else value[-2:]
    if low is None or high is None or not math.isfinite(low + high):
        return None, None
    return float(low), float(high)


def _within(value: float, low: float | None, high: float | None, digits: int) -> str:
    """A number with at most one more digit than the width of its interval."""
    if low is None or high is None or not low < high:
        return number(value, digits)
    decimals = 1 - math.floor(math.log10(high - low))
    if not value or 1e-4 <= abs(value) < 1e6:
        return f"{round(value, decimals) + 0.0:.{max(0, decimals)}f}".replace("-", "−")
    return number(value, max(1, decimals + 1 + math.floor(math.log10(abs(value)))))


def in_thousandths(value: float | None, unit: str) -> tuple[float | None, str]:
    """A value and its unit; rad, A and N m are converted to mrad, mA and mN m."""
    if unit not in ("rad", "A", "N m"):
        return value, unit
    return None if value is None else 1e3 * value, f"m{unit}"


Bounds = Mapping[str, tuple[float, float]]
"""Lowest and highest value by parameter name."""


def bounded_parameters(
    models: Iterable[RobotModel], bounds: Bounds | None = None, starts: Mapping[str, float] | None = None
) -> dict[str, Parameter]:
    """The parameters of all models by name, with ranges and initial values that differ from the catalogue's."""
    known = {name: p for model in models for name, p in model.parameters().items()}
    for name, (low, high) in (bounds or {}).items():
        if (base := split_name(name)[0]) in known:
            known[name] = replace(known[base], name=name, low=low, high=high)
    return known | {
        name: replace(known[name], nominal=start) for name, start in (starts or {}).items() if name in known
    }


def place_in_range(known: Parameter, value: float) -> float:
    """Position of a value in a parameter's range: 0 at the lower end, 1 at the upper end."""
    return (value - known.low) / (known.high - known.low)


def parameter_table(
    models: Mapping[str, RobotModel], bounds: Bounds | None = None, starts: Mapping[str, float] | None = None
) -> TableRows:
    """Parameters with unit, range, initial value, and the value with its 90 % interval for each model.

    Searched parameters that ended at a bound are marked, because the data do not determine them.

    Args:
        bounds: listed ranges by name, if they differ from the catalogue's.
        starts: initial values of the search by name, if they differ from the catalogue's.
    """
    known = bounded_parameters(models.values(), bounds, starts)
    intervals = {label: any(e.low is not None for e in model.estimates.values()) for label, model in models.items()}
    header = ["parameter", "unit", "range from", "to", "start"]
    for label in models:
        header += [label, "90 % from", "to"] if intervals[label] else [label]
    rows: list[list[Cell]] = []
    remarks = []
    for name, p in known.items():
        ended = []
        row: list[Cell] = [words(name), unit_text(p.unit), p.low, p.high, p.nominal]
        for label, model in models.items():
            estimate = model.estimate(name) if split_name(name)[0] in model.parameters() else None
            row.append(None if estimate is None else estimate.value)
            if intervals[label]:
                row += [None, None] if estimate is None else [estimate.low, estimate.high]
            if estimate is not None and name in (bounds or {}) and at_bound(place_in_range(p, estimate.value)):
                ended.append(label)
        remarks.append(f"at its bound {', '.join(ended) if len(models) > 1 else ''}".strip() if ended else "")
        rows.append(row)
    if any(remarks):
        return [*header, "remark"], [[*row, remark] for row, remark in zip(rows, remarks, strict=True)]
    return header, rows


def loss_table(terms: Mapping[str, Mapping[str, Mapping[Any, float]]], total: str | None = None) -> TableRows:
    """Loss terms, with a row per channel and a column per set of logs and label.

    Args:
        terms: loss terms by set of logs (``fit``, ``held out``), then label, then channel (``"joint/position"``). A
            channel that a log does not have is absent; further entries, such as the loss itself, follow the channels.
        total: name of the last entry.
    """
    columns = {
        f"{logs}, {label}": {key_name(key): value for key, value in by_key.items()}
        for logs, labels in terms.items() for label, by_key in labels.items()
    }  # fmt: skip
    names = dict.fromkeys(name for column in columns.values() for name in column)
    ordered = sorted(names, key=lambda name: (name == total, normal_key(name) not in CHANNELS))
    rows = [[*_channel(name), *(column.get(name) for column in columns.values())] for name in ordered]
    return ["mean square of", "unit", *columns], rows


def _channel(name: str) -> tuple[str, str]:
    """The name of a channel as text, and the unit of its square."""
    channel = CHANNELS.get(normal_key(name))
    if channel is None:
        return name, ""
    text = {"imu/orientation": "body roll and pitch", "imu/angular_velocity": "body rates"}.get(name)
    unit = f"({channel.unit})²" if "/" in channel.unit else f"{channel.unit}²"
    return text or name.replace("/", " ").replace("_", " "), unit
