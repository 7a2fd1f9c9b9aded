"""The page and numbers of a model's prediction errors on logs."""

from collections.abc import Sequence
from typing import Any

from op3.common.plain_names import words
from op3.identify.prediction_score import PredictionScore
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.tables import TableRows
from op3.report.trace_figures import bench_figures, body_figure, checks_table, run_name, traces_figure
from op3.rollout import CHANNELS
from op3.rollout.schema import normal_key


def report_prediction(
    score: PredictionScore, run: RunFolder, *, model: str, wall_seconds: float, joints: Sequence[str] = ()
) -> dict[str, Any]:
    """Publish the prediction errors of the named model; `joints` are drawn, or all joints of a log if empty."""
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
    worst, figures = _figures(score, model, joints)
    page = Page.of("prediction", figures, _tables(score), score=score, model=model, worst=worst)
    return publish(page, values, run)


def _tables(score: PredictionScore) -> dict[str, TableRows]:
    tail = ["90 % from", "to"]
    units = {key: CHANNELS[normal_key(key)].unit for key in {**score.channels, **score.joints}}
    logs = [[run_name(s.log), s.log.metadata.mount, s.error_mrad, s.paper_eq7, s.seen] for s in score.logs]
    return {
        "channels": (
            ["channel", "unit", "rms", *tail],
            [[key, units[key], e.value, e.low, e.high] for key, e in score.channels.items()],
        ),
        "joints": (
            ["channel", "joint or axis", "unit", "rms", *tail],
            [
                [key, words(name), units[key], e.value, e.low, e.high]
                for key, by in score.joints.items() for name, e in by.items()
            ],
        ),
        "trajectories": (
            ["trajectory", "error [mrad]", *tail],
            [[words(motion), e.value, e.low, e.high] for motion, e in score.trajectories.items()],
        ),
        "logs": (["log", "mount", "error [mrad]", "paper eq. (7)", "fitted"], logs),
        "checks": checks_table(entry.log for entry in score.logs),
    }  # fmt: skip


def _figures(score: PredictionScore, model: str, joints: Sequence[str]) -> tuple[str | None, dict[str, Any]]:
    """The worst log of a robot with the heading of its figures, or some runs of a bench."""
    errors = [entry.error_mrad for entry in score.logs]
    good = [i for i, error in enumerate(errors) if error is not None]
    if not good:
        return None, {}
    if all(entry.log.metadata.mount == "pendulum" for entry in score.logs):
        logs = [entry.log for entry in score.logs]
        return None, bench_figures(logs, {model: score.predictions}, {model: errors}, [False] * len(logs))
    worst = max(good, key=lambda i: errors[i] or 0.0)
    log, shown = score.logs[worst].log, {model: score.predictions[worst]}
    drawn = joints if set(joints) <= set(log.joints) else ()
    heading = f"Predicted worst: {run_name(log)}" if len(good) > 1 else run_name(log)
    return heading, {"traces": traces_figure(log, shown, drawn), "body": body_figure(log, shown)}
