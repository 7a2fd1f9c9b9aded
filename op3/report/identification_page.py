"""The page, numbers and wandb run of an identification."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from op3.common.plain_names import words
from op3.identify.identifiability import SHARE
from op3.identify.identification import Fit, FitScore
from op3.report.figures import history_figure, ranges_figure
from op3.report.identifiability_section import identifiability_figure, identifiability_numbers, verdicts, widths_table
from op3.report.page import Page
from op3.report.result import RunFolder, finite, publish
from op3.report.tables import TableRows, loss_table, parameter_table
from op3.report.trace_figures import bench_figures, body_figure, checks_table, run_name, traces_figure

EQ7 = "paper eq. (7)"


def report_identification(
    fit: Fit,
    ablated: Fit | None,
    run: RunFolder,
    *,
    wall_seconds: float,
    ablated_seconds: float = 0.0,
    joints: Sequence[str] = (),
) -> dict[str, Any]:
    """Publish an identified model and, if requested, a model without some effects.

    Args:
        ablated: identified model without some effects, for comparison.
        wall_seconds: duration of the run, with that of the comparison [s].
        ablated_seconds: duration of the comparison's identification [s].
        joints: joints to draw; empty: all joints of a log.
    """
    trials = np.asarray(fit.trials, dtype=float)
    values = {
        **_numbers(fit, wall_seconds),
        "diverged_logs": [run_name(p.log) for score in _scores(fit) for p in score.predictions if p.failed.any()],
        "trials": len(trials),
        "trials_failed": int(np.isnan(trials).sum()),
    }
    fits = [fit] if ablated is None else [fit, ablated]
    for one in fits[1:]:
        suffix = one.label.replace(" ", "_").replace(",", "").lower()
        values |= {f"{key}_{suffix}": value for key, value in _numbers(one, ablated_seconds).items()}
    values["parameters"] = {name: fit.model.estimate(name) for name in fit.found}
    known = fit.identifiability
    if known is not None:
        values |= identifiability_numbers(known)
    logs = [prediction.log for prediction in fit.fit.predictions]
    bench = logs[0].metadata.mount == "pendulum"
    figures, drawn = _bench(fits) if bench else _robot(fits, joints)
    page = Page.of(
        "identification", figures | _figures(fits), _tables(fits), fits=fits, drawn=drawn, bench=bench, known=known,
        names=", ".join(sorted({log.metadata.motion or log.metadata.recording or "log" for log in logs})),
        abstained=abstained(fit), wall_seconds=wall_seconds, share=SHARE, verdicts=verdicts(known) if known else {},
    )  # fmt: skip
    best = {"loss.best": np.fmin.accumulate(trials).tolist() if len(trials) else []}
    return publish(page, values, run, curve=best)


def _scores(fit: Fit) -> list[FitScore]:
    return [fit.fit] if fit.heldout is None else [fit.fit, fit.heldout]


def _numbers(fit: Fit, seconds: float) -> dict[str, Any]:
    """Error of a fit; None without held-out logs, or if a simulation diverged."""
    held = fit.heldout
    return {
        "loss.fit": finite(fit.fit.loss),
        "loss.heldout": None if held is None else finite(held.loss),
        "loss.paper_eq7": finite(fit.fit.paper_eq7),
        "loss.paper_eq7_heldout": None if held is None else finite(held.paper_eq7),
        "error_mrad.train": finite(fit.fit.error_mrad),
        "error_mrad.heldout": None if held is None else finite(held.error_mrad),
        "wall_seconds": seconds,
        "simulated_seconds": fit.simulated_seconds,
    }


def abstained(fit: Fit) -> str:
    """Sentences about parameters that are not identifiable from the logs, and about planning recordings for them."""
    if fit.identifiability is None:
        return ""
    sorted_names = verdicts(fit.identifiability)
    bound, unidentifiable = sorted_names["at its bound"], sorted_names["not identifiable"]
    said = f" At the bound of the searched range: {', '.join(map(words, bound))}." if bound else ""
    if unidentifiable:
        said += f" Not identifiable from these logs: {', '.join(map(words, unidentifiable))}."
        said += f" Next: plan recordings with `op3 design 'wanted=[{','.join(unidentifiable)}]'`."
    return said


def _figures(fits: Sequence[Fit]) -> dict[str, Any]:
    fit, known = fits[0], fits[0].identifiability
    return {
        "history": history_figure(
            {f.label: list(f.trials) for f in fits}, {f.label: list(f.refined) for f in fits if f.refined}
        ),
        "ranges": ranges_figure({f.label: f.model for f in fits}, list(fit.found), fit.bounds, fit.starts),
        "identifiability": None if known is None else identifiability_figure(known),
    }


def _tables(fits: Sequence[Fit]) -> dict[str, TableRows]:
    fit, known = fits[0], fits[0].identifiability
    terms = {"fit": {f.label: {**f.fit.terms, EQ7: f.fit.paper_eq7} for f in fits}}
    if fit.heldout is not None:
        terms["held out"] = {f.label: {**f.heldout.terms, EQ7: f.heldout.paper_eq7} for f in fits if f.heldout}
    return {
        "loss": loss_table(terms, EQ7),
        "parameters": parameter_table({f.label: f.model for f in fits}, bounds=fit.bounds, starts=fit.starts),
        "widths": ([], []) if known is None else widths_table(known),
        "checks": checks_table(prediction.log for score in _scores(fit) for prediction in score.predictions),
    }


def _bench(fits: Sequence[Fit]) -> tuple[dict[str, Any], list[str]]:
    predictions = {f.label: [p for score in _scores(f) for p in score.predictions] for f in fits}
    errors = {f.label: [e for score in _scores(f) for e in score.errors_mrad] for f in fits}
    heldout = [score is fits[0].heldout for score in _scores(fits[0]) for _ in score.predictions]
    return bench_figures([p.log for p in predictions[fits[0].label]], predictions, errors, heldout), []


def _robot(fits: Sequence[Fit], joints: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Figures of all fitted logs and of the first held-out log, with their titles."""
    shown = [("Fitted", {f.label: f.fit.predictions[i] for f in fits}) for i in range(len(fits[0].fit.predictions))]
    if fits[0].heldout is not None:
        shown.append(("Held out", {f.label: f.heldout.predictions[0] for f in fits if f.heldout}))
    figures, drawn = {}, []
    for number, (what, predictions) in enumerate(shown):
        log = next(iter(predictions.values())).log
        drawn.append(f"{what}: {log.metadata.recording or log.metadata.motion}")
        figures[f"traces_{number}"] = traces_figure(log, predictions, joints)
        figures[f"body_{number}"] = body_figure(log, predictions)
    return figures, drawn
