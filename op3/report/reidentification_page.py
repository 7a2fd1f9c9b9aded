"""The page, numbers and wandb run of a re-identification (paper, Fig. "Materials for analysis")."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import optuna
import plotly.graph_objects as go

from op3.identify.intervals import at_bound
from op3.identify.reidentification import TOLERATED
from op3.identify.reidentified import Candidate, Reidentified
from op3.report.figures import ranges_figure
from op3.report.page import Page
from op3.report.result import RunFolder, finite, publish
from op3.report.style import INK, MUTED, PALETTE, curves_figure, dress, faded, words
from op3.report.tables import number
from op3.servo import RobotModel, parameter

FOUND = "re-identified"
BEFORE = "excitation only"
ACTUAL = "actual"

MEANINGS: Mapping[str, str] = {
    "distance": "Wasserstein-1 distance to the returns on the robot [-]",
    "excitation": "loss of the excitation, paper eq. (7)",
    "returns": "R_eval of every episode [-]",
    "normalised": "parameter within its range of the catalogue (paper Table I), 0 to 1",
    "fresh": "distance over episodes that neither the search nor the choice has seen, and what chance alone leaves",
    "front": "Pareto front: excitation loss and distance",
    "accepted": "whether a candidate took the place of the start",
    "at_chance": "whether the start's returns are as close to the robot's as chance would leave them",
}


def report_reidentification(
    found: Reidentified,
    study: optuna.Study,
    run: RunFolder,
    *,
    wall_seconds: float,
    simulated_seconds: float,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        found: what the study found.
        study: finished.
        run: where it is kept.
        wall_seconds: duration of the run [s].
        simulated_seconds: simulated time [s].

    Returns:
        The numbers of ``result.yaml``.
    """
    values = {
        **_objectives("excitation_only", found.start, found.fresh_start),
        **_objectives("reidentified", found.chosen, found.fresh_chosen),
        "distance.ratio": _ratio(found.chosen.distance, found.start.distance),
        "fresh.noise": found.noise,
        "fresh.ratio": _ratio(found.fresh_chosen.distance, found.fresh_start.distance),
        "excitation.ratio": _ratio(found.chosen.excitation, found.start.excitation),
        "returns.actual": list(found.actual),
        "parameters": {name: {"value": value} for name, value in found.chosen.values.items()},
        "front.excitation": [one.excitation for one in found.front],
        "front.distance": [one.distance for one in found.front],
        "accepted": found.accepted,
        "at_chance": found.at_chance,
        "trials": len(study.trials),
        "trials_failed": sum(t.state == optuna.trial.TrialState.FAIL for t in study.trials),
        "trials_skipped": sum("skipped" in t.user_attrs for t in study.trials),
        "trials_played": sum("returns" in t.user_attrs for t in study.trials),
        "wall_seconds": wall_seconds,
        "simulated_seconds": simulated_seconds,
    }
    return publish(_page(found, study, values), values, run, MEANINGS)


def _objectives(name: str, one: Candidate, fresh: Candidate) -> dict[str, Any]:
    """Both objectives, returns and parameters of a model."""
    return {
        f"distance.{name}": one.distance,
        f"fresh.{name}": finite(fresh.distance),
        f"excitation.{name}": one.excitation,
        f"returns.{name}": list(one.returns),
        f"returns.fresh_{name}": [finite(value) for value in fresh.returns],
        f"normalised.{name}": {key: _normalised(key, value) for key, value in one.values.items()},
    }


def _ratio(after: float, before: float) -> float | None:
    return after / before if before > 0 and np.isfinite([before, after]).all() else None


def _normalised(name: str, value: float) -> float:
    known = parameter(name)
    return (value - known.low) / (known.high - known.low)


