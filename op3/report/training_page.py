"""The page, numbers and figures of a training run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import curves_figure, grid_figure

History = Sequence[Mapping[str, float]]
"""Entries with ``steps`` and measures by name, as in `op3.train.Progress`."""

STEPS = "environment steps [-]"

_PANELS = {
    "return per episode [-]": {"without exploration": "evaluation/return", "while training": "episode/return"},
    "episodes that ended upright [-]": {"without exploration": "evaluation/upright"},
    "critics [-]": {"mean value": "update/value", "loss": "update/critic_loss"},
    "policy [-]": {"temperature": "update/temperature", "spread of the actions": "action/spread"},
}


def series(history: History, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values [entry] of a measure, for all entries that contain it."""
    pairs = [(entry["steps"], entry[name]) for entry in history if name in entry]
    steps, values = np.array(pairs, dtype=float).reshape(-1, 2).T
    return steps, values


def learning_figure(history: History) -> go.Figure:
    """Return, upright share, critics and policy over environment steps, in one panel each."""
    panels = {axis: {label: series(history, name) for label, name in lines.items()} for axis, lines in _PANELS.items()}
    figure = grid_figure(panels, STEPS, 560, columns=2, hovermode="x unified")
    figure.update_traces(mode="lines+markers", marker_size=5, selector={"name": "without exploration"})
    return figure.update_yaxes(range=[-0.02, 1.05], row=1, col=2).update_yaxes(type="log", row=2, col=2)


def reward_figure(history: History) -> go.Figure | None:
    """Mean of each reward term during training; None if the environment has no named terms."""
    names = sorted({name for entry in history for name in entry if name.startswith("reward_terms/")})
    curves = {name.removeprefix("reward_terms/"): series(history, name) for name in ["reward", *names]}
    return curves_figure(curves, STEPS, "mean per step [-]", 320, hovermode="x unified") if names else None


def report_training(
    history: History,
    run: RunFolder,
    *,
    title: str,
    numbers: Mapping[str, Any],
    settings: Mapping[str, Any],
    files: Mapping[str, str],
) -> dict[str, Any]:
    """Publish a training run; `numbers` of the final evaluation and the budget are added to ``result.yaml``."""
    figures = {"learning": learning_figure(history), "reward": reward_figure(history)}
    tables = {"settings": (["setting", "value"], [[name, str(value)] for name, value in settings.items()])}
    page = Page.of("training", figures, tables, title=title, n=numbers, files=files)
    steps, judged = series(history, "evaluation/return")
    numbers = {**numbers, "learning.steps": steps.tolist(), "learning.return": judged.tolist()}
    return publish(page, numbers, run)
