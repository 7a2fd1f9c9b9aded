"""Colours, names and the plotly layout that all figures share."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import yaml
from plotly.subplots import make_subplots

from op3.common.plain_names import words

INK = "#16181d"
"""Measured data, axes' text."""

MUTED = "#6b7280"
"""Ticks, commands, context."""

PALETTE = ("#0072b2", "#e07b00", "#009e73", "#aa4499", "#56b4e9", "#8a6d00")
"""Colours of predictions by order, distinguishable with any colour vision (after Okabe & Ito 2008)."""

GRID, FRAME, SHADE, GROUND = "#eceef1", "#c6cad1", "#f1f3f6", "#ffffff"
"""Grid lines, axes' lines, ranges and phases behind the data, and the page's background."""

_DARK = ("#e9ebee", "#a0a7b4", "#2b2f37", "#4a505b", "#262a32", "#1c1f25",
         "#4aa3df", "#f39a3d", "#2fc59a", "#d07fc4", "#9ad7fa", "#d0b03a")  # fmt: skip
DARK = dict(zip((INK, MUTED, GRID, FRAME, SHADE, GROUND, *PALETTE), _DARK, strict=True))
"""Colours for dark mode, by colour."""

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"

MEASURED = "measured"
COMMAND = "command"

NAMES = yaml.safe_load((Path(__file__).parent / "templates" / "names.yaml").read_text(encoding="utf-8"))
"""Names on pages and in results, by kind; the file documents them."""


def colours(labels: Sequence[str]) -> dict[str, str]:
    """One colour per label, in order; colours repeat after six."""
    return {label: PALETTE[i % len(PALETTE)] for i, label in enumerate(labels)}


def unit_text(unit: str) -> str:
    """A unit as printed: ``kg m^2`` becomes ``kg m²``."""
    return unit.replace("^2", "²").replace("^3", "³")


def plain(text: str) -> str:
    """Text for a figure, escaped because plotly reads ``<`` as the start of a tag."""
    return text.replace("<", "&lt;")


def faded(colour: str, alpha: float) -> str:
    """A colour ``#rrggbb`` with this opacity."""
    return f"{colour}{round(255 * alpha):02x}"


