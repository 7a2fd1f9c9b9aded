"""The page of a hidden-effect bench: how often the right name was found, and what was called what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.report.page import Page
from op3.report.style import GROUND, INK, MUTED, PALETTE, SHADE, colours, dress, plain, words
from op3.report.tables import Cell

LABELS: Mapping[str, tuple[str, str]] = {
    "clear_exact": ("one clear or strong effect: right name and joints", "at least 80 %"),
    "clear_family": ("the same, or among what the finding could be besides", ""),
    "strong_exact": ("one strong effect: right name and joints", ""),
    "mild_exact": ("one mild effect: right name and joints", "at least 40 %"),
    "name": ("one effect: right name, wherever", ""),
    "joints": ("right joints where the name is right", "at least 95 %"),
    "clean": ("one effect: no wrong name", ""),
    "pairs_both": ("two effects: both named", "at least 50 %"),
    "pairs_one": ("two effects: one named and no wrong name", "at least 85 %"),
    "sound_named": ("sound robots with a name", "at most 3 %"),
    "outsiders_named": ("outsiders with a name", "at most 5 %"),
    "poor_family": ("poor excitation: right, or among what it could be", ""),
    "confident_wrong": ("a wrong name with more than 0.8", "at most 2 %"),
    "size_coverage": ("size within its 90 % interval", "85 to 95 %"),
}
"""What a rate is called on the page, and the aim."""

MEDIANS: Mapping[str, tuple[str, str]] = {
    "closure_median": ("gap closed, of what is above the spread of repeats", ""),
    "size_ratio_median": ("size found, of the true one", ""),
    "seconds_median": ("time of a diagnosis [s]", "at most 60"),
    "processor_seconds_median": ("processor time of a diagnosis [s]", "at most 120"),
    "peak_memory_median": ("peak memory of a diagnosis [bytes]", "at most 1e9"),
}
"""Medians over cases: what each is called, and the aim."""


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
        figure.add_scatter(
            x=[100 * rate["value"] for _, rate in some], y=[i + lane for i, _ in some], mode="markers",
            name=plain(label), marker=dict(color=colour[label], size=9),
            error_x=dict(
                type="data", symmetric=False, thickness=2, width=0,
                array=[100 * (rate["high"] - rate["value"]) for _, rate in some],
                arrayminus=[100 * (rate["value"] - rate["low"]) for _, rate in some],
            ),
            customdata=[[rate["count"], rate["of"]] for _, rate in some],
            hovertemplate="%{x:.0f} %, %{customdata[0]} of %{customdata[1]}",
        )  # fmt: skip
    dress(figure, 110 + 34 * len(shown), margin=dict(l=330, r=24, t=48, b=48), hovermode="closest")
    figure.update_xaxes(title_text="share of cases [%]", range=[-2, 102])
    figure.update_yaxes(
        tickvals=list(range(len(shown))), ticktext=[LABELS[key][0] for key in shown],
        range=[len(shown) - 0.5, -0.5], tickfont=dict(size=13, color=INK),
    )  # fmt: skip
    return figure


def confusion_figure(truths: Sequence[str], claims: Sequence[str], counts: np.ndarray) -> go.Figure:
    """What was hidden against what was claimed first; counts [truth, claim] in the cells."""
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    figure = go.Figure(
        go.Heatmap(
            z=share, x=[words(name) for name in claims], y=[words(name) for name in truths],
            text=np.where(counts > 0, counts.astype(str), ""), texttemplate="%{text}", zmin=0, zmax=1,
            colorscale=[[0, GROUND], [0.001, SHADE], [1, PALETTE[0]]], showscale=False, xgap=1, ygap=1,
            hovertemplate="hidden: %{y}<br>claimed: %{x}<br>%{z:.0%}<extra></extra>",
        )
    )  # fmt: skip
    dress(figure, 200 + 22 * len(truths), margin=dict(l=220, r=16, t=24, b=170), hovermode="closest")
    figure.update_yaxes(autorange="reversed", title_text="hidden [-]", showgrid=False)
    figure.update_xaxes(title_text="claimed first [-]", tickangle=-55, showgrid=False)
    return figure


def reliability_figure(calibrations: Mapping[str, Mapping[str, Any]]) -> go.Figure | None:
    """Stated probability against the share that was right, by fifths; None where nothing was stated."""
    figure, colour = go.Figure(), colours(list(calibrations))
    for label, values in calibrations.items():
        table = values["reliability"]
        if table:
            figure.add_scatter(
                x=[100 * row[0] for row in table], y=[100 * row[1] for row in table], mode="lines+markers",
                name=plain(label), marker=dict(color=colour[label], size=[6 + 2 * np.sqrt(row[4]) for row in table]),
                customdata=[row[4] for row in table], hovertemplate="%{y:.0f} % of %{customdata} right",
                error_y=dict(
                    type="data", symmetric=False, thickness=1, width=0,
                    array=[100 * (row[3] - row[1]) for row in table],
                    arrayminus=[100 * (row[1] - row[2]) for row in table],
                ),
            )  # fmt: skip
    if not figure.data:
        return None
    figure.add_scatter(x=[0, 100], y=[0, 100], mode="lines", name="perfect", line=dict(color=MUTED, dash="dot"))
    dress(figure, 380, hovermode="closest")
    figure.update_xaxes(title_text="stated probability [%]", range=[0, 102])
    figure.update_yaxes(title_text="right [%]", range=[-2, 102])
    return figure


def naming_page(
    rows: Sequence[Mapping[str, Any]],
    summaries: Mapping[str, Mapping[str, Any]],
    table: tuple[Sequence[str], Sequence[str], np.ndarray],
    title: str,
    commitment: str,
) -> Page:
    """The page of a bench.

    Args:
        rows: score of every case of the first diagnosis.
        summaries: by label, the diagnosis first, baselines after it.
        table: names of rows and columns of the confusion matrix, and its counts.
        title: of the page.
        commitment: SHA-256 of the list of sealed answers.
    """
    summary = next(iter(summaries.values()))
    page = Page(title, _lead(summary))
    for key in ("clear_exact", "pairs_one", "sound_named", "outsiders_named", "confident_wrong"):
        if summary.get(key):
            rate = summary[key]
            note = f"{rate['count']} of {rate['of']}; 95 %: {100 * rate['low']:.0f} to {100 * rate['high']:.0f} %"
            page.tile(LABELS[key][0], 100 * rate["value"], "%", note)
    figures = {
        "rates": rates_figure(summaries),
        "confusion": confusion_figure(*table),
        "reliability": reliability_figure({label: s["calibration"] for label, s in summaries.items()}),
    }
    entries = ("case", "kind", "robot", "severity", "truth", "truth_joints", "claim", "claim_joints", "probability",
               "size_ratio", "seconds")  # fmt: skip
    header = ["case", "kind", "robot", "severity", "hidden", "in", "most probable name", "in", "probability",
              "size ratio", "time [s]"]  # fmt: skip
    rates: list[list[Cell]] = [
        [label, rate["count"], rate["of"], *(100 * rate[k] for k in ("value", "low", "high")), aim]
        for key, (label, aim) in LABELS.items()
        if (rate := summary.get(key))
    ]
    medians: list[list[Cell]] = [
        [label, s["value"], s["low"], s["high"], s["of"], aim]
        for key, (label, aim) in MEDIANS.items()
        if (s := summary.get(key))
    ]
    calibration = summary["calibration"]
    if calibration["ece"] is not None:
        count = calibration["findings"]
        medians.append(
            ["calibration error of stated probability", calibration["ece"], None, None, count, "at most 0.1"]
        )
    tables = {
        "rates": (["rate", "count", "of", "%", "from %", "to %", "aim"], rates, 3),
        "medians": (["median over cases", "value", "from", "to", "of", "aim"], medians, 3),
        "cases": (header, [[row[key] for key in entries] for row in rows], 3),
    }
    page.fill("naming", figures, tables, commitment=commitment)
    return page


def _lead(summary: Mapping[str, Any]) -> str:
    exact, named = summary.get("clear_exact"), summary.get("sound_named")
    parts = []
    if exact:
        parts.append(f"{exact['count']} of {exact['of']} clear single effects were named in their joints")
    if named:
        parts.append(f"{named['count']} of {named['of']} sound robots got a name")
    sentence = ", and ".join(parts) if parts else f"{summary['cases']} cases were scored"
    failed = f" {summary['failed']} diagnoses failed." if summary["failed"] else ""
    return f"{sentence}.{failed}"
