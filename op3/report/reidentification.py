"""The page, numbers and wandb run of a re-identification (paper, Fig. "Materials for analysis")."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import plotly.graph_objects as go

from op3.identify.reidentification import TOLERATED, Reidentified
from op3.report.figures import ranges_figure
from op3.report.page import Page
from op3.report.result import finish, write_result
from op3.report.run_logger import RunLogger
from op3.report.style import INK, MUTED, PALETTE, dress, faded, words
from op3.report.tables import Cell, number
from op3.servo import RobotModel, parameter

FOUND = "re-identified"
BEFORE = "excitation only"
ACTUAL = "actual"


def report_reidentification(
    found: Reidentified,
    study: optuna.Study,
    folder: Path,
    *,
    wall_seconds: float,
    simulated_seconds: float,
    provenance: Mapping[str, Any],
    config: Mapping[str, Any] | None = None,
    wandb_mode: str | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        found: what the study found.
        study: finished.
        folder: of the run.
        wall_seconds: duration of the run [s].
        simulated_seconds: simulated time [s].
        provenance: where the numbers come from, see `op3.report.run_provenance`.
        config: settings, for wandb.
        wandb_mode: ``offline``, ``online`` or ``disabled``.

    Returns:
        The numbers of ``result.yaml``.
    """
    values = _numbers(found, study, wall_seconds, simulated_seconds, provenance)
    page_path = _page(found, study, values, provenance).write(folder / "index.html")
    meanings = {
        "distance": "Wasserstein-1 distance to the returns on the robot [-]",
        "excitation": "loss of the excitation, paper eq. (7)",
        "returns": "R_eval of every episode [-]",
        "normalised": "parameter within its range of the catalogue (paper Table I), 0 to 1",
        "fresh": "distance over episodes that neither the search nor the choice has seen, and what chance alone leaves",
        "front": "Pareto front: excitation loss and distance",
        "accepted": "whether a candidate took the place of the start",
        "at_chance": "whether the start's returns are as close to the robot's as chance would leave them",
    }
    result_path = write_result(folder / "result.yaml", values, meanings)
    with RunLogger(folder, config=config, mode=wandb_mode) as logger:
        logger.summary({k: v for k, v in values.items() if isinstance(v, int | float)})
    finish(page_path, result_path)
    return values


def _numbers(
    found: Reidentified,
    study: optuna.Study,
    wall_seconds: float,
    simulated_seconds: float,
    provenance: Mapping[str, Any],
) -> dict[str, Any]:
    start, chosen = found.start, found.chosen
    return {
        "distance.excitation_only": start.distance,
        "distance.reidentified": chosen.distance,
        "distance.ratio": _ratio(chosen.distance, start.distance),
        "fresh.excitation_only": _finite(found.fresh_start.distance),
        "fresh.reidentified": _finite(found.fresh_chosen.distance),
        "fresh.noise": found.noise,
        "fresh.ratio": _ratio(found.fresh_chosen.distance, found.fresh_start.distance),
        "excitation.excitation_only": start.excitation,
        "excitation.reidentified": chosen.excitation,
        "returns.actual": list(found.actual),
        "returns.excitation_only": list(start.returns),
        "returns.reidentified": list(chosen.returns),
        "excitation.ratio": _ratio(chosen.excitation, start.excitation),
        "returns.fresh_excitation_only": [_finite(value) for value in found.fresh_start.returns],
        "returns.fresh_reidentified": [_finite(value) for value in found.fresh_chosen.returns],
        "parameters": {name: {"value": value} for name, value in chosen.values.items()},
        "normalised.excitation_only": {name: _normalised(name, value) for name, value in start.values.items()},
        "normalised.reidentified": {name: _normalised(name, value) for name, value in chosen.values.items()},
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
        "provenance": dict(provenance),
    }


def _finite(value: float) -> float | None:
    """None in place of what a simulation that failed leaves."""
    return value if np.isfinite(value) else None


def _ratio(after: float, before: float) -> float | None:
    return after / before if before > 0 and np.isfinite([before, after]).all() else None


def _normalised(name: str, value: float) -> float:
    known = parameter(name)
    return (value - known.low) / (known.high - known.low)


