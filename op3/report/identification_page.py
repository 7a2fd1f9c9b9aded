"""The page, numbers and wandb run of an identification."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from op3.identify.identifiability import SHARE
from op3.identify.identification import Fit, Score
from op3.report.figures import history_figure, ranges_figure
from op3.report.identifiability_section import identifiability_figure, identifiability_numbers, verdicts, widths_table
from op3.report.log_section import log_section
from op3.report.page import Page
from op3.report.result import RunFolder, finite, publish
from op3.report.style import words
from op3.report.tables import loss_table, number, parameter_table
from op3.report.traces import bench_sections, body_figure, run_name, traces_figure
from op3.rollout import Rollout

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
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        fit: the identified model.
        ablated: the same without some effects, for comparison.
        run: where it is kept.
        wall_seconds: duration of the identification [s].
        ablated_seconds: duration of that for comparison [s].
        joints: joints to draw; all of a log where empty.

    Returns:
        The numbers of ``result.yaml``.
    """
    trials = np.asarray(fit.trials, dtype=float)
    values = {
        **_numbers(fit, wall_seconds),
        "diverged_logs": [run_name(p.log) for score in _scores(fit) for p in score.predictions if p.failed.any()],
        "trials": len(trials),
        "trials_failed": int(np.isnan(trials).sum()),
    }
    if ablated is not None:
        suffix = ablated.label.replace(" ", "_").replace(",", "").lower()
        values |= {f"{key}_{suffix}": value for key, value in _numbers(ablated, ablated_seconds).items()}
    values["parameters"] = {name: fit.model.estimate(name) for name in fit.found}
    if fit.identifiability is not None:
        values |= identifiability_numbers(fit.identifiability)
    page = _page([fit] if ablated is None else [fit, ablated], joints, wall_seconds)
    best = {"loss.best": np.fmin.accumulate(trials).tolist() if len(trials) else []}
    return publish(page, values, run, curve=best)


def _scores(fit: Fit) -> list[Score]:
    return [fit.fit] if fit.heldout is None else [fit.fit, fit.heldout]


def _numbers(fit: Fit, seconds: float) -> dict[str, Any]:
    """What a fit is worth; None without held-out logs, and where a simulation diverged."""
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


def _lead(fits: Sequence[Fit]) -> str:
    bench = "imu/orientation" not in fits[0].fit.predictions[0].log
    what, unit = ("mean position error", " mrad") if bench else ("loss", "")
    fitted, held = (
        [number(score.error_mrad if bench else score.loss, 3) + unit for score in scores]
        for scores in ([f.fit for f in fits], [f.heldout for f in fits if f.heldout is not None])
    )
    untold = abstained(fits[0])
    if len(fits) == 1:
        lead = f"The identified model leaves a {what} of {fitted[0]}{untold}."
        lead += f" On logs it has not seen: {held[0]}." if held else ""
    else:
        label = fits[0].label[0].upper() + fits[0].label[1:]
        lead = f"{label} the {what} is {fitted[0]}, {fits[1].label} {fitted[1]}{untold}."
        lead += f" On logs that neither has seen: {held[0]} against {held[1]}." if held else ""
    return lead


def abstained(fit: Fit) -> str:
    """What the logs do not tell, and how recordings that would are found; it follows a sentence's end."""
    known = fit.identifiability
    if known is None:
        return ""
    told = verdicts(known)
    bound, untold = [words(name) for name in told["at its bound"]], told["not told"]
    said = f"; at its bound: {', '.join(bound)}" if bound else ""
    if untold:
        said += f"; these logs do not tell {', '.join(map(words, untold))}, and"
        said += f" `op3 design 'wanted=[{','.join(untold)}]'` plans recordings that would"
    return said


