"""The page and numbers of how well a model predicts logs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from op3.identify.prediction import PredictionScore
from op3.report.figures import errors_figure
from op3.report.page import Page
from op3.report.result import finish, write_result
from op3.report.run_logger import RunLogger
from op3.report.style import words
from op3.report.tables import Cell, number
from op3.report.traces import body_figure, run_name, runs_figure, traces_figure
from op3.rollout import CHANNELS
from op3.rollout.schema import normal_key
from op3.servo import Estimate

MEANINGS: Mapping[str, str] = {
    "error_mrad": "mean absolute joint position error, averaged over logs [mrad], with its 90 % interval",
    "loss": "paper eq. (7) with unit weights, averaged over logs, with its 90 % interval",
    "rms": "root mean square error by channel, in SI units, with its 90 % interval",
    "rms_by_joint": "the same by channel and joint or axis",
    "by_trajectory": "mean absolute joint position error by motion [mrad], with its 90 % interval",
    "logs": "every log; seen: the model was fitted to it",
}

SHOWN_RUNS = 6
"""Runs drawn on the page, the worst, the best and between."""


def report_prediction(
    score: PredictionScore,
    folder: Path,
    *,
    model: str,
    provenance: Mapping[str, Any],
    wall_seconds: float,
    joints: Sequence[str] = (),
    wandb_mode: str | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        score: what was measured.
        folder: of the run.
        model: what the model is called.
        provenance: where the numbers come from, see `op3.report.run_provenance`.
        wall_seconds: duration of the run [s].
        joints: joints to draw; all of a log where empty.
        wandb_mode: ``offline``, ``online`` or ``disabled``.

    Returns:
        The numbers of ``result.yaml``.
    """
    values = _numbers(score, wall_seconds, provenance)
    page_path = _page(score, model, joints, provenance).write(folder / "index.html")
    result_path = write_result(folder / "result.yaml", values, MEANINGS)
    with RunLogger(folder, mode=wandb_mode) as logger:
        estimates = {"error_mrad": score.error_mrad, "loss.paper_eq7": score.paper_eq7}
        logger.summary({name: estimate.value for name, estimate in estimates.items() if estimate is not None})
    finish(page_path, result_path)
    return values


def _numbers(score: PredictionScore, wall_seconds: float, provenance: Mapping[str, Any]) -> dict[str, Any]:
    logs = [
        {
            "recording": entry.log.metadata.recording,
            "motion": entry.log.metadata.motion,
            "mount": entry.log.metadata.mount,
            "error_mrad": entry.error_mrad,
            "paper_eq7": entry.paper_eq7,
            "seen": entry.seen,
        }
        for entry in score.logs
    ]
    return {
        "error_mrad": score.error_mrad,
        "loss.paper_eq7": score.paper_eq7,
        "wall_seconds": wall_seconds,
        "simulated_seconds": score.simulated_seconds,
        "intervals_from": score.clusters,
        "diverged_logs": [run_name(entry.log) for entry in score.logs if entry.error_mrad is None],
        "seen_logs": sum(entry.seen for entry in score.logs),
        "rms": dict(score.channels),
        "rms_by_joint": {key: dict(by) for key, by in score.joints.items()},
        "by_trajectory": {motion.replace(".", "_"): estimate for motion, estimate in score.trajectories.items()},
        "logs": logs,
        "provenance": provenance,
    }


def _span(estimate: Estimate | None, digits: int = 3) -> str:
    if estimate is None:
        return "nothing: every simulation diverged"
    text = number(estimate.value, digits)
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} ({number(estimate.low, digits)} to {number(estimate.high, digits)})"


def _lead(score: PredictionScore) -> str:
    count = len(score.logs)
    logs = "one log" if count == 1 else f"{count} logs"
    lead = f"On {logs} the mean position error is {_span(score.error_mrad)} mrad."
    seen = sum(entry.seen for entry in score.logs)
    if seen:
        lead += f" {'It' if count == 1 else f'{seen} of them'} was fitted by this model: that is no prediction."
    if score.clusters == "stretches":
        lead += " So few logs give intervals from stretches of each; they say nothing about other motions."
    return lead


