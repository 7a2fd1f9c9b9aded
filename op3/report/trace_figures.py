"""Measured against simulated: joints, body and runs of the servo bench (paper, figure of the identification)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.replay import Prediction
from op3.report.panels import Panel, panels_figure
from op3.report.style import COMMAND, MEASURED, boxes_figure, words
from op3.report.tables import TableRows
from op3.rollout import CHANNELS, Rollout
from op3.rollout.health import merge_findings
from op3.rollout.schema import Key, key_name, normal_key

Channels = Prediction | Mapping[Any, Any]
"""A prediction of one candidate, or arrays ``[time, joint | 3]`` by channel, such as ``("joint", "position")``."""

SHOWN_RUNS = 6
"""Bench runs drawn on a page, the worst, the best and between."""

JOINT_QUANTITIES: tuple[Key, ...] = (("joint", "position"), ("joint", "velocity"), ("joint", "current"))

MOVES, SWAYS = 0.01, 0.005
"""Joints, and trunks, whose angles change by less have no panel [rad]."""

# what is drawn in degrees, and how little a y axis may show, in the unit drawn
_DEGREES: set[Key] = {("joint", "position"), ("command", "position"), ("imu", "orientation")}
_LEAST_SPAN: dict[Key, float] = {
    ("joint", "position"): 4.0,
    ("joint", "velocity"): 0.5,
    ("joint", "current"): 0.1,
    ("imu", "orientation"): 4.0,
    ("imu", "angular_velocity"): 0.5,
}


def traces_figure(
    log: Rollout,
    predictions: Mapping[str, Channels],
    joints: Sequence[str] = (),
    quantities: Sequence[str | tuple[str, str]] = JOINT_QUANTITIES,
) -> go.Figure:
    """Measured and simulated traces: a row per joint that moves, right below left partner, and a column per quantity.

    Angles are drawn in degrees, with the command dotted. A quantity that the log does not have has no column; one
    that a prediction does not have has no trace of it.

    Args:
        log: what was measured, without an episode axis.
        predictions: by label; they may end before the log.
        joints: joints to show; all of the log if empty.
        quantities: channels of joints.

    Raises:
        ValueError: if the log has none of the quantities, or a joint or a shape does not belong to the log.
    """
    keys = [key for key in map(normal_key, quantities) if key in log]
    if not keys:
        asked = ", ".join(key_name(normal_key(q)) for q in quantities)
        there = ", ".join(map(key_name, log.channels))
        raise ValueError(f"the log has no {asked} to draw; it has {there}")
    for joint in joints:
        if joint not in log.joints:
            raise ValueError(f"the log has no joint {joint!r}; its joints are {', '.join(log.joints)}")
    span = np.maximum(*(np.ptp(log.array(key), axis=0) for key in ("joint/position", "command/position")))
    names = joints or log.joints
    moving = [joint for joint in names if span[log.joints.index(joint)] >= MOVES]
    grid = []
    for joint in _paired(moving or names):
        column = log.joints.index(joint)
        grid.append([_panel(log, predictions, key, column, "" if i else words(joint)) for i, key in enumerate(keys)])
    return panels_figure(grid)


def body_figure(log: Rollout, predictions: Mapping[str, Channels]) -> go.Figure | None:
    """Roll, pitch and body rates; None for a log without them, or whose trunk does not move."""
    rates = ("roll rate x", "pitch rate y", "yaw rate z")
    rows: dict[Key, Sequence[str]] = {("imu", "orientation"): ("roll", "pitch"), ("imu", "angular_velocity"): rates}
    angles = ("imu", "orientation")
    if angles in log and np.ptp(log.array(angles)[:, :2], axis=0).max() < SWAYS:
        return None
    grid = [
        [_panel(log, predictions, key, i, "", name) for i, name in enumerate(names)]
        for key, names in rows.items()
        if key in log
    ]
    return panels_figure(grid, row_height=170) if grid else None


def runs_figure(logs: Sequence[Rollout], predictions: Mapping[str, Sequence[Channels]], columns: int = 2) -> go.Figure:
    """The angle of the first joint in several logs, a panel per log, with predictions by label, one per log."""
    panels = []
    for i, log in enumerate(logs):
        mine = {label: members[i] for label, members in predictions.items()}
        panels.append(_panel(log, mine, ("joint", "position"), 0, run_name(log), titled=True))
    grid = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    return panels_figure(grid, row_height=180)


def bench_figures(
    logs: Sequence[Rollout],
    predictions: Mapping[str, Sequence[Channels]],
    errors_mrad: Mapping[str, Sequence[float | None]],
    heldout: Sequence[bool],
) -> dict[str, go.Figure]:
    """The error of every run of a servo bench, and traces of some, from the best to the worst of the first label.

    Args:
        logs: what was measured.
        predictions: by label, one per log.
        errors_mrad: by label, mean absolute position error of each run [mrad]; None where the simulation failed.
        heldout: whether each run was kept from the fit.
    """
    first = next(iter(errors_mrad.values()))
    order = sorted((i for i, error in enumerate(first) if error is not None), key=lambda i: first[i] or 0.0)
    chosen = [order[i] for i in np.unique(np.linspace(0, len(order) - 1, SHOWN_RUNS).round().astype(int))]
    shown = {label: [members[i] for i in chosen] for label, members in predictions.items()}
    boxes: dict[str, dict[str, list[float]]] = {}
    for label, errors in errors_mrad.items():
        for log, error, unseen in zip(logs, errors, heldout, strict=True):
            motions = boxes.setdefault(f"{label}, held out" if unseen else label, {})
            motions.setdefault(words(log.metadata.motion or "runs"), []).extend([] if error is None else [error])
    return {
        "errors": boxes_figure(boxes, "position error [mrad]"),
        "runs": runs_figure([logs[i] for i in chosen], shown),
    }


def checks_table(logs: Iterable[Rollout]) -> TableRows:
    """What the checks found in logs, a row per finding."""
    found = [{"log": run_name(log), **finding.row()} for log in logs for finding in merge_findings(log.findings)]
    rows = list(dict.fromkeys(tuple(one.values()) for one in found))
    return (list(found[0]), rows) if found else ([], [])


def run_name(log: Rollout) -> str:
    """A log in a few words: motion, mass, length and gain of a bench log, else its recording's name."""
    known = log.metadata
    parts = [words(known.motion or known.recording or known.mount)]
    for value, text in ((known.mass, "{:g} kg"), (known.length, "{:g} m"), (known.firmware_gain, "kp {:g}")):
        parts += [] if value is None else [text.format(value)]
    return ", ".join(parts)


