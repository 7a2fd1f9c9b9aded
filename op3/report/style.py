"""Colours, names and the plotly layout that all figures share."""

from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go

INK = "#16181d"
"""Measured data, axes' text."""

MUTED = "#6b7280"
"""Ticks, commands, everything that is context."""

PALETTE = ("#0072b2", "#e07b00", "#009e73", "#aa4499", "#56b4e9", "#8a6d00")
"""Colours of predictions by order, told apart with any colour vision (after Okabe & Ito 2008)."""

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"

MEASURED = "measured"
COMMAND = "command"

_WORDS = {"l": "left", "r": "right", "sho": "shoulder", "el": "elbow", "ank": "ankle", "com": "CoM"}


def colours(labels: Sequence[str]) -> dict[str, str]:
    """One colour per label, by order; they repeat after six."""
    return {label: PALETTE[i % len(PALETTE)] for i, label in enumerate(labels)}


def words(name: str) -> str:
    """A name as people say it: ``l_ank_pitch`` becomes ``left ankle pitch``."""
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
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"


def dress(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """Give a figure the shared fonts, grid, legend on top and this height [pixels]."""
    axis = dict(
        showgrid=True,
        gridcolor="#eceef1",
        zeroline=False,
        linecolor="#c6cad1",
        showline=True,
        ticks="outside",
        ticklen=3,
        tickcolor="#c6cad1",
        tickfont=dict(size=11, color=MUTED),
        title=dict(font=dict(size=12, color=INK), standoff=6),
    )
    figure.update_layout(
        height=height,
        # a template reaches all axes at once; a figure of many panels would take seconds to go through them
        template=go.layout.Template(layout=dict(xaxis=axis, yaxis=axis)),
        font=dict(family=FONT, size=12, color=INK),
        paper_bgcolor="white",
        plot_bgcolor="white",
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
        hoverlabel=dict(font=dict(family=FONT, size=12)),
        dragmode="zoom",
    )
    figure.update_layout(**layout)
    return figure