def _page(score: PredictionScore, model: str, joints: Sequence[str], provenance: Mapping[str, Any]) -> Page:
    page = Page(f"Prediction by {model}", _lead(score))
    for name, estimate, unit in (("position error", score.error_mrad, "mrad"), ("paper eq. (7)", score.paper_eq7, "")):
        if estimate is not None:
            note = (
                "" if estimate.low is None else f"90 %: {number(estimate.low, 3)} to {number(estimate.high or 0.0, 3)}"
            )
            page.tile(name, estimate.value, unit, note)
    page.tile("logs", len(score.logs))
    _traces(page, score, model, joints)
    page.section("Errors by channel")
    page.table(*_channel_table(score), caption=f"Root mean square errors with 90 % intervals, from {score.clusters}.")
    page.section("Errors by joint")
    page.table(*_joint_table(score), caption="Root mean square errors with 90 % intervals.", digits=3)
    page.section("Errors by trajectory")
    rows = [[words(motion), e.value, e.low, e.high] for motion, e in score.trajectories.items()]
    page.table(["trajectory", "error [mrad]", "90 % from", "to"], rows, caption="Mean absolute position error.")
    rows = [[run_name(s.log), s.log.metadata.mount, s.error_mrad, s.paper_eq7, s.seen] for s in score.logs]
    page.table(["log", "mount", "error [mrad]", "paper eq. (7)", "fitted"], rows, caption="Every log.")
    page.section("Files")
    page.files({"result.yaml": "all numbers of this page"})
    page.provenance(provenance)
    return page


def _unit(channel: str) -> str:
    return CHANNELS[normal_key(channel)].unit


def _channel_table(score: PredictionScore) -> tuple[list[str], list[list[Cell]]]:
    rows: list[list[Cell]] = [[key, _unit(key), e.value, e.low, e.high] for key, e in score.channels.items()]
    return ["channel", "unit", "rms", "90 % from", "to"], rows


def _joint_table(score: PredictionScore) -> tuple[list[str], list[list[Cell]]]:
    rows: list[list[Cell]] = [
        [key, words(name), _unit(key), e.value, e.low, e.high]
        for key, by in score.joints.items()
        for name, e in by.items()
    ]
    return ["channel", "joint or axis", "unit", "rms", "90 % from", "to"], rows


def _traces(page: Page, score: PredictionScore, model: str, joints: Sequence[str]) -> None:
    """The worst log of the robot; some runs of the bench."""
    good = [i for i, entry in enumerate(score.logs) if entry.error_mrad is not None]
    if not good:
        return
    order = sorted(good, key=lambda i: score.logs[i].error_mrad or 0.0)
    bench = all(entry.log.metadata.mount == "pendulum" for entry in score.logs)
    if bench:
        logs = [entry.log for entry in score.logs]
        page.section("Error of every run")
        errors = {model: [entry.error_mrad for entry in score.logs]}
        page.figure(errors_figure(logs, errors, heldout=[False] * len(logs)), "Open-loop replays.")
        chosen = np.unique(np.linspace(0, len(order) - 1, SHOWN_RUNS).round().astype(int))
        picked = [order[i] for i in chosen]
        page.section("Some runs")
        page.figure(
            runs_figure([logs[i] for i in picked], {model: [score.predictions[i] for i in picked]}),
            "From the best to the worst, evenly chosen.",
        )
        return
    worst = score.logs[order[-1]].log
    page.section(f"Predicted worst: {run_name(worst)}" if len(good) > 1 else run_name(worst))
    page.text("Open-loop replay from the first row: only the commands reach the simulation.")
    shown = {model: score.predictions[order[-1]]}
    drawn = joints if set(joints) <= set(worst.joints) else ()
    page.figure(traces_figure(worst, shown, drawn), "Measured and predicted, left and right.")
    page.figure(body_figure(worst, shown), "Trunk: roll, pitch and body rates.")
