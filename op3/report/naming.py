"""The page of a hidden-effect bench: how often the right name was found, and what was called what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.report.page import Page
from op3.report.style import INK, MUTED, colours, dress, plain, words

CLEAR: Mapping[str, tuple[str, str]] = {
    "clear_top1_exact": ("right name and joints first", "at least 88 %"),
    "clear_top1_class": ("right, or among the candidates called ambiguous", "at least 95 %"),
    "clear_top3_exact": ("right among the first three", "at least 98 %"),
    "clear_joint": ("right joint where the name is right", "at least 95 %"),
}
"""Rates of single effects that are moderate or strong: what each is called, and the aim."""

MEDIANS: Mapping[str, tuple[str, str]] = {
    "oracle_closure_median": ("gap closed, of what a model that knows the hidden effects closes", "at least 0.95"),
    "gap_closure_median": ("gap closed, of what is above the spread of repeats", ""),
    "explained_median": ("residual explained by the first claim", ""),
    "black_box_median": ("residual explained by a black box, which names nothing", ""),
    "processor_seconds_median": ("processor time of a diagnosis, imports aside [s]", "at most 20"),
    "size_ratio_median": ("size found, of the true one", ""),
    "return_error_before_median": ("policy: return predicted by the base, off the true one by", ""),
    "return_error_after_median": ("policy: the same with what was named", ""),
}
"""Medians over cases: what each is called, and the aim."""

LABELS: Mapping[str, tuple[str, str]] = {
    "false_alarms": ("false alarms on empty cases", "at most 3 %"),
    "false_names": ("names given to empty cases", "at most 3 %"),
    "detection": ("hidden effect noticed", "at least 95 %"),
    "top1_name": ("right name first", ""),
    "top1_exact": ("right name and joints first", "at least 88 %"),
    "top1_class": ("right, or among the candidates called ambiguous", "at least 95 %"),
    "top3_exact": ("right among the first three", "at least 98 %"),
    "joint_localisation": ("right joint where the name is right", "at least 95 %"),
    "extra_names": ("right, with another name that is not hidden", ""),
    "pairs_both": ("both of two effects named", "at least 70 %"),
    "pairs_one": ("one of two effects named", ""),
    "outsiders_unknown": ("outsiders called unknown", "at least 80 %"),
    "poor_class": ("poor excitation: right or among the candidates", ""),
    "confident_wrong": ("confident and wrong", "at most 1 %"),
    "size_coverage": ("size within its 90 % interval", "85 to 95 %"),
}
"""What a rate is called on the page, and the aim."""


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
            colorscale=[[0, "#ffffff"], [0.001, "#e7eef7"], [1, "#2b6cb0"]], showscale=False, xgap=1, ygap=1,
            hovertemplate="hidden: %{y}<br>claimed: %{x}<br>%{z:.0%}<extra></extra>",
        )
    )  # fmt: skip
    dress(figure, 200 + 22 * len(truths), margin=dict(l=220, r=16, t=24, b=170), hovermode="closest")
    figure.update_yaxes(autorange="reversed", title_text="hidden [-]", showgrid=False)
    figure.update_xaxes(title_text="claimed first [-]", tickangle=-55, showgrid=False)
    return figure


def reliability_figure(calibrations: Mapping[str, Mapping[str, Any]]) -> go.Figure | None:
    """Stated confidence against the share that was right; None where nothing was stated."""
    figure, colour = go.Figure(), colours(list(calibrations))
    for label, values in calibrations.items():
        table = values["reliability"]
        if table:
            figure.add_scatter(
                x=[100 * c for c, _, _ in table], y=[100 * r for _, r, _ in table], mode="lines+markers",
                name=plain(label), marker=dict(color=colour[label], size=[6 + 2 * np.sqrt(n) for *_, n in table]),
                customdata=[n for *_, n in table], hovertemplate="%{y:.0f} % of %{customdata} right",
            )  # fmt: skip
    if not figure.data:
        return None
    figure.add_scatter(x=[0, 100], y=[0, 100], mode="lines", name="perfect", line=dict(color=MUTED, dash="dot"))
    dress(figure, 380, hovermode="closest")
    figure.update_xaxes(title_text="stated confidence [%]", range=[0, 102])
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
    for key in ("top1_exact", "top1_class", "false_alarms", "confident_wrong", "outsiders_unknown"):
        if summary.get(key):
            rate = summary[key]
            note = f"{rate['count']} of {rate['of']}; 95 %: {100 * rate['low']:.0f} to {100 * rate['high']:.0f} %"
            page.tile(LABELS[key][0], 100 * rate["value"], "%", note)
    page.section("Rates")
    page.figure(rates_figure(summaries), "Rates with Wilson's 95 % intervals.")
    rows_of = []
    for key, (label, aim) in LABELS.items():
        if summary.get(key):
            rate = summary[key]
            rows_of.append(
                [label, rate["count"], rate["of"], *(100 * rate[k] for k in ("value", "low", "high")), aim or None]
            )
    page.table(["rate", "count", "of", "%", "from %", "to %", "aim"], rows_of, "Rates of the diagnosis", digits=3)
    _medians(page, summary)
    page.section("What was called what")
    page.figure(confusion_figure(*table), "Hidden effects against the first claim, or the verdict that names nothing.")
    page.section("Confidence")
    page.figure(
        reliability_figure({label: s["calibration"] for label, s in summaries.items()}),
        "Stated confidence of first claims and the share that was right.",
    )
    page.section("Cases")
    header = ["case", "kind", "severity", "hidden", "in", "verdict", "first claim", "in", "confidence", "size ratio"]
    entries = ("case", "kind", "severity", "truth", "truth_joints", "verdict", "claim", "claim_joints", "confidence")
    page.table(header, [[row[key] for key in entries] + [row["size_ratio"]] for row in rows], "All cases", digits=3)
    page.text(f"The list of sealed answers has the SHA-256 `{commitment}`; it was written before the first diagnosis.")
    return page


def _medians(page: Page, summary: Mapping[str, Any]) -> None:
    """Clear cases, `dte` by severity, medians and the calibration error, with their intervals."""
    clear = [
        [label, s["count"], s["of"], *(100 * s[k] for k in ("value", "low", "high")), aim]
        for key, (label, aim) in CLEAR.items()
        if (s := summary.get(key))
    ]
    for severity, s in summary.get("dte_named", {}).items():
        if s:
            values = (100 * s[k] for k in ("value", "low", "high"))
            clear.append([f"dte named, {severity}", s["count"], s["of"], *values, "always"])
    if clear:
        columns = ["rate", "count", "of", "%", "from %", "to %", "aim"]
        page.table(columns, clear, "Single effects, moderate and strong, rich excitation; dte by severity", digits=3)
    rows = [
        [label, s["value"], s["low"], s["high"], s["of"], aim or None]
        for key, (label, aim) in MEDIANS.items()
        if (s := summary.get(key))
    ]
    calibration = summary["calibration"]
    if calibration["ece"] is not None:
        low, high = calibration.get("ece_interval") or (None, None)
        rows.append(["calibration error of stated confidence", calibration["ece"], low, high, calibration["claims"],
                     "at most 0.06"])  # fmt: skip
    if rows:
        page.table(["median over cases", "value", "from", "to", "cases", "aim"], rows, "With 95 % bootstrap intervals",
                   digits=3)  # fmt: skip


def _lead(summary: Mapping[str, Any]) -> str:
    exact, alarms = summary.get("top1_exact"), summary.get("false_alarms")
    parts = []
    if exact:
        parts.append(f"{exact['count']} of {exact['of']} hidden effects were named exactly")
    if alarms:
        parts.append(f"{alarms['count']} of {alarms['of']} empty cases raised a false alarm")
    sentence = ", and ".join(parts) if parts else f"{summary['cases']} cases were scored"
    failed = f" {summary['failed']} diagnoses failed." if summary["failed"] else ""
    return f"{sentence}.{failed}"
