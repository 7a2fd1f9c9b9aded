"""The page of a hidden-effect bench: how often the correct name was found."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import yaml

from op3.report.page import PROSE_TEMPLATES, Page
from op3.report.style import INK, MUTED, colours, dress, plain, spread
from op3.report.tables import TableRows

HERE = Path(__file__).parent

LABELS, MEDIANS, CASE = yaml.safe_load((HERE / "names.yaml").read_text(encoding="utf-8")).values()
"""Names of rates and medians with their aims, and of a case's columns."""


def rates_figure(summaries: Mapping[str, Mapping[str, Any]]) -> go.Figure:
    """Rates with their 95 % intervals, a row per rate, a colour per diagnosis.

    Args:
        summaries: by label; each has `{value, low, high}` or None under the keys of `LABELS`.
    """
    shown = [key for key in LABELS if any(summary.get(key) for summary in summaries.values())]
    figure, colour = go.Figure(), colours(list(summaries))
    lanes = np.linspace(-0.22, 0.22, len(summaries)) if len(summaries) > 1 else [0.0]
    for lane, (label, summary) in zip(lanes, summaries.items(), strict=True):
        some = [(i, summary[key]) for i, key in enumerate(shown) if summary.get(key)]
        middle, low, high = ([100 * rate[part] for _, rate in some] for part in ("value", "low", "high"))
        figure.add_scatter(
            x=middle, y=[i + lane for i, _ in some], error_x=spread(middle, low, high), mode="markers",
            name=plain(label), marker=dict(color=colour[label], size=9),
            customdata=[[rate["count"], rate["of"]] for _, rate in some],
            hovertemplate="%{x:.0f} %, %{customdata[0]} of %{customdata[1]}",
        )  # fmt: skip
    dress(figure, 110 + 34 * len(shown), margin=dict(l=330, r=24, t=48, b=48), hovermode="closest")
    figure.update_xaxes(title_text="share of cases [%]", range=[-2, 102])
    return figure.update_yaxes(
        tickvals=list(range(len(shown))), ticktext=[LABELS[key][0] for key in shown],
        range=[len(shown) - 0.5, -0.5], tickfont=dict(size=13, color=INK),
    )  # fmt: skip


def reliability_figure(calibrations: Mapping[str, Mapping[str, Any]]) -> go.Figure | None:
    """Stated probability against the share of correct findings, in five bins; None without findings."""
    figure, colour = go.Figure(), colours(list(calibrations))
    for label, values in calibrations.items():
        if values["reliability"]:
            *shares, count = np.transpose(values["reliability"])
            stated, right, low, high = 100 * np.array(shares)
            figure.add_scatter(
                x=stated, y=right, error_y=spread(right, low, high), mode="lines+markers", name=plain(label),
                marker=dict(color=colour[label], size=6 + 2 * np.sqrt(count)), customdata=count,
                hovertemplate="%{y:.0f} % of %{customdata} correct",
            )  # fmt: skip
    if not figure.data:
        return None
    figure.add_scatter(x=[0, 100], y=[0, 100], mode="lines", name="perfect", line=dict(color=MUTED, dash="dot"))
    dress(figure, 380, hovermode="closest")
    figure.update_xaxes(title_text="stated probability [%]", range=[0, 102])
    return figure.update_yaxes(title_text="correct [%]", range=[-2, 102])


def naming_page(
    rows: Sequence[Mapping[str, Any]],
    summaries: Mapping[str, Mapping[str, Any]],
    title: str,
    commitment: str,
) -> Page:
    """The page of a bench.

    Args:
        rows: score of every case of the first diagnosis.
        summaries: by label, the diagnosis first, baselines after it.
        title: title of the page.
        commitment: SHA-256 of the list of sealed answers.
    """
    summary = next(iter(summaries.values()))
    figures = {
        "rates": rates_figure(summaries),
        "reliability": reliability_figure({label: s["calibration"] for label, s in summaries.items()}),
    }
    template = PROSE_TEMPLATES.from_string((HERE / "naming.md").read_text(encoding="utf-8"))
    prose = template.render(s=summary, labels=LABELS, title=title, commitment=commitment)
    return Page(prose, figures, _tables(rows, summary))


def _tables(rows: Sequence[Mapping[str, Any]], summary: Mapping[str, Any]) -> dict[str, TableRows]:
    rates = [
        [label, rate["count"], rate["of"], *(100 * rate[k] for k in ("value", "low", "high")), aim]
        for key, (label, aim) in LABELS.items()
        if (rate := summary.get(key))
    ]
    medians = [
        [label, s["value"], s["low"], s["high"], s["of"], aim]
        for key, (label, aim) in MEDIANS.items()
        if (s := summary.get(key))
    ]
    error, count = (summary["calibration"][key] for key in ("ece", "findings"))
    if error is not None:
        medians.append(["calibration error of stated probability", error, None, None, count, "at most 0.1"])
    return {
        "rates": (["rate", "count", "of", "%", "from %", "to %", "aim"], rates),
        "medians": (["median over cases", "value", "from", "to", "of", "aim"], medians),
        "cases": (list(CASE.values()), [[row[key] for key in CASE] for row in rows]),
    }