def _page(found: Reidentified, study: optuna.Study, values: Mapping[str, Any], provenance: Mapping[str, Any]) -> Page:
    start, chosen = found.start, found.chosen
    page = Page("Re-identification from a failed transfer", _lead(found))
    page.tile("distance of returns", chosen.distance, note=f"{number(start.distance, 3)} before")
    page.tile("excitation loss", chosen.excitation, note=f"{number(start.excitation, 3)} before")
    page.tile("mean return on the robot", float(np.mean(found.actual)))
    page.tile("fresh episodes", found.fresh_chosen.distance, note=f"{number(found.fresh_start.distance, 3)} before")
    page.tile("trials", values["trials"], note=f"{values['trials_played']} played all episodes")
    page.tile("time", values["wall_seconds"], "s")
    page.section("Returns")
    page.text(
        f"What the policy's episodes are worth under R_eval: on the robot, in simulation before ({found.start_name}),"
        " and in the simulation after re-identification, with the same episodes for every candidate."
        f" Over fresh episodes, which neither the search nor the choice has seen, the distance is"
        f" {number(found.fresh_start.distance, 3)} before and {number(found.fresh_chosen.distance, 3)} after; if the"
        f" model were the robot, chance alone would leave {number(found.noise, 3)}."
    )
    page.figure(_returns_figure(found), "Returns of the episodes, as steps of their cumulative distribution.")
    rows: list[list[Cell]] = [
        [ACTUAL, *_summary(found.actual), None, None],
        [found.start_name, *_summary(start.returns), start.distance, found.fresh_start.distance],
        [FOUND, *_summary(chosen.returns), chosen.distance, found.fresh_chosen.distance],
    ]
    header = ["episodes", "mean return [-]", "deviation [-]", "distance [-]", "distance, fresh episodes [-]"]
    page.table(header, rows, "Returns and their Wasserstein-1 distance to the robot's.")
    page.section("Pareto front")
    page.text(
        f"Rule: among the candidates whose excitation loss is at most {TOLERATED:g} times that of the start (dotted"
        " line), the closest few play as many episodes again, and the smallest distance over these is chosen, the"
        " start's included. Where the start's returns are as close to the robot's as chance would leave them, it stays."
    )
    page.figure(_front_figure(found, study), "Both objectives of every trial that played episodes, and the front.")
    page.section("Parameters")
    models = {  # in this order they have the colours of the other figures
        FOUND: RobotModel(found.model.effects).with_values(dict(chosen.values)),
        found.start_name: RobotModel(found.model.effects).with_values(dict(start.values)),
    }
    page.figure(ranges_figure(models, list(chosen.values)), "Parameters within the ranges of Table I.")
    before = found.start_name
    header = ["parameter", before, FOUND, f"{before}, of its range", f"{FOUND}, of its range"]
    rows = [
        [words(name), start.values[name], value, _normalised(name, start.values[name]), _normalised(name, value)]
        for name, value in chosen.values.items()
    ]
    page.table(header, rows, "Parameters, and normalised by Table I.")
    page.provenance(provenance)
    return page


def _summary(returns: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(returns)), float(np.std(returns))


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
    cost = f"The excitation loss is {chosen.excitation / start.excitation:.2f} times that before."
    if chosen.distance >= start.distance:
        return (
            f"The chosen model was closer to the robot's returns over the episodes that decided between the finalists,"
            f" and not over those searched with: the distance goes {change} over these, and {fresh} over fresh ones,"
            f" where chance alone leaves {number(found.noise, 3)}. {cost}"
        )
    if found.fresh_chosen.distance >= found.fresh_start.distance:
        return (
            f"No gain that lasts: the distance between simulated and actual returns goes {change} over the episodes"
            f" searched with, and {fresh} over fresh ones, where chance alone leaves {number(found.noise, 3)}. {cost}"
        )
    return (
        f"Re-identification lowers the distance between simulated and actual returns {change}, and {fresh} over fresh"
        f" episodes. {cost}"
    )


def _returns_figure(found: Reidentified) -> go.Figure:
    figure = go.Figure()
    lines = {
        ACTUAL: (found.actual, INK),
        found.start_name: (found.start.returns, PALETTE[1]),
        FOUND: (found.chosen.returns, PALETTE[0]),
    }
    for label, (returns, colour) in lines.items():
        ordered = np.sort(np.asarray(returns, dtype=float))
        share = np.arange(1, len(ordered) + 1) / len(ordered)
        figure.add_scatter(
            x=ordered, y=share, mode="lines+markers", name=label, line=dict(color=colour, shape="hv", width=2.4)
        )
    dress(figure, 340, hovermode="closest")
    figure.update_xaxes(title_text="return under R_eval [-]", rangemode="tozero")
    figure.update_yaxes(title_text="share of episodes [-]", range=[0, 1.05])
    return figure


def _front_figure(found: Reidentified, study: optuna.Study) -> go.Figure:
    played = [t.values for t in study.trials if t.values is not None and "returns" in t.user_attrs]
    figure = go.Figure()
    if played:
        x, y = np.array(played).T
        figure.add_scatter(x=x, y=y, mode="markers", name="trials", marker=dict(color=faded(MUTED, 0.35), size=5))
    front = [one for one in found.front if one.returns]
    figure.add_scatter(
        x=[one.excitation for one in front],
        y=[one.distance for one in front],
        mode="lines+markers",
        name="Pareto front",
        line=dict(color=PALETTE[2], shape="hv"),
    )
    for label, one, colour in ((found.start_name, found.start, PALETTE[1]), (FOUND, found.chosen, PALETTE[0])):
        figure.add_scatter(
            x=[one.excitation],
            y=[one.distance],
            mode="markers",
            name=label,
            marker=dict(color=colour, size=13, symbol="diamond"),
        )
    figure.add_vline(x=TOLERATED * found.start.excitation, line=dict(color=MUTED, dash="dot"))
    dress(figure, 400, hovermode="closest")
    figure.update_xaxes(title_text="excitation loss [-]", type="log")
    figure.update_yaxes(title_text="distance of returns [-]", rangemode="tozero")
    return figure