def dress(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """Apply the shared fonts and grid, a legend on top and this height [pixels] to a figure."""
    axis = dict(
        showgrid=True, gridcolor=GRID, zeroline=False, linecolor=FRAME, showline=True, ticks="outside", ticklen=3,
        tickcolor=FRAME, tickfont=dict(size=11, color=MUTED), title=dict(font=dict(size=12, color=INK), standoff=6),
    )  # fmt: skip
    figure.update_layout(
        height=height,
        # a template changes all axes at once; changing them one by one takes seconds in a figure of many panels
        template=go.layout.Template(layout=dict(xaxis=axis, yaxis=axis)),
        font=dict(family=FONT, size=12, color=INK),
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        # pixels above the plot, whatever its height
        legend=dict(orientation="h", x=0, xanchor="left", y=1 + 14 / height, yanchor="bottom", font=dict(size=13),
                    tracegroupgap=0),
        margin=dict(l=70, r=20, t=48, b=48),
        hoverlabel=dict(font=dict(family=FONT, size=12, color=INK), bgcolor=GROUND, bordercolor=FRAME),
        modebar=dict(bgcolor="rgba(0,0,0,0)", color=FRAME, activecolor=MUTED),
        dragmode="zoom",
    )  # fmt: skip
    return figure.update_layout(**layout)


def shade(figure: go.Figure, phases: Any, count: int, **more: Any) -> None:
    """Shade gait phases behind the curves, given the number of phases in a cycle."""
    for phase in phases:
        ends = dict(x0=phase - 0.5 / count, x1=phase + 0.5 / count)
        figure.add_vrect(**ends, fillcolor=SHADE, line_width=0, layer="below", **more)


Curves = Mapping[str, tuple]
"""Abscissae, ordinates and optionally lower and upper ends of a band, ``[point]`` each, by label."""


def grid_figure(
    panels: Mapping[str, Curves], x: str, height: int, columns: int = 1, mode: str = "lines", **layout: Any
) -> go.Figure:
    """Panels of labelled curves over one abscissa; each label has one colour and one legend entry for all panels.

    Args:
        panels: curves by ordinate title with unit or, if all panels share the ordinate ``y``, by panel title.
        x: title of the abscissa with its unit.
        height: height of the figure [pixel].
        columns: number of panels side by side.
        mode: ``lines``, ``markers`` or both.
        layout: further settings of plotly; also ``y``, title of the shared ordinate, and ``shape`` of lines (``hv`` for
            steps).
    """
    y, shape = layout.pop("y", None), layout.pop("shape", "linear")
    rows, one, titled = -(-len(panels) // columns), y is not None, y is not None and len(panels) > 1
    figure = make_subplots(
        rows=rows, cols=columns, subplot_titles=list(panels) if titled else None, shared_xaxes=one or columns == 1,
        shared_yaxes=one, horizontal_spacing=(0.04 if one else 0.11) * (columns > 1),  # type: ignore[arg-type]
        vertical_spacing=(56 if columns > 1 else 32) / height * (rows > 1),
    )  # fmt: skip
    colour = colours(list(dict.fromkeys(label for curves in panels.values() for label in curves)))
    told: set[str] = set()
    for number, (title, curves) in enumerate(panels.items()):
        place: dict[str, Any] = dict(row=number // columns + 1, col=number % columns + 1)
        for label, (abscissae, ordinates, *ends) in curves.items():
            look: dict[str, Any] = dict(name=plain(label), legendgroup=label, **place)
            if ends:
                low, high = ends
                _band(figure, abscissae, low, high, colour[label], **look)
            figure.add_scatter(
                x=abscissae, y=ordinates, mode=mode, line=dict(color=colour[label], width=2, shape=shape),
                marker=dict(color=colour[label], size=7), showlegend=label not in told, hovertemplate="%{y:.4g}",
                **look,
            )  # fmt: skip
            told.add(label)
        if not one:
            figure.update_yaxes(title_text=title, **place)
    figure.update_xaxes(title_text=x, row=rows)
    if one:
        figure.update_yaxes(title_text=y, col=1)
    return dress(figure, height, **{"hovermode": "closest", **layout})


def _band(figure: go.Figure, x: Any, low: Any, high: Any, colour: str, **more: Any) -> None:
    """Fill the area between two curves ``[point]`` where both have values."""
    x, low, high = np.stack([x, low, high])[:, np.isfinite(low) & np.isfinite(high)]
    figure.add_scatter(
        x=[*x, *x[::-1]], y=[*low, *high[::-1]], fill="toself", fillcolor=faded(colour, 0.18), mode="lines",
        line=dict(width=0), showlegend=False, hoverinfo="skip", **more,
    )  # fmt: skip


def curves_figure(curves: Curves, x: str, y: str, height: int = 360, mode: str = "lines", **layout: Any) -> go.Figure:
    """Labelled curves over one pair of axes; arguments as in `grid_figure`."""
    return grid_figure({y: curves}, x, height, 1, mode, **layout)


def spread(middle: Any, low: Any, high: Any) -> dict[str, Any]:
    """Error bars from `low` to `high`."""
    return dict(
        type="data", symmetric=False, thickness=1.5, width=0, array=np.subtract(high, middle),
        arrayminus=np.subtract(middle, low),
    )  # fmt: skip


def boxes_figure(boxes: Mapping[str, Mapping[str, Sequence[float]]], y: str, height: int = 380) -> go.Figure:
    """Single values and their quartiles, by label (one colour each), then by position on the abscissa."""
    figure, colour = go.Figure(), colours(list(boxes))
    for label, places in boxes.items():
        figure.add_box(
            x=[place for place, values in places.items() for _ in values], name=plain(label), boxpoints="all",
            y=[value for values in places.values() for value in values], jitter=0.5, pointpos=0, line_width=1.2,
            marker=dict(color=colour[label], size=5), fillcolor="rgba(0,0,0,0)",
        )  # fmt: skip
    return dress(figure, height, boxmode="group", hovermode="closest", yaxis_title_text=y)


def bars_figure(
    bars: Mapping[str, Mapping[str, float]], y: str, spreads: Mapping[str, Mapping[str, float]] | None = None
) -> go.Figure:
    """Bars side by side, by label (one colour each), then by category on the abscissa.

    Args:
        bars: heights of the bars.
        y: title of the ordinate with its unit.
        spreads: half lengths of the error bars, by the same labels.
    """
    figure, colour = go.Figure(), colours(list(bars))
    for label, values in bars.items():
        error = dict(type="data", array=list(spreads[label].values()), thickness=1.2) if spreads else None
        places = [words(name) for name in values]
        figure.add_bar(x=places, y=list(values.values()), name=label, marker_color=colour[label], error_y=error)
    return dress(figure, 380, barmode="group", margin_r=40, yaxis_title_text=y).update_xaxes(automargin=True)
