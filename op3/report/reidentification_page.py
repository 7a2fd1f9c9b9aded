"""The page, numbers and wandb run of a re-identification (paper, Fig. "Materials for analysis")."""

from typing import Any

import numpy as np
import optuna
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.identify.intervals import at_bound
from op3.report.figures import ranges_figure
from op3.report.page import Page
from op3.report.result import RunFolder, finite, publish
from op3.report.style import INK, MUTED, curves_figure
from op3.report.tables import TableRows, place_in_range
from op3.servo import RobotModel, parameter
from op3.transfer.reidentification import TOLERATED
from op3.transfer.reidentified import ParetoPoint, Reidentified

FOUND = "re-identified"
ACTUAL = "actual"


def report_reidentification(
    found: Reidentified, study: optuna.Study, run: RunFolder, *, wall_seconds: float, simulated_seconds: float
) -> dict[str, Any]:
    """Publish the result of a finished study, with its duration and the simulated time [s]."""
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
    models = {  # this order gives the same colours as in the other figures
        label: RobotModel(found.model.effects).with_values(dict(one.values))
        for label, one in ((FOUND, found.chosen), (found.start_name, found.start))
    }
    figures = {
        "returns": _returns_figure(found),
        "front": _front_figure(found, study),
        "parameters": ranges_figure(models, list(found.chosen.values)),
    }
    page = Page.of("reidentification", figures, _tables(found), found=found, n=values, tolerated=TOLERATED)
    return publish(page, values, run)


def _objectives(name: str, one: ParetoPoint, fresh: ParetoPoint) -> dict[str, Any]:
    """Both objectives, returns and parameters of a model."""
    return {
        f"distance.{name}": one.distance,
        f"fresh.{name}": finite(fresh.distance),
        f"excitation.{name}": one.excitation,
        f"returns.{name}": list(one.returns),
        f"returns.fresh_{name}": [finite(value) for value in fresh.returns],
        f"normalised.{name}": _places(one),
    }


def _ratio(after: float, before: float) -> float | None:
    return after / before if before > 0 and np.isfinite([before, after]).all() else None


def _places(one: ParetoPoint) -> dict[str, float]:
    """Position of each parameter in the catalogue's range."""
    return {name: place_in_range(parameter(name), value) for name, value in one.values.items()}


def _tables(found: Reidentified) -> dict[str, TableRows]:
    start, chosen, before = found.start, found.chosen, found.start_name
    entries = (
        (ACTUAL, found.actual, None, None),
        (before, start.returns, start.distance, found.fresh_start.distance),
        (FOUND, chosen.returns, chosen.distance, found.fresh_chosen.distance),
    )
    old, new = _places(start), _places(chosen)
    return {
        "returns": (
            ["episodes", "mean return [-]", "deviation [-]", "distance [-]", "distance, fresh episodes [-]"],
            [[label, float(np.mean(own)), float(np.std(own)), *distances] for label, own, *distances in entries],
        ),
        "parameters": (
            ["parameter", before, FOUND, f"{before}, of its range", f"{FOUND}, of its range", "remark"],
            [
                [words(n), start.values[n], value, old[n], new[n], "at its bound" if at_bound(new[n]) else ""]
                for n, value in chosen.values.items()
            ],
        ),
    }


def _returns_figure(found: Reidentified) -> go.Figure:
    curves = {}
    for label, own in ((FOUND, found.chosen.returns), (found.start_name, found.start.returns), (ACTUAL, found.actual)):
        curves[label] = (np.sort(np.asarray(own, dtype=float)), np.arange(1, len(own) + 1) / len(own))
    axes = "return under R_eval [-]", "share of episodes [-]"
    figure = curves_figure(curves, *axes, 340, "lines+markers", shape="hv", yaxis_range=[0, 1.05])
    return figure.update_traces(line_color=INK, marker_color=INK, selector={"name": ACTUAL})


def _front_figure(found: Reidentified, study: optuna.Study) -> go.Figure:
    played = [t.values for t in study.trials if t.values is not None and "returns" in t.user_attrs]
    front = [one for one in found.front if one.returns]
    points = {FOUND: [found.chosen], found.start_name: [found.start], "Pareto front": front}
    curves = {name: ([one.excitation for one in some], [one.distance for one in some]) for name, some in points.items()}
    curves |= {"trials": tuple(zip(*played, strict=True))} if played else {}
    axes = "excitation loss [-]", "distance of returns [-]"
    figure = curves_figure(curves, *axes, 400, "markers", xaxis_type="log", yaxis_rangemode="tozero")
    figure.update_traces(marker_size=13, marker_symbol="diamond", selector=lambda trace: len(trace.x) == 1)
    figure.update_traces(mode="lines+markers", line_shape="hv", selector={"name": "Pareto front"})
    figure.update_traces(marker=dict(color=MUTED, opacity=0.35, size=5), selector={"name": "trials"})
    return figure.add_vline(x=TOLERATED * found.start.excitation, line=dict(color=MUTED, dash="dot"))
