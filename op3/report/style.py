"""Colours, names and the plotly layout that all figures share."""

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

INK = "#16181d"
"""Measured data, axes' text."""

MUTED = "#6b7280"
"""Ticks, commands, everything that is context."""

PALETTE = ("#0072b2", "#e07b00", "#009e73", "#aa4499", "#56b4e9", "#8a6d00")
"""Colours of predictions by order, told apart with any colour vision (after Okabe & Ito 2008)."""

GRID, FRAME, SHADE, GROUND = "#eceef1", "#c6cad1", "#f1f3f6", "#ffffff"
"""Grid lines, axes' lines, ranges and phases behind the data, and what is as the page itself."""

DARK = dict(
    zip(
        (INK, MUTED, GRID, FRAME, SHADE, GROUND, *PALETTE),
        (*("#e9ebee", "#a0a7b4", "#2b2f37", "#4a505b", "#262a32", "#1c1f25"),
         *("#4aa3df", "#f39a3d", "#2fc59a", "#d07fc4", "#9ad7fa", "#d0b03a")),
        strict=True,
    )
)  # fmt: skip
"""What each colour becomes where the reader's screen is dark."""

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"

MEASURED = "measured"
COMMAND = "command"

_WORDS = {"l": "left", "r": "right", "sho": "shoulder", "el": "elbow", "ank": "ankle", "com": "CoM"}


def colours(labels: Sequence[str]) -> dict[str, str]:
    """One colour per label, by order; they repeat after six."""
    return {label: PALETTE[i % len(PALETTE)] for i, label in enumerate(labels)}


def words(name: str) -> str:
    """A name as people say it: ``l_wrist`` becomes ``left wrist``."""
    name, _, joint = name.partition("@joint=")
    parts = name.replace("@", " at ").split("_")
    spoken = " ".join(_WORDS.get(part, part) for part in parts)
    return f"{spoken} of the {words(joint)}" if joint else spoken


def unit_text(unit: str) -> str:
    """A unit as printed: ``kg m^2`` becomes ``kg m²``."""
    return unit.replace("^2", "²").replace("^3", "³")


def plain(text: str) -> str:
    """Text for a figure, where plotly would otherwise read ``<`` as the start of a tag."""
    return text.replace("<", "&lt;")


def faded(colour: str, alpha: float) -> str:
    """A colour ``#rrggbb`` with this opacity."""
    return f"{colour}{round(255 * alpha):02x}"


def dress(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """Give a figure the shared fonts, grid, legend on top and this height [pixels]."""
    axis = dict(
        showgrid=True,
        gridcolor=GRID,
        zeroline=False,
        linecolor=FRAME,
        showline=True,
        ticks="outside",
        ticklen=3,
        tickcolor=FRAME,
        tickfont=dict(size=11, color=MUTED),
        title=dict(font=dict(size=12, color=INK), standoff=6),
    )
    figure.update_layout(
        height=height,
        # a template reaches all axes at once; a figure of many panels would take seconds to go through them
        template=go.layout.Template(layout=dict(xaxis=axis, yaxis=axis)),
        font=dict(family=FONT, size=12, color=INK),
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        # pixels above the plot, whatever its height
        legend=dict(
            orientation="h",
            x=0,
            xanchor="left",
            y=1 + 14 / height,
            yanchor="bottom",
            font=dict(size=13),
            tracegroupgap=0,
        ),
        margin=dict(l=70, r=20, t=48, b=48),
        hoverlabel=dict(font=dict(family=FONT, size=12, color=INK), bgcolor=GROUND, bordercolor=FRAME),
        modebar=dict(bgcolor="rgba(0,0,0,0)", color=FRAME, activecolor=MUTED),
        dragmode="zoom",
    )
    figure.update_layout(**layout)
    return figure


def band(figure: go.Figure, x: Any, low: Any, high: Any, colour: str, **more: Any) -> None:
    """Fill what lies between two curves ``[point]``."""
    figure.add_scatter(
        x=[*x, *x[::-1]], y=[*low, *high[::-1]], fill="toself", fillcolor=faded(colour, 0.18), mode="lines",
        line=dict(width=0), showlegend=False, hoverinfo="skip", **more,
    )  # fmt: skip


def shade(figure: go.Figure, phases: Any, count: int, **more: Any) -> None:
    """Shade phases of a gait, of so many in a cycle, behind the curves."""
    for phase in phases:
        ends = dict(x0=phase - 0.5 / count, x1=phase + 0.5 / count)
        figure.add_vrect(**ends, fillcolor=SHADE, line_width=0, layer="below", **more)


Curves = Mapping[str, tuple[Any, Any]]
"""Abscissae and ordinates ``[point]`` by label."""


def curves_figure(
    curves: Curves, x: str, y: str, height: int = 360, mode: str = "lines", shape: str = "linear", **layout: Any
) -> go.Figure:
    """Labelled curves over one pair of axes, with a colour each.

    Args:
        curves: by label.
        x: title of the abscissa with its unit.
        y: title of the ordinate with its unit.
        height: of the figure [pixel].
        mode: ``lines``, ``markers`` or both.
        shape: ``linear``, or ``hv`` and ``hvh`` for steps.
        layout: further settings of plotly.
    """
    figure, colour = go.Figure(), colours(list(curves))
    for label, (abscissae, ordinates) in curves.items():
        line = dict(color=colour[label], width=2, shape=shape)
        figure.add_scatter(
            x=abscissae, y=ordinates, mode=mode, name=plain(label), line=line, marker=dict(color=colour[label], size=7),
            hovertemplate="%{y:.4g}",
        )  # fmt: skip
    figure.update_xaxes(title_text=x)
    figure.update_yaxes(title_text=y)
    return dress(figure, height, **{"hovermode": "closest", **layout})


def boxes_figure(boxes: Mapping[str, Mapping[str, Sequence[float]]], y: str, height: int = 380) -> go.Figure:
    """Single values and their quartiles: by label, a colour each, then by place on the abscissa."""
    figure, colour = go.Figure(), colours(list(boxes))
    for label, places in boxes.items():
        figure.add_box(
            x=[place for place, values in places.items() for _ in values], name=plain(label), boxpoints="all",
            y=[value for values in places.values() for value in values], jitter=0.5, pointpos=0, line_width=1.2,
            marker=dict(color=colour[label], size=5), fillcolor="rgba(0,0,0,0)",
        )  # fmt: skip
    figure.update_yaxes(title_text=y)
    return dress(figure, height, boxmode="group", hovermode="closest")


def bars_figure(
    bars: Mapping[str, Mapping[str, float]], y: str, spreads: Mapping[str, Mapping[str, float]] | None = None
) -> go.Figure:
    """Bars side by side: by label, a colour each, then by what stands on the abscissa.

    Args:
        bars: heights.
        y: title of the ordinate with its unit.
        spreads: half lengths of error bars, by the same labels.
    """
    figure, colour = go.Figure(), colours(list(bars))
    for label, values in bars.items():
        error = dict(type="data", array=list(spreads[label].values()), thickness=1.2) if spreads else None
        places = [words(name) for name in values]
        figure.add_bar(x=places, y=list(values.values()), name=label, marker_color=colour[label], error_y=error)
    dress(figure, 380, barmode="group", margin=dict(l=70, r=40, t=48, b=48)).update_xaxes(automargin=True)
    figure.update_yaxes(title_text=y)
    return figure
