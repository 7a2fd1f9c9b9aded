"""Figures of an identification: how the loss fell, and where the parameters lie."""

from collections.abc import Mapping, Sequence
from itertools import accumulate

import numpy as np
import plotly.graph_objects as go

from op3.identify.intervals import at_bound
from op3.report.style import (
    GROUND,
    INK,
    MUTED,
    SHADE,
    Curves,
    colours,
    dress,
    faded,
    grid_figure,
    plain,
    unit_text,
    words,
)
from op3.report.tables import Bounds, bounded_parameters, number, place_in_range
from op3.servo import Estimate, Parameter, RobotModel
from op3.servo.conditions import split_name


def history_figure(
    trials: Mapping[str, Sequence[float | None]], refined: Mapping[str, Sequence[float]] | None = None
) -> go.Figure:
    """The best loss so far over trials, and beside it the loss over the rounds and iterations that followed them.

    Args:
        trials: loss of every trial by label, in order; None or NaN where the simulation failed.
        refined: loss after every round and iteration, by label.
    """
    best: dict[str, tuple] = {}
    for label, losses in trials.items():
        values = np.array(losses, dtype=float)  # None becomes NaN
        values[~np.isfinite(values)] = np.nan
        best[label] = np.arange(1, len(values) + 1), list(accumulate(values, np.fmin))
    panels: dict[str, Curves] = {"trials": best}
    if after := {label: (np.arange(len(losses)), losses) for label, losses in (refined or {}).items() if losses}:
        panels["rounds and iterations"] = after
    figure = grid_figure(panels, "trial, round or iteration [-]", 360, len(panels), shape="hv", y="loss [-]")
    return figure.update_yaxes(type="log", dtick="D2", exponentformat="power")


def ranges_figure(
    models: Mapping[str, RobotModel],
    names: Sequence[str],
    bounds: Bounds | None = None,
    starts: Mapping[str, float] | None = None,
) -> go.Figure:
    """Parameters within their ranges: value, 90 % interval, start of the search, and the labels side by side.

    Every bar is a parameter's range (paper Table I), scaled to the same length. Values of single joints are open
    circles. A model whose effects do not have a parameter has no marker there.

    Args:
        models: by label.
        names: parameters to show.
        bounds: ranges to draw, by name, where they are not the catalogue's.
        starts: values that the search started from, by name, where they are not the catalogue's.

    Raises:
        ValueError: if no model has a parameter that is named.
    """
    known = bounded_parameters(models.values(), bounds, starts)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"no model has the parameter {unknown[0]!r}; they have {', '.join(known)}")
    figure, colour = go.Figure(), colours(list(models))
    lanes = np.linspace(-0.2, 0.2, len(models)) if len(models) > 1 else [0.0]
    for row, name in enumerate(names):
        _range_bar(figure, known[name], row)
        for lane, (label, model) in zip(lanes, models.items(), strict=True):
            if split_name(name)[0] in model.parameters():
                place = (row + lane, plain(label), colour[label])
                _estimate(figure, known[name], model.estimate(name), *place, name in (bounds or {}))
    start = dict(symbol="line-ns", size=13, line=dict(color=INK, width=2))
    for label, marker in {**{plain(k): dict(color=c, size=10) for k, c in colour.items()}, "start": start}.items():
        figure.add_scatter(x=[None], y=[None], mode="markers", name=label, marker=marker)
    dress(figure, 110 + 52 * len(names), margin=dict(l=340, r=320, t=48, b=48), hovermode="closest")
    titles = [f"{words(name)} [{unit_text(known[name].unit)}]" for name in names]
    figure.update_yaxes(
        tickvals=list(range(len(names))), ticktext=titles, range=[len(names) - 0.45, -0.55], showgrid=False,
        showline=False, ticks="", tickfont=dict(size=13, color=INK), ticklabelstandoff=58,
    )  # fmt: skip
    return figure.update_xaxes(
        range=[-0.005, 1.005], tickvals=[0, 0.25, 0.5, 0.75, 1], tickformat=".0%", showgrid=False, showline=False,
        title_text="place in the parameter's range [%]",
    )  # fmt: skip


def _range_bar(figure: go.Figure, known: Parameter, row: int) -> None:
    ends = dict(y0=row - 0.34, y1=row + 0.34)
    figure.add_shape(type="rect", x0=0, x1=1, fillcolor=SHADE, line_width=0, layer="below", **ends)
    nominal = place_in_range(known, known.nominal)
    if 0.0 <= nominal <= 1.0:
        figure.add_shape(type="line", line=dict(color=INK, width=2), x0=nominal, x1=nominal, **ends)
    for x, value, anchor in ((0, known.low, "right"), (1, known.high, "left")):
        text = dict(text=number(value, 3), xanchor=anchor, showarrow=False, font=dict(size=11, color=MUTED))
        figure.add_annotation(x=x, y=row, **text)


def _estimate(
    figure: go.Figure, known: Parameter, estimate: Estimate, y: float, label: str, colour: str, searched: bool
) -> None:
    middle, quiet = place_in_range(known, estimate.value), dict(showlegend=False)
    text = number(estimate.value) + ("  at its bound" if searched and at_bound(middle) else "")
    if estimate.low is not None and estimate.high is not None:
        text += f"  ({number(estimate.low, 3)} to {number(estimate.high, 3)})"
        ends = [place_in_range(known, end) for end in (estimate.low, estimate.high)]
        line = dict(color=faded(colour, 0.4), width=7)
        figure.add_scatter(x=ends, y=[y, y], mode="lines", line=line, hoverinfo="skip", **quiet)
    if estimate.joints:
        figure.add_scatter(
            x=[place_in_range(known, value) for value in estimate.joints.values()], y=[y] * len(estimate.joints),
            mode="markers", marker=dict(color=GROUND, size=7, line=dict(color=colour, width=1.4)),
            customdata=[[words(joint), value] for joint, value in estimate.joints.items()],
            hovertemplate="%{customdata[0]}: %{customdata[1]:.4g}<extra></extra>", **quiet,
        )  # fmt: skip
    figure.add_scatter(
        x=[middle], y=[y], mode="markers", marker=dict(color=colour, size=10), cliponaxis=False,
        hovertemplate=f"{label}: {text} {unit_text(known.unit)}<extra></extra>", **quiet,
    )  # fmt: skip
    font = dict(size=11.5, color=colour)
    figure.add_annotation(x=1, xshift=60, y=y, text=text, xanchor="left", showarrow=False, font=font)
