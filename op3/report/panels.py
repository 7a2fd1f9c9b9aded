"""A grid of small panels over one time axis, used for all figures with traces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.report.style import COMMAND, INK, MEASURED, MUTED, colours, dress, plain

MOST_POINTS = 1000
"""Points per trace. Longer traces keep the smallest and largest value of each interval, which preserves peaks."""

_TOP, _BOTTOM, _GAP, _TITLE = 48, 48, 22, 18

Line = tuple[str, np.ndarray, np.ndarray]
"""Label, time ``[time]`` in s and values ``[time]`` in the panel's unit of one trace."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot of the grid.

    Attributes:
        axis: plotted quantity with its unit.
        lines: traces; labels repeat from panel to panel and share a colour and a legend entry.
        name: title of the row, or of the panel if `titled`.
        least_span: smallest range of the y axis, so that noise about a constant appears small.
        titled: whether the name is above the panel instead of beside its axis.
    """

    axis: str
    lines: Sequence[Line]
    name: str = ""
    least_span: float = 0.0
    titled: bool = False


def thin(time: np.ndarray, values: np.ndarray, most: int = MOST_POINTS) -> tuple[np.ndarray, np.ndarray]:
    """At most about `most` points of a trace ``[time]``, including the extremes of every interval; NaN leaves a gap."""
    if len(time) <= most:
        return time, values
    keep = [0, len(time) - 1]
    for stretch in np.array_split(np.arange(len(time)), most // 2):
        inside = values[stretch]
        known = not np.isnan(inside).all()
        keep += [int(stretch[of(inside)]) for of in (np.nanargmin, np.nanargmax)] if known else [int(stretch[0])]
    index = np.unique(keep)
    return time[index], values[index]


def panels_figure(grid: Sequence[Sequence[Panel]], row_height: int = 126) -> go.Figure:
    """Draw rows of panels, each with this height in pixels, that zoom together in time."""
    rows, columns = len(grid), max(map(len, grid))
    panels = [panel for row in grid for panel in row]
    title = _TITLE if any(panel.titled for panel in panels) else 0
    inner = rows * row_height + (rows - 1) * (_GAP + title)
    gaps = {"vertical_spacing": (_GAP + title) / inner if rows > 1 else 0, "horizontal_spacing": 0.07 * (columns > 1)}
    figure = make_subplots(rows=rows, cols=columns, **gaps)
    labels = list(dict.fromkeys(label for panel in panels for label, *_ in panel.lines))
    looks = _looks(labels)
    for i, j in np.ndindex(rows, columns):
        place = dict(row=i + 1, col=j + 1)
        if j >= len(grid[i]):
            figure.update_xaxes(visible=False, **place)
            figure.update_yaxes(visible=False, **place)
            continue
        _draw(figure, grid[i][j], place, looks)
        last = i + 1 == rows or j >= len(grid[i + 1])
        figure.update_xaxes(showticklabels=last, title_text="time [s]" if last else "", **place)
    for label in sorted(labels, key=lambda label: (label == COMMAND, label != MEASURED, labels.index(label))):
        # separate legend entries in reading order, because traces are ordered by depth
        figure.add_scatter(x=[None], y=[None], name=plain(label), legendgroup=label, mode="lines", line=looks[label])
    for axis in list(figure.select_xaxes())[1:]:
        axis.matches = "x"
    margin = dict(l=92, r=16, t=_TOP + title, b=_BOTTOM)
    dress(figure, inner + _TOP + title + _BOTTOM, margin=margin, hovermode="x unified")
    return figure.update_layout(legend_y=1 + (8 + title) / inner)


def _looks(labels: Sequence[str]) -> Mapping[str, dict[str, Any]]:
    """Line styles by label: black for measured, dotted grey for commands, colours for the others."""
    coloured = colours([label for label in labels if label not in (MEASURED, COMMAND)])
    looks: dict[str, dict[str, Any]] = {label: dict(color=colour, width=1.5) for label, colour in coloured.items()}
    # the measured trace is below the others and therefore wider
    return looks | {MEASURED: dict(color=INK, width=2.0), COMMAND: dict(color=MUTED, width=1.2, dash="dot")}


def _draw(figure: go.Figure, panel: Panel, place: dict[str, Any], looks: Mapping[str, dict[str, Any]]) -> None:
    # the first label, the page's subject, is on top; commands and measurements are below
    beneath = [line for line in panel.lines if line[0] in (COMMAND, MEASURED)]
    above = [line for line in panel.lines if line[0] not in (COMMAND, MEASURED)]
    for label, seconds, known in (*beneath, *reversed(above)):
        time, values = thin(seconds, np.where(np.isfinite(known), known, np.nan))
        figure.add_scatter(
            **_abscissa(time), y=values.astype(np.float32), name=plain(label), legendgroup=label,
            showlegend=False, mode="lines", line=looks[label], hovertemplate="%{y:.4g}", **place,
        )  # fmt: skip
    beside = dict(y=0.5, xanchor="right", xshift=-70, textangle=-90)
    where = dict(y=1, xanchor="left", yanchor="bottom") if panel.titled else beside
    if panel.name:
        name = dict(text=f"<b>{plain(panel.name)}</b>", xref="x domain", yref="y domain", showarrow=False, x=0)
        figure.add_annotation(name, **where, **place)
    figure.update_yaxes(title_text=panel.axis, range=_range(panel), nticks=5, **place)


def _abscissa(time: np.ndarray) -> dict[str, Any]:
    """Evenly spaced times as start and step, which halves the size of the page."""
    steps = np.diff(time)
    if len(steps) and np.allclose(steps, steps.mean(), rtol=1e-4, atol=0):
        return dict(x0=float(time[0]), dx=float(steps.mean()))
    return dict(x=time.astype(np.float32))


def _range(panel: Panel) -> list[float] | None:
    """The panel's y range if its data span less than `least_span`; otherwise None."""
    values = np.concatenate([known[np.isfinite(known)] for *_, known in panel.lines])
    if not values.size or np.ptp(values) >= panel.least_span:
        return None
    middle = (float(values.min()) + float(values.max())) / 2
    return [middle - panel.least_span / 2, middle + panel.least_span / 2]
