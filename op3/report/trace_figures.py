"""Figures of measured and simulated traces: joints, body and servo-bench runs (paper, figure of the identification)."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.replay import Prediction
from op3.report.panels import Panel, panels_figure
from op3.report.style import COMMAND, MEASURED, boxes_figure
from op3.report.tables import TableRows
from op3.rollout import CHANNELS, Rollout
from op3.rollout.health import merge_findings
from op3.rollout.schema import key_name

Channel = tuple[str, str]

SHOWN_RUNS = 6
"""Number of bench runs on a page, from the best to the worst."""

JOINT_QUANTITIES: tuple[Channel, ...] = (("joint", "position"), ("joint", "velocity"), ("joint", "current"))

MOVES, SWAYS = 0.01, 0.005
"""Smallest change of angle for which a joint or trunk gets a panel [rad]."""

# drawn unit of each channel, and smallest range of its y axis in this unit
_DEGREES: set[Channel] = {("joint", "position"), ("command", "position"), ("imu", "orientation")}
_LEAST_SPAN: dict[Channel, float] = {
    ("joint", "position"): 4.0,
    ("joint", "velocity"): 0.5,
    ("joint", "current"): 0.1,
    ("imu", "orientation"): 4.0,
    ("imu", "angular_velocity"): 0.5,
}


def traces_figure(
    log: Rollout,
    predictions: Mapping[str, Prediction],
    joints: Sequence[str] = (),
    quantities: Sequence[Channel] = JOINT_QUANTITIES,
) -> go.Figure:
    """Measured and simulated traces: one row per moving joint, each right joint below its left partner, and one column
    per quantity.

    Angles are drawn in degrees, with the command dotted. Quantities that are not in the log have no column, and
    quantities that are not in a prediction have no trace.

    Args:
        log: measured log without an episode axis.
        predictions: predictions of one candidate by label; they may end before the log.
        joints: joints to show; empty: all joints of the log.
        quantities: channels of joints.
    """
    keys = [key for key in quantities if key in log]
    span = np.maximum(*(np.ptp(log.array(key), axis=0) for key in ("joint/position", "command/position")))
    names = joints or log.joints
    moving = [joint for joint in names if span[log.joints.index(joint)] >= MOVES]
    grid = []
    for joint in _paired(moving or names):
        column = log.joints.index(joint)
        grid.append([_panel(log, predictions, key, column, "" if i else words(joint)) for i, key in enumerate(keys)])
    return panels_figure(grid)


def body_figure(log: Rollout, predictions: Mapping[str, Prediction]) -> go.Figure | None:
    """Roll, pitch and body rates; None for a log without them, or whose trunk does not move."""
    rates = ("roll rate x", "pitch rate y", "yaw rate z")
    rows: dict[Channel, Sequence[str]] = {("imu", "orientation"): ("roll", "pitch"), ("imu", "angular_velocity"): rates}
    angles = ("imu", "orientation")
    if angles in log and np.ptp(log.array(angles)[:, :2], axis=0).max() < SWAYS:
        return None
    grid = [
        [_panel(log, predictions, key, i, "", name) for i, name in enumerate(names)]
        for key, names in rows.items()
        if key in log
    ]
    return panels_figure(grid, row_height=170) if grid else None


def runs_figure(logs: Sequence[Rollout], predictions: Mapping[str, Sequence[Prediction]]) -> go.Figure:
    """The angle of the first joint in several logs, with one panel per log and predictions by label."""
    panels = []
    for i, log in enumerate(logs):
        mine = {label: members[i] for label, members in predictions.items()}
        panels.append(_panel(log, mine, ("joint", "position"), 0, run_name(log), titled=True))
    return panels_figure([panels[i : i + 2] for i in range(0, len(panels), 2)], row_height=180)


def bench_figures(
    logs: Sequence[Rollout],
    predictions: Mapping[str, Sequence[Prediction]],
    errors_mrad: Mapping[str, Sequence[float | None]],
    heldout: Sequence[bool],
) -> dict[str, go.Figure]:
    """The error of every servo-bench run, and traces of some runs, from the best to the worst of the first label.

    Args:
        predictions: predictions by label, one per log.
        errors_mrad: mean absolute position error of each run by label [mrad]; None if the simulation failed.
        heldout: whether each run is held out.
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
    """Problems reported by the checks of logs, one row each."""
    found = [{"log": run_name(log), **finding.row()} for log in logs for finding in merge_findings(log.findings)]
    rows = list(dict.fromkeys(tuple(one.values()) for one in found))
    return (list(found[0]), rows) if found else ([], [])


def run_name(log: Rollout) -> str:
    """A short title of a log: motion, mass, length and gain for a bench log, otherwise the recording's name."""
    known = log.metadata
    parts = [words(known.motion or known.recording or known.mount)]
    for value, text in ((known.mass, "{:g} kg"), (known.length, "{:g} m"), (known.firmware_gain, "kp {:g}")):
        parts += [] if value is None else [text.format(value)]
    return ", ".join(parts)


def _paired(joints: Sequence[str]) -> list[str]:
    """The joints, ordered so that each right joint follows its left partner."""
    order = list(dict.fromkeys(joint[2:] if joint[:2] in ("l_", "r_") else joint for joint in joints))
    return sorted(joints, key=lambda joint: (order.index(joint[2:] if joint[:2] in ("l_", "r_") else joint), joint))


def _panel(
    log: Rollout, predictions: Mapping[str, Prediction], key: Channel, column: int, name: str, what: str = "",
    titled: bool = False,
) -> Panel:  # fmt: skip
    time = log.array("time")[:, 0]
    time = time - time[0]
    lines = [(MEASURED, time, _drawn(key, log.array(key)[:, column]))]
    if key == ("joint", "position") and ("command", "position") in log:
        lines.insert(0, (COMMAND, time, _drawn(key, log.array("command/position")[:, column])))
    for label, prediction in predictions.items():
        if key in prediction.channels:
            values = prediction.channels[key][0].numpy()
            lines.append((label, time[: len(values)], _drawn(key, values[:, column])))
    unit = "deg" if key in _DEGREES else CHANNELS[key].unit
    what = what or words(key_name(key).split("/")[-1])
    return Panel(f"{what} [{unit}]" if unit else what, lines, name, _LEAST_SPAN.get(key, 0.0), titled)


def _drawn(key: Channel, values: np.ndarray) -> np.ndarray:
    """Values in the drawn unit; body angles have no jumps of a full turn."""
    if key == ("imu", "orientation"):
        finite = np.isfinite(values)
        values = np.where(finite, values, np.nan)
        values[finite] = np.unwrap(values[finite])
    return np.rad2deg(values) if key in _DEGREES else values
