"""Figures of an identification: how the loss fell, where the parameters lie, and what each run is worth."""

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.identify.intervals import at_bound
from op3.report.style import FRAME, GROUND, INK, MUTED, SHADE, colours, dress, faded, plain, unit_text, words
from op3.report.tables import Bounds, bounded_parameters, number, place_in_range
from op3.rollout import Rollout
from op3.servo import Estimate, Parameter, RobotModel
from op3.servo.conditions import split_name

MOST_DOTS = 3000
"""Single trials drawn per label; of more, every n-th is."""


def history_figure(
    trials: Mapping[str, Sequence[float | None]], refined: Mapping[str, Sequence[float]] | None = None
) -> go.Figure:
    """Loss over trials: the best so far as a line, single trials as faint dots, failed ones left out.

    Args:
        trials: loss of every trial by label, in order; None or NaN where the simulation failed.
        refined: loss after every round and iteration that followed the trials, by label, drawn beside.
    """
    refined = {label: values for label, values in (refined or {}).items() if len(values)}
    wide = [0.7, 0.3] if refined else [1.0]
    figure = make_subplots(rows=1, cols=len(wide), column_widths=wide, shared_yaxes=True, horizontal_spacing=0.03)
    colour = colours(list(dict.fromkeys([*trials, *refined])))
    for label, losses in trials.items():
        values = np.array([np.nan if value is None else value for value in losses], dtype=float)
        values[~np.isfinite(values)] = np.nan
        count, look = np.arange(1, len(values) + 1), dict(name=plain(label), legendgroup=label, row=1, col=1)
        some = np.flatnonzero(np.isfinite(values))[:: max(1, len(values) // MOST_DOTS)]
        figure.add_scatter(
            x=count[some], y=values[some], mode="markers", showlegend=False, hoverinfo="skip",
            marker=dict(color=faded(colour[label], 0.22), size=4), **look,
        )  # fmt: skip
        figure.add_scatter(
            x=count, y=np.fmin.accumulate(values) if len(values) else values, mode="lines",
            line=dict(color=colour[label], width=2.4, shape="hv"), hovertemplate="best %{y:.4g}", **look,
        )  # fmt: skip
    for label, losses in refined.items():
        figure.add_scatter(
            x=np.arange(len(losses)), y=np.array(losses, dtype=float), mode="lines+markers", name=plain(label),
            legendgroup=label, showlegend=label not in trials, line=dict(color=colour[label], width=2.4),
            marker=dict(size=5), hovertemplate="%{y:.4g}", row=1, col=2,
        )  # fmt: skip
        figure.update_xaxes(title_text="round or iteration [-]", col=2)
    dress(figure, 360, hovermode="x unified")
    figure.update_yaxes(type="log", dtick="D2", exponentformat="power")
    figure.update_xaxes(rangemode="tozero", title_text="trial [-]", col=1)
    return figure.update_yaxes(title_text="loss [-]", col=1)


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


def errors_figure(
    logs: Sequence[Rollout], errors_mrad: Mapping[str, Sequence[float | None]], heldout: Sequence[bool]
) -> go.Figure:
    """Position error of every bench run: a panel per trajectory, bars by mass, length and gain, held out hatched.

    Args:
        logs: the runs.
        errors_mrad: by label, mean absolute position error of each run [mrad]; None where the simulation failed.
        heldout: whether each run was kept from the fit.
    """
    motions = list(dict.fromkeys(log.metadata.motion or "runs" for log in logs))
    columns = min(2, len(motions))
    rows = -(-len(motions) // columns)
    inner = 200 * rows + 100 * (rows - 1)
    figure = make_subplots(
        rows=rows, cols=columns, subplot_titles=[f"<b>{plain(words(m))}</b>" for m in motions], shared_yaxes="all",  # type: ignore[arg-type]
        horizontal_spacing=0.04, vertical_spacing=100 / inner if rows > 1 else 0,
    )  # fmt: skip
    colour, hatch = colours(list(errors_mrad)), dict(fgcolor=GROUND, fillmode="overlay", size=5, solidity=0.5)
    order = sorted(range(len(logs)), key=lambda i: _sort_key(logs[i]))
    for m, motion in enumerate(motions):
        members = [i for i in order if (logs[i].metadata.motion or "runs") == motion]
        for label, errors in errors_mrad.items():
            pattern = dict(shape=["/" if heldout[i] else "" for i in members], **hatch)
            figure.add_bar(
                x=_categories([logs[i] for i in members]), y=[errors[i] for i in members], name=plain(label),
                legendgroup=label, showlegend=m == 0, marker=dict(color=colour[label], line_width=0, pattern=pattern),
                customdata=["held out" if heldout[i] else "fitted" for i in members],
                hovertemplate="%{y:.1f} mrad, %{customdata}<extra>" + plain(label) + "</extra>",
                row=m // columns + 1, col=m % columns + 1,
            )  # fmt: skip
    if any(heldout):
        marker = dict(color=MUTED, pattern=dict(shape="/", **hatch))
        figure.add_bar(x=[None], y=[None], name="hatched: held out", marker=marker)
    dress(figure, inner + 72 + 84, barmode="group", bargap=0.25, margin=dict(l=70, r=16, t=72, b=84))
    figure.update_layout(legend_y=1 + 34 / inner)
    figure.update_yaxes(title_text="position error [mrad]", col=1)
    figure.update_xaxes(tickfont=dict(size=10), tickangle=0, showgrid=False, dividercolor=FRAME)
    figure.update_xaxes(title_text="gain kp [firmware units], by mass [kg] and length [m]", row=rows)
    return figure.update_annotations(font_size=13)


def _sort_key(log: Rollout) -> tuple[float, float, float, str]:
    known = log.metadata
    return known.mass or 0.0, known.length or 0.0, known.firmware_gain or 0.0, known.recording or ""


def _categories(logs: Sequence[Rollout]) -> list[list[str]]:
    """Two levels of an axis: the pendulum, and within it the gain; recordings with the same gain are numbered."""
    outer, inner, seen = [], [], {}
    for log in logs:
        known = log.metadata
        pendulum = "" if known.mass is None else f"{known.mass:g} kg<br>{known.length:g} m"
        gain = "-" if known.firmware_gain is None else f"{known.firmware_gain:g}"
        count = seen[pendulum, gain] = seen.get((pendulum, gain), 0) + 1
        outer.append(pendulum)
        inner.append(gain if count == 1 else f"{gain} #{count}")
    return [outer, inner]
