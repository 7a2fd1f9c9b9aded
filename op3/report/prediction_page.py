"""The page and numbers of how well a model predicts logs."""

from collections.abc import Mapping, Sequence
from typing import Any

from op3.identify.prediction_score import PredictionScore
from op3.report.log_section import log_section
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import words
from op3.report.tables import number
from op3.report.traces import bench_sections, body_figure, run_name, traces_figure
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


def report_prediction(
    score: PredictionScore,
    run: RunFolder,
    *,
    model: str,
    wall_seconds: float,
    joints: Sequence[str] = (),
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        score: what was measured.
        run: where it is kept.
        model: what the model is called.
        wall_seconds: duration of the run [s].
        joints: joints to draw; all of a log where empty.

    Returns:
        The numbers of ``result.yaml``.
    """
    values = {
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
        "logs": [
            {key: getattr(entry.log.metadata, key) for key in ("recording", "motion", "mount")}
            | {key: getattr(entry, key) for key in ("error_mrad", "paper_eq7", "seen")}
            for entry in score.logs
        ],
    }
    return publish(_page(score, model, joints), values, run, MEANINGS)


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


def _page(score: PredictionScore, model: str, joints: Sequence[str]) -> Page:
    page = Page(f"Prediction by {model}", _lead(score))
    for name, estimate, unit in (("position error", score.error_mrad, "mrad"), ("paper eq. (7)", score.paper_eq7, "")):
        if estimate is not None:
            known = estimate.low is not None and estimate.high is not None
            note = f"90 %: {number(estimate.low, 3)} to {number(estimate.high, 3)}" if known else ""  # type: ignore[arg-type]
            page.tile(name, estimate.value, unit, note)
    page.tile("logs", len(score.logs))
    _traces(page, score, model, joints)
    tail = ["90 % from", "to"]
    channels = [[key, CHANNELS[normal_key(key)].unit, e.value, e.low, e.high] for key, e in score.channels.items()]
    joints_rows = [
        [key, words(name), CHANNELS[normal_key(key)].unit, e.value, e.low, e.high]
        for key, by in score.joints.items()
        for name, e in by.items()
    ]
    trajectories = [[words(motion), e.value, e.low, e.high] for motion, e in score.trajectories.items()]
    logs = [[run_name(s.log), s.log.metadata.mount, s.error_mrad, s.paper_eq7, s.seen] for s in score.logs]
    tables = {
        "channels": (["channel", "unit", "rms", *tail], channels),
        "joints": (["channel", "joint or axis", "unit", "rms", *tail], joints_rows, 3),
        "trajectories": (["trajectory", "error [mrad]", *tail], trajectories),
        "logs": (["log", "mount", "error [mrad]", "paper eq. (7)", "fitted"], logs),
    }
    page.fill("prediction", None, tables, score=score)
    log_section(page, (entry.log for entry in score.logs))
    page.section("Files")
    page.files({"result.yaml": "all numbers of this page"})
    return page


def _traces(page: Page, score: PredictionScore, model: str, joints: Sequence[str]) -> None:
    """The worst log of the robot; some runs of the bench."""
    errors = [entry.error_mrad for entry in score.logs]
    good = [i for i, error in enumerate(errors) if error is not None]
    if not good:
        return
    if all(entry.log.metadata.mount == "pendulum" for entry in score.logs):
        logs = [entry.log for entry in score.logs]
        bench_sections(page, logs, {model: score.predictions}, {model: errors}, [False] * len(logs))
        return
    worst = max(good, key=lambda i: errors[i] or 0.0)
    log = score.logs[worst].log
    page.section(f"Predicted worst: {run_name(log)}" if len(good) > 1 else run_name(log))
    page.text("Open-loop replay from the first row: only the commands reach the simulation.")
    shown = {model: score.predictions[worst]}
    drawn = joints if set(joints) <= set(log.joints) else ()
    page.figure(traces_figure(log, shown, drawn), "Measured and predicted, left and right.")
    page.figure(body_figure(log, shown), "Trunk: roll, pitch and body rates.")
