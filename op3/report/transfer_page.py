"""The page of a transfer from simulation to a robot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.replay import Prediction
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import Curves, bars_figure, boxes_figure, curves_figure
from op3.report.tables import TableRows
from op3.report.trace_figures import traces_figure
from op3.transfer.attempt import PAPERS_EPISODES, WALKERS, Learned, Transfer


def report_transfers(
    transfers: Sequence[Transfer],
    learned: Learned,
    run: RunFolder,
    *,
    asked: Mapping[str, str],
    seconds: Mapping[str, float],
    processor_seconds: Mapping[str, float],
    what: str = "",
    fit: Mapping[str, Prediction] | None = None,
    learning: Curves | None = None,
    following: Sequence[str] = (),
) -> dict[str, Any]:
    """Publish the page of a transfer.

    Args:
        transfers: attempts in order.
        run: folder of the run, to which links and videos are relative.
        asked: task, world, condition and budget.
        seconds: duration of every stage [s].
        processor_seconds: processor time of every stage, summed over all processors [s].
        what: one or two sentences about task and robot.
        fit: predictions of the fitted log by the identified models, by label.
        learning: steps and mean returns of every training's evaluations, by label.
        following: next commands.
    """
    values: dict[str, Any] = {
        "success": transfers[-1].success,
        "rounds": len(transfers) - 1,
        **asked,
        "wall_seconds": sum(seconds.values()),
        **{f"transfer_{number}": one.numbers for number, one in enumerate(transfers)},
        **{f"round_{number}.diagnosis": sentence for number, sentence in learned.named.items()},
        **{f"round_{number}.reidentified": one["accepted"] for number, one in learned.numbers.items()},
        **({"remarks": learned.remarks} if learned.remarks else {}),
        "stage_seconds": seconds,
        "processor_seconds": processor_seconds,
    }
    boxes = {
        label: {f"round {i}": getattr(one, name) for i, one in enumerate(transfers)}
        for label, name in (("in simulation", "expected"), ("on the robot", "actual"))
    }
    figures = {"returns": boxes_figure(boxes, "return under R_eval [-]")}
    tables: dict[str, TableRows] = {
        "transfers": _table(transfers),
        "stages": (
            ["stage", "time [s]", "processor time [s]"],
            [[name, value, processor_seconds.get(name)] for name, value in seconds.items()],
        ),
    }
    if fit:
        figures["fit"], tables["fit"] = _fit(fit)
    if learning:
        figures["learning"] = curves_figure(learning, "environment steps [-]", "mean return [-]", 320, "lines+markers")
    for i, each in learned.numbers.items():
        figures[f"lesson_{i}"], tables[f"lesson_{i}"] = _lesson(each)
    page = Page.of(
        "transfer", figures, tables, transfers=transfers, first=transfers[0], last=transfers[-1], learned=learned,
        films=_films(run.path, transfers), seconds=seconds, what=what, following=following, walkers=WALKERS,
        papers_episodes=PAPERS_EPISODES, condition=asked["condition"], budget=asked["budget"],
        pages=[name for name in seconds if (run.path / name / "index.html").exists()],
    )  # fmt: skip
    return publish(page, values, run)


def _fit(fit: Mapping[str, Prediction]) -> tuple[go.Figure, TableRows]:
    """The two joints that moved most in the fitted log, measured and predicted."""
    log, rows = next(iter(fit.values())).log, []
    for label, one in fit.items():
        simulated = one.channels["joint", "position"][0].numpy()
        rows.append([label, 1e3 * float(np.abs(simulated - log.array("joint/position")[: len(simulated)]).mean())])
    moved = np.sort(np.argsort(np.ptp(log.array("joint/position"), axis=0))[-2:])
    figure = traces_figure(log, fit, [log.joints[number] for number in moved])
    return figure, (["model", "mean error of the joints' angles [mrad]"], rows)


def _table(transfers: Sequence[Transfer]) -> TableRows:
    columns = {
        "round": [*range(len(transfers))],
        "training began with": [one.began_with for one in transfers],
        "expected return [-]": [float(np.mean(one.expected)) for one in transfers],
        "return on the robot [-]": [float(np.mean(one.actual)) for one in transfers],
        "share [%]": [100 * one.share for one in transfers],
        "interval": [one.span for one in transfers],
        "upright": [f"{sum(one.upright)} of {len(one.upright)}" for one in transfers],
        "success": [one.success for one in transfers],
    }
    return list(columns), list(zip(*columns.values(), strict=True))


def _films(folder: Path, transfers: Sequence[Transfer]) -> list[tuple[str, str]]:
    """Videos of the first and the last transfer, in simulation and on the robot: path and caption."""
    films = []
    for i in sorted({0, len(transfers) - 1}):
        one = transfers[i]
        worst = f"the worst episode, return {np.min(one.actual):.0f}; {one.falls} of {len(one.upright)} fall"
        for film, text in (
            (one.film, f"Round {i}, in simulation: mean return {np.mean(one.expected):.0f}."),
            (one.robot_film, f"Round {i}, on the robot: {worst}; {100 * one.share:.0f} % of the expected return."),
        ):
            if film is not None and film.exists():
                films.append((str(film.relative_to(folder)), text))
    return films


def _lesson(learned: Mapping[str, Any]) -> tuple[go.Figure, TableRows]:
    """Results of a round's re-identification."""
    labels = {"re-identified": "reidentified", "before": "excitation_only"}
    keys = (("distance", "distance of returns [-]"), ("fresh", "the same, fresh episodes [-]"), ("excitation", "loss"))
    rows = [[text, learned[f"{key}.excitation_only"], learned[f"{key}.reidentified"]] for key, text in keys]
    names = [key.split(".", 2)[2] for key in learned if key.startswith("normalised.reidentified.")]
    bars = {label: {n: learned[f"normalised.{key}.{n}"] for n in names} for label, key in labels.items()}
    return bars_figure(bars, "share of the range [-]"), (["", "before", "re-identified"], rows)