def _paired(joints: Sequence[str]) -> list[str]:
    """The joints with the right ones straight after their left partners."""
    order = list(dict.fromkeys(joint[2:] if joint[:2] in ("l_", "r_") else joint for joint in joints))
    return sorted(joints, key=lambda joint: (order.index(joint[2:] if joint[:2] in ("l_", "r_") else joint), joint))


def _panel(
    log: Rollout, predictions: Mapping[str, Channels], key: Key, column: int, name: str, what: str = "",
    titled: bool = False,
) -> Panel:  # fmt: skip
    if log.batched:
        raise ValueError("the log has an episode axis: draw one episode, log.episode(0), at a time")
    time = log.array("time")[:, 0]
    time = time - time[0]
    lines = [(MEASURED, time, _drawn(key, log.array(key)[:, column]))]
    if key == ("joint", "position") and ("command", "position") in log:
        lines.insert(0, (COMMAND, time, _drawn(key, log.array("command/position")[:, column])))
    for label, channels in predictions.items():
        values = _simulated(label, channels, key)
        if values is None:
            continue
        if len(values) > len(time) or column >= values.shape[1]:
            shape, there = list(values.shape), [len(time), log.array(key).shape[1]]
            raise ValueError(f"{key_name(key)} of {label!r} has the shape {shape}, the log has {there}")
        lines.append((label, time[: len(values)], _drawn(key, values[:, column])))
    unit = "deg" if key in _DEGREES else CHANNELS[key].unit
    what = what or words(key_name(key).split("/")[-1])
    return Panel(f"{what} [{unit}]" if unit else what, lines, name, _LEAST_SPAN.get(key, 0.0), titled)


def _simulated(label: str, channels: Channels, key: Key) -> np.ndarray | None:
    """A channel ``[time, joint | 3]`` of the only candidate, or None where the prediction lacks it."""
    found = channels.channels if isinstance(channels, Prediction) else channels
    by_key = {normal_key(name): value for name, value in found.items()}
    if key not in by_key:
        return None
    values = np.asarray(by_key[key], dtype=float)
    values = values[0] if values.ndim == 3 and len(values) == 1 else values
    if values.ndim != 2:
        problem = f"{key_name(key)} of {label!r} has the shape {list(values.shape)}"
        raise ValueError(f"{problem}; pick one candidate, so that it is [time, joint]")
    return values


def _drawn(key: Key, values: np.ndarray) -> np.ndarray:
    """Values in the unit drawn; angles of the body without jumps of a full turn."""
    if key == ("imu", "orientation"):
        finite = np.isfinite(values)
        values = np.where(finite, values, np.nan)
        values[finite] = np.unwrap(values[finite])
    return np.rad2deg(values) if key in _DEGREES else values