def _page(fits: Sequence[Fit], joints: Sequence[str], wall_seconds: float) -> Page:
    fit = fits[0]
    logs = [prediction.log for prediction in fit.fit.predictions]
    names = ", ".join(sorted({log.metadata.motion or log.metadata.recording or "log" for log in logs}))
    page = Page(f"Identification from {names}", _lead(fits))
    _tiles(page, fits, wall_seconds)
    if logs[0].metadata.mount == "pendulum":
        predictions = {f.label: [p for score in _scores(f) for p in score.predictions] for f in fits}
        errors = {f.label: [e for score in _scores(f) for e in score.errors_mrad] for f in fits}
        heldout = [score is fit.heldout for score in _scores(fit) for _ in score.predictions]
        bench_sections(page, [p.log for p in predictions[fit.label]], predictions, errors, heldout)
    else:
        _robot_traces(page, fits, joints)
    refined, known = {f.label: list(f.refined) for f in fits if f.refined}, fit.identifiability
    terms = {"fit": {f.label: {**f.fit.terms, EQ7: f.fit.paper_eq7} for f in fits}}
    if fit.heldout is not None:
        terms["held out"] = {f.label: {**f.heldout.terms, EQ7: f.heldout.paper_eq7} for f in fits if f.heldout}
    models = {f.label: f.model for f in fits}
    figures = {
        "history": history_figure({f.label: list(f.trials) for f in fits}, refined or None),
        "ranges": ranges_figure(models, fit.found, fit.bounds, fit.starts),
        "identifiability": None if known is None else identifiability_figure(known),
    }
    tables = {
        "loss": loss_table(terms, EQ7),
        "parameters": parameter_table(models, bounds=fit.bounds, starts=fit.starts),
        **({} if known is None else {"widths": widths_table(known)}),
    }
    told = {} if known is None else {verdict: [words(n) for n in each] for verdict, each in verdicts(known).items()}
    page.fill("identification", figures, tables, known=known, told=told, share=SHARE)
    log_section(page, (prediction.log for score in _scores(fit) for prediction in score.predictions))
    page.section("Files")
    page.files({"result.yaml": "all numbers of this page", "model.yaml": "the identified model"})
    return page


def _tiles(page: Page, fits: Sequence[Fit], wall_seconds: float) -> None:
    fit, others = fits[0], fits[1:]
    page.tile("loss", fit.fit.loss, note=", ".join(f"{number(o.fit.loss, 3)} {o.label}" for o in others))
    if fit.heldout is None:
        page.tile("position error", fit.fit.error_mrad, "mrad")
    else:
        note = ", ".join(f"{number(o.heldout.loss, 3)} {o.label}" for o in others if o.heldout is not None)
        page.tile("held-out loss", fit.heldout.loss, note=note)
        page.tile("held-out error", fit.heldout.error_mrad, "mrad", f"{number(fit.fit.error_mrad, 3)} on fitted logs")
    page.tile("trials", len(fit.trials), note=f"{number(fit.simulated_seconds, 3)} s simulated")
    page.tile("time", wall_seconds, "s")


def _robot_traces(page: Page, fits: Sequence[Fit], joints: Sequence[str]) -> None:
    for index, prediction in enumerate(fits[0].fit.predictions):
        _one_robot(page, "Fitted", prediction.log, {f.label: f.fit.predictions[index] for f in fits}, joints)
    for index, prediction in enumerate(fits[0].heldout.predictions[:1] if fits[0].heldout else ()):
        shown = {f.label: f.heldout.predictions[index] for f in fits if f.heldout}
        _one_robot(page, "Held out", prediction.log, shown, joints)


def _one_robot(page: Page, what: str, log: Rollout, shown: Mapping[str, Any], joints: Sequence[str]) -> None:
    page.section(f"{what}: {log.metadata.recording or log.metadata.motion}")
    page.text("Open-loop replay from the first row: only the commands reach the simulation.")
    page.figure(
        traces_figure(log, shown, joints),
        "Measured and simulated, left and right. Drag to zoom all panels in time, double-click to return.",
    )
    page.figure(body_figure(log, shown), "Trunk: roll, pitch and body rates.")
