"""The page, numbers and figures of a training run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import PALETTE, curves_figure, dress, faded

History = Sequence[Mapping[str, float]]
"""Entries with ``steps`` and measures by name, as `op3.train.Progress` keeps them."""

_PANELS = (
    ("return per episode [-]", {"evaluation/return": "without exploration", "episode/return": "while training"}),
    ("episodes that ended upright [-]", {"evaluation/upright": "without exploration"}),
    ("critics [-]", {"update/value": "mean value", "update/critic_loss": "loss"}),
    ("policy [-]", {"update/temperature": "temperature", "action/angle_spread": "spread of the angles"}),
)


def series(history: History, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values [entry] of a measure, where the history has it."""
    pairs = [(entry["steps"], entry[name]) for entry in history if name in entry]
    steps, values = np.array(pairs, dtype=float).reshape(-1, 2).T
    return steps, values


def learning_figure(history: History) -> go.Figure:
    """Return, upright share, critics and policy over environment steps, a panel each."""
    figure = make_subplots(rows=2, cols=2, horizontal_spacing=0.11, vertical_spacing=0.14)
    for number, (axis, lines) in enumerate(_PANELS):
        row, column = number // 2 + 1, number % 2 + 1
        for index, (name, label) in enumerate(lines.items()):
            steps, values = series(history, name)
            colour = PALETTE[2 * (number // 2) + index]
            figure.add_scatter(
                x=steps, y=values, mode="lines+markers" if "evaluation" in name else "lines", name=label,
                line=dict(color=colour, width=2), marker=dict(size=5), hovertemplate="%{y:.4g}",
                showlegend=number != 1, row=row, col=column,
            )  # fmt: skip
        figure.update_yaxes(title_text=axis, row=row, col=column)
    figure.update_xaxes(title_text="environment steps [-]", row=2)
    dress(figure, 560, hovermode="x unified")
    figure.update_yaxes(range=[-0.02, 1.05], row=1, col=2)
    figure.update_yaxes(type="log", row=2, col=2)
    return figure


def reward_figure(history: History) -> go.Figure | None:
    """Mean of each term of the reward while training; None where the environment names none."""
    names = sorted({name for entry in history for name in entry if name.startswith("reward_terms/")})
    if not names:
        return None
    curves = {name.removeprefix("reward_terms/"): series(history, name) for name in ["reward", *names]}
    return curves_figure(curves, "environment steps [-]", "mean per step [-]", 320, hovermode="x unified")


def histogram_figure(values: Mapping[str, np.ndarray], axis: str) -> go.Figure:
    """Distributions of commands over an evaluation, drawn as steps of equal width.

    Args:
        values: samples by label, any shape.
        axis: title of the x axis, with its unit.
    """
    figure = go.Figure()
    everything = np.concatenate([np.ravel(v) for v in values.values()])
    edges = np.linspace(everything.min() - 1e-9, everything.max() + 1e-9, 41)
    for index, (label, samples) in enumerate(values.items()):
        share, _ = np.histogram(samples, edges)
        colour = PALETTE[index % len(PALETTE)]
        figure.add_scatter(
            x=(edges[1:] + edges[:-1]) / 2, y=share / max(share.sum(), 1), name=label, mode="lines",
            line=dict(color=colour, shape="hvh"), fill="tozeroy", fillcolor=faded(colour, 0.12),
        )  # fmt: skip
    figure.update_xaxes(title_text=axis)
    figure.update_yaxes(title_text="share [-]", rangemode="tozero")
    return dress(figure, 300)


def report_training(
    history: History,
    run: RunFolder,
    *,
    title: str,
    numbers: Mapping[str, Any],
    settings: Mapping[str, Any],
    histograms: Mapping[str, go.Figure] | None = None,
    files: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml`` and print the paths of both.

    Args:
        history: of the run.
        run: where it is kept.
        title: what was trained on what.
        numbers: of the final evaluation and the budget, for ``result.yaml``.
        settings: of the run, shown as a table.
        histograms: figures of the commands by caption.
        files: that lie beside the page, with what is in them.

    Returns:
        The numbers of ``result.yaml``.
    """
    upright, returned = numbers["evaluation.upright"], numbers["evaluation.return"]
    lead = (
        f"The kept policy ends {100 * upright:.0f} % of its final episodes upright, with a mean return of "
        f"{returned:.1f}. It is the best of the evaluations while training, after {numbers['policy.steps']:,} steps; "
        "the final episodes are others than those."
    )
    page = Page(title, lead)
    page.tile("upright", 100 * upright, "%", f"of {numbers['evaluation.episodes']} episodes")
    page.tile("return", returned, "", "mean per episode")
    page.tile("steps", f"{numbers['steps']:,}", "", f"{numbers['updates']:,} updates")
    page.tile("wall time", numbers["wall_seconds"] / 60, "min")
    page.section("Learning")
    page.figure(learning_figure(history), "Return and share of upright episodes, the critics, and the exploration.")
    page.figure(reward_figure(history), "The reward and its weighted terms, means over the steps between two entries.")
    if histograms:
        page.section("Commands")
        for caption, figure in histograms.items():
            page.figure(figure, caption)
    page.section("Settings")
    page.table(["setting", "value"], [[name, str(value)] for name, value in settings.items()])
    page.side_files(files)
    meanings = {
        "evaluation": "means over the final evaluation's episodes, without exploration",
        "policy": "the kept policy",
        "steps": "environment steps of the run",
        "learning": "returns of the evaluations while training, by environment steps",
    }
    steps, judged = series(history, "evaluation/return")
    numbers = {**numbers, "learning.steps": steps.tolist(), "learning.return": judged.tolist()}
    return publish(page, numbers, run, meanings)
