"""What logs tell about parameters: singular values, correlations, and sentences."""

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.identify.identifiability import SHARE, WIDTH, Identifiability
from op3.report.page import Page
from op3.report.style import GROUND, INK, PALETTE, dress, words
from op3.report.tables import number


def identifiability_section(page: Page, known: Identifiability) -> None:
    """Add a section with the combinations that the logs do not tell, their figure, and a row per parameter."""
    page.section("What the logs tell")
    says = {
        name: "at its bound" if name in known.at_bound else "identifiable" if known.identifiable[name] else "not told"
        for name in known.names
    }
    meanings = {
        "identifiable": f"Identifiable (90 % interval below {SHARE:.0%} of the range)",
        "at its bound": "At its bound, where the range searched ended and not the data",
        "not told": "Not identifiable",
    }
    sentences = []
    for verdict, meaning in meanings.items():
        named = [words(name) for name in known.names if says[name] == verdict]
        if named or verdict == "identifiable":
            sentences.append(f"{meaning}: {', '.join(named) or 'none'}.")
    page.text(" ".join(sentences))
    for sentence in known.unknown:
        page.text(sentence[0].upper() + sentence[1:] + ".")
    page.figure(
        identifiability_figure(known),
        "Left: how well each combination of parameters is known, one standard deviation against the ranges searched;"
        f" right of the line a 90 % interval is wider than {SHARE:.0%} of them. Right: correlation of the estimates.",
    )
    rows = [[words(name), 100 * known.widths[name], says[name]] for name in known.names]
    header = ["parameter", "width of the interval [% of the range]", "verdict"]
    page.table(header, rows, caption="Parameters by what the logs tell of them.", digits=3)


def identifiability_figure(known: Identifiability) -> go.Figure:
    """Uncertainty of each combination, named by its strongest parameters, beside the correlation of the estimates."""
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