def _page(found: Reidentified, study: optuna.Study, values: Mapping[str, Any]) -> Page:
    start, chosen, before = found.start, found.chosen, found.start_name
    page = Page("Re-identification from a failed transfer", _lead(found))
    page.tile("distance of returns", chosen.distance, note=f"{number(start.distance, 3)} before")
    page.tile("excitation loss", chosen.excitation, note=f"{number(start.excitation, 3)} before")
    page.tile("mean return on the robot", float(np.mean(found.actual)))
    page.tile("fresh episodes", found.fresh_chosen.distance, note=f"{number(found.fresh_start.distance, 3)} before")
    page.tile("trials", values["trials"], note=f"{values['trials_played']} played all episodes")
    page.tile("time", values["wall_seconds"], "s")
    entries = (
        (ACTUAL, found.actual, None, None),
        (before, start.returns, start.distance, found.fresh_start.distance),
        (FOUND, chosen.returns, chosen.distance, found.fresh_chosen.distance),
    )
    rows = [[label, float(np.mean(own)), float(np.std(own)), *distances] for label, own, *distances in entries]
    header = ["episodes", "mean return [-]", "deviation [-]", "distance [-]", "distance, fresh episodes [-]"]
    models = {  # in this order they have the colours of the other figures
        label: RobotModel(found.model.effects).with_values(dict(one.values))
        for label, one in ((FOUND, chosen), (before, start))
    }
    places = {name: [_normalised(name, one.values[name]) for one in (start, chosen)] for name in chosen.values}
    parameters = [
        [words(name), start.values[name], value, *places[name], "at its bound" if at_bound(places[name][1]) else ""]
        for name, value in chosen.values.items()
    ]
    columns = ["parameter", before, FOUND, f"{before}, of its range", f"{FOUND}, of its range", "remark"]
    page.fill(
        "reidentification",
        {
            "returns": _returns_figure(found),
            "front": _front_figure(found, study),
            "parameters": ranges_figure(models, list(chosen.values)),
        },
        {"returns": (header, rows), "parameters": (columns, parameters)},
        found=found, before=before, tolerated=TOLERATED,
    )  # fmt: skip
    return page


def _lead(found: Reidentified) -> str:
    """The outcome in one sentence; a gain that fresh episodes do not confirm is not called one."""
    start, chosen = found.start, found.chosen
    if found.at_chance:
        return (
            f"Nothing to learn from these episodes: the start's returns are {number(start.distance, 3)} from the"
            " robot's, as close as chance would leave them, so the model stays as it is."
        )
    if not found.accepted:
        return (
            f"No candidate came closer to the robot's returns than the start, {number(start.distance, 3)} away,"
            f" without an excitation loss above {TOLERATED:g} times its own."
        )
    change = f"from {number(start.distance, 3)} to {number(chosen.distance, 3)}"
    fresh = f"from {number(found.fresh_start.distance, 3)} to {number(found.fresh_chosen.distance, 3)}"
    chance = f"where chance alone leaves {number(found.noise, 3)}"
    cost = f"The excitation loss is {chosen.excitation / start.excitation:.2f} times that before."
    if chosen.distance >= start.distance:
        return (
            f"The chosen model was closer to the robot's returns over the episodes that decided between the finalists,"
            f" and not over those searched with: the distance goes {change} over these, and {fresh} over fresh ones,"
            f" {chance}. {cost}"
        )
    if found.fresh_chosen.distance >= found.fresh_start.distance:
        return (
            f"No gain that lasts: the distance between simulated and actual returns goes {change} over the episodes"
            f" searched with, and {fresh} over fresh ones, {chance}. {cost}"
        )
    return (
        f"Re-identification lowers the distance between simulated and actual returns {change}, and {fresh} over fresh"
        f" episodes. {cost}"
    )


def _returns_figure(found: Reidentified) -> go.Figure:
    curves = {}
    for label, own in ((FOUND, found.chosen.returns), (found.start_name, found.start.returns), (ACTUAL, found.actual)):
        curves[label] = (np.sort(np.asarray(own, dtype=float)), np.arange(1, len(own) + 1) / len(own))
    figure = curves_figure(
        curves, "return under R_eval [-]", "share of episodes [-]", 340, "lines+markers", "hv", yaxis_range=[0, 1.05]
    )
    return figure.update_traces(line_color=INK, marker_color=INK, selector={"name": ACTUAL})


def _front_figure(found: Reidentified, study: optuna.Study) -> go.Figure:
    played = [t.values for t in study.trials if t.values is not None and "returns" in t.user_attrs]
    figure = go.Figure()
    if played:
        x, y = np.array(played).T
        figure.add_scatter(x=x, y=y, mode="markers", name="trials", marker=dict(color=faded(MUTED, 0.35), size=5))
    marks: list[tuple[str, Sequence[Candidate], dict[str, Any]]] = [
        ("Pareto front", [one for one in found.front if one.returns], dict(mode="lines+markers", line_shape="hv")),
        (found.start_name, [found.start], dict(mode="markers", marker_size=13, marker_symbol="diamond")),
        (FOUND, [found.chosen], dict(mode="markers", marker_size=13, marker_symbol="diamond")),
    ]
    for (label, some, look), colour in zip(marks, (PALETTE[2], PALETTE[1], PALETTE[0]), strict=True):
        x, y = [one.excitation for one in some], [one.distance for one in some]
        figure.add_scatter(x=x, y=y, name=label, marker_color=colour, **look)
    figure.add_vline(x=TOLERATED * found.start.excitation, line=dict(color=MUTED, dash="dot"))
    dress(figure, 400, hovermode="closest")
    figure.update_xaxes(title_text="excitation loss [-]", type="log")
    figure.update_yaxes(title_text="distance of returns [-]", rangemode="tozero")
    return figure
