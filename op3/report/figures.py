"""Figures of an identification: decrease of the loss, and parameters within their ranges."""

from collections.abc import Mapping, Sequence
from itertools import accumulate

import numpy as np
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.report.style import GROUND, INK, Curves, colours, dress, faded, grid_figure, plain, spread, unit_text
from op3.report.tables import Bounds, bounded_parameters, number, place_in_range, span
from op3.servo import RobotModel
from op3.servo.conditions import split_name


def history_figure(
    trials: Mapping[str, Sequence[float | None]], refined: Mapping[str, Sequence[float]] | None = None
) -> go.Figure:
    """The best loss so far over trials and, beside it, the loss over the following rounds and iterations.

    Args:
        trials: loss of every trial by label, in order; None or NaN if the simulation failed.
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

    All ranges (paper Table I) are drawn with the same length. Values of single joints are open circles. A model without
    a parameter has no marker for it.

    Args:
        bounds: drawn ranges by name, if they differ from the catalogue's.
        starts: initial values of the search by name, if they differ from the catalogue's.
    """
    known = bounded_parameters(models.values(), bounds, starts)
    figure, colour = go.Figure(), colours(list(models))
    begun = [place_in_range(known[name], known[name].nominal) for name in names]
    tick = dict(symbol="line-ns", size=30, line=dict(color=INK, width=2))
    figure.add_scatter(x=begun, y=[*range(len(names))], mode="markers", name="start", marker=tick, hoverinfo="skip")
    lanes = np.linspace(-0.2, 0.2, len(models)) if len(models) > 1 else [0.0]
    for lane, (label, model) in zip(lanes, models.items(), strict=True):
        rows = [row for row, name in enumerate(names) if split_name(name)[0] in model.parameters()]
        found = [(known[names[row]], model.estimate(names[row])) for row in rows]
        places = [place_in_range(p, e.value) for p, e in found]
        ends = [
            [place_in_range(p, e.value if e.low is None else getattr(e, end)) for p, e in found]
            for end in ("low", "high")
        ]
        figure.add_scatter(
            x=places, y=[row + lane for row in rows], mode="markers", name=plain(label),
            error_x=dict(**spread(places, *ends), color=faded(colour[label], 0.4)),
            marker=dict(color=colour[label], size=10), text=[f"{span(e)} {unit_text(p.unit)}" for p, e in found],
            hovertemplate="%{text}",
        )  # fmt: skip
        single = [
            (row + lane, p, joint, value)
            for row, (p, e) in zip(rows, found, strict=True)
            for joint, value in e.joints.items()
        ]
        figure.add_scatter(
            x=[place_in_range(p, value) for _, p, _, value in single], y=[y for y, *_ in single], mode="markers",
            marker=dict(color=GROUND, size=7, line=dict(color=colour[label], width=1.4)), showlegend=False,
            text=[f"{words(joint)}: {number(value)}" for *_, joint, value in single], hovertemplate="%{text}",
        )  # fmt: skip
    dress(figure, 110 + 44 * len(names), margin=dict(l=280, r=24, t=48, b=48), hovermode="closest")
    titles = [f"{words(name)} [{unit_text(known[name].unit)}]" for name in names]
    figure.update_yaxes(range=[len(names) - 0.45, -0.55], tickvals=[*range(len(names))], ticktext=titles)
    return figure.update_xaxes(
        range=[-0.02, 1.02], tickformat=".0%", title_text="position in the parameter's range [%]"
    )
