"""Identifiability of parameters: singular values, correlations, and sentences."""

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.common.plain_names import words
from op3.identify.identifiability import SHARE, WIDTH, Identifiability
from op3.report.style import GROUND, INK, PALETTE, dress
from op3.report.tables import TableRows, number


def verdicts(known: Identifiability) -> dict[str, list[str]]:
    """Parameters by what the logs identify: ``identifiable``, ``at its bound`` or ``not identifiable``."""
    sorted_names: dict[str, list[str]] = {"identifiable": [], "at its bound": [], "not identifiable": []}
    for name in known.names:
        verdict = "identifiable" if known.identifiable[name] else "not identifiable"
        sorted_names["at its bound" if name in known.at_bound else verdict].append(name)
    return sorted_names


def widths_table(known: Identifiability) -> TableRows:
    """Width of every parameter's interval, and the resulting verdict."""
    says = {name: verdict for verdict, names in verdicts(known).items() for name in names}
    rows = [[words(name), 100 * known.widths[name], says[name]] for name in known.names]
    return ["parameter", "width of the interval [% of the range]", "verdict"], rows


def identifiability_figure(known: Identifiability) -> go.Figure:
    """Uncertainty of each combination, labelled by its strongest parameters, and the correlation of the estimates."""
    figure = make_subplots(rows=1, cols=2, column_widths=[0.45, 0.55], horizontal_spacing=0.26)
    deviation = 1.0 / np.maximum(known.singular_values, 1e-6)
    labels, places = [_label(known, row) for row in range(len(deviation))], list(range(len(deviation)))
    figure.add_bar(
        x=deviation, y=places, orientation="h", marker=dict(color=PALETTE[0], line_width=0), showlegend=False,
        hovertext=labels, hovertemplate="%{hovertext}: %{x:.3g}<extra></extra>", row=1, col=1,
    )  # fmt: skip
    figure.add_vline(x=SHARE / WIDTH, line=dict(color=INK, width=1, dash="dot"), row=1, col=1)  # type: ignore[arg-type]
    names = [words(name) for name in known.names]
    figure.add_heatmap(
        z=known.correlation, x=names, y=names, zmin=-1, zmax=1, xgap=1, ygap=1,
        colorscale=[[0, PALETTE[1]], [0.5, GROUND], [1, PALETTE[0]]],
        text=[[number(float(value), 2) for value in row] for row in known.correlation], texttemplate="%{text}",
        textfont=dict(size=9), colorbar=dict(title="correlation [-]", thickness=12), row=1, col=2,
        hovertemplate="%{y}, %{x}: %{z:.2f}<extra></extra>",
    )  # fmt: skip
    dress(figure, 180 + 30 * len(names), margin=dict(l=200, r=16, t=24, b=150))
    figure.update_xaxes(type="log", title_text="standard deviation [share of the ranges]", col=1)
    figure.update_yaxes(tickvals=places, ticktext=labels, col=1)
    figure.update_yaxes(autorange="reversed", tickfont=dict(size=10))
    figure.update_xaxes(tickangle=-45, tickfont=dict(size=10), col=2)
    return figure


def identifiability_numbers(known: Identifiability) -> dict[str, object]:
    """The section's numbers for ``result.yaml``."""
    return {
        "identifiability.identifiable": [name for name in known.names if known.identifiable[name]],
        "identifiability.at_bound": list(known.at_bound),
        "identifiability.not_identifiable": [name for name in known.names if not known.identifiable[name]],
        "identifiability.unknown_combinations": list(known.unknown),
        "identifiability.singular_values": known.singular_values.tolist(),
        "identifiability.directions": known.directions.tolist(),
        "identifiability.parameters": list(known.names),
        "identifiability.correlation": known.correlation.tolist(),
        "identifiability.noise": dict(known.noise),
        "interval_share": dict(known.widths),
    }


def _label(known: Identifiability, row: int) -> str:
    """The two strongest parameters of a combination, with their signs relative to the first."""
    direction = known.directions[row]
    first, second = np.argsort(-np.abs(direction))[:2] if len(direction) > 1 else (0, 0)
    if first == second or abs(direction[second]) < 0.3:
        return words(known.names[first])
    sign = "+" if direction[first] * direction[second] > 0 else "−"
    return f"{words(known.names[first])} {sign} {words(known.names[second])}"
