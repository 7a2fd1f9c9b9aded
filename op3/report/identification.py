"""The page, numbers and wandb run of an identification."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from op3.identify.identification import Fit, Score
from op3.report.figures import errors_figure, history_figure, ranges_figure
from op3.report.identifiability import identifiability_numbers, identifiability_section
from op3.report.page import Page
from op3.report.result import finish, write_result
from op3.report.run_logger import RunLogger
from op3.report.tables import loss_table, number, parameter_table
from op3.report.traces import body_figure, runs_figure, traces_figure
from op3.rollout import Rollout

SHOWN_RUNS = 6
"""Bench runs drawn on the page, the worst, the best and between."""


def report_identification(
    fit: Fit,
    ablated: Fit | None,
    folder: Path,
    *,
    wall_seconds: float,
    ablated_seconds: float = 0.0,
    provenance: Mapping[str, Any],
    joints: Sequence[str] = (),
    config: Mapping[str, Any] | None = None,
    wandb_mode: str | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        fit: the identified model.
        ablated: the same without some effects, for comparison.
        folder: of the run.
        wall_seconds: duration of the identification [s].
        ablated_seconds: duration of that for comparison [s].
        provenance: where the numbers come from, see `op3.report.run_provenance`.
        joints: joints to draw; all of a log where empty.
        config: settings, for wandb.
        wandb_mode: ``offline``, ``online`` or ``disabled``.

    Returns:
        The numbers of ``result.yaml``.
    """
    fits = [fit] if ablated is None else [fit, ablated]
    values = _numbers(fit, ablated, (wall_seconds, ablated_seconds), provenance)
    page = _page(fits, joints, values, provenance)
    page_path = page.write(folder / "index.html")
    result_path = write_result(folder / "result.yaml", values)
    with RunLogger(folder, config=config, mode=wandb_mode) as logger:
        for trial, loss in enumerate(np.fmin.accumulate(np.asarray(fit.trials, dtype=float))):
            if np.isfinite(loss):
                logger.log({"loss.best": float(loss)}, step=trial)
        logger.summary({k: v for k, v in values.items() if isinstance(v, int | float)})
    finish(page_path, result_path)
    return values


def _numbers(
    fit: Fit, ablated: Fit | None, seconds: tuple[float, float], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "loss.fit": _finite(fit.fit.loss),
        "loss.heldout": _loss(fit.heldout),
        "loss.paper_eq7": _finite(fit.fit.paper_eq7),
        "loss.paper_eq7_heldout": None if fit.heldout is None else _finite(fit.heldout.paper_eq7),
        "error_mrad.train": _finite(fit.fit.error_mrad),
        "error_mrad.heldout": None if fit.heldout is None else _finite(fit.heldout.error_mrad),
        "wall_seconds": seconds[0],
        "simulated_seconds": fit.simulated_seconds,
        "diverged_logs": _diverged(fit),
        "trials": len(fit.trials),
        "trials_failed": int(np.isnan(np.asarray(fit.trials, dtype=float)).sum()),
    }
    if ablated is not None:
        suffix = ablated.label.replace(" ", "_").replace(",", "").lower()
        numbers |= {
            f"loss.fit_{suffix}": _finite(ablated.fit.loss),
            f"loss.heldout_{suffix}": _loss(ablated.heldout),
            f"loss.paper_eq7_{suffix}": _finite(ablated.fit.paper_eq7),
            f"error_mrad.train_{suffix}": _finite(ablated.fit.error_mrad),
            f"error_mrad.heldout_{suffix}": None if ablated.heldout is None else _finite(ablated.heldout.error_mrad),
            f"wall_seconds_{suffix}": seconds[1],
            f"simulated_seconds_{suffix}": ablated.simulated_seconds,
        }
    numbers["parameters"] = {name: fit.model.estimate(name) for name in fit.found}
    if fit.identifiability is not None:
        numbers |= identifiability_numbers(fit.identifiability)
    numbers["provenance"] = provenance
    return numbers


def _loss(score: Score | None) -> float | None:
    return None if score is None else _finite(score.loss)


def _finite(value: float) -> float | None:
    """A number of ``result.yaml``: None where a simulation diverged, which `diverged_logs` then names."""
    return value if np.isfinite(value) else None


def _diverged(fit: Fit) -> list[str]:
    scores = [fit.fit] + ([fit.heldout] if fit.heldout else [])
    logs = [p.log for score in scores for p in score.predictions if bool(p.failed.any())]
    return [log.metadata.recording or log.metadata.motion or "log" for log in logs]


def _lead(fit: Fit, ablated: Fit | None) -> str:
    bench = "imu/orientation" not in fit.fit.predictions[0].log
    what = "mean position error" if bench else "loss"
    unit = " mrad" if bench else ""

    def figures(one: Fit) -> tuple[str, str]:
        fitted = one.fit.error_mrad if bench else one.fit.loss
        if one.heldout is None:
            return number(fitted, 3) + unit, ""
        held = one.heldout.error_mrad if bench else one.heldout.loss
        return number(fitted, 3) + unit, number(held, 3) + unit

    fitted, held = figures(fit)
    if ablated is None:
        lead = f"The identified model leaves a {what} of {fitted}."
        return lead + (f" On logs it has not seen: {held}." if held else "")
    other, other_held = figures(ablated)
    lead = f"{fit.label[0].upper()}{fit.label[1:]} the {what} is {fitted}, {ablated.label} {other}."
    return lead + (f" On logs that neither has seen: {held} against {other_held}." if held else "")


def _page(fits: Sequence[Fit], joints: Sequence[str], values: Mapping[str, Any], provenance: Mapping[str, Any]) -> Page:
    fit, ablated = fits[0], fits[1] if len(fits) > 1 else None
    logs = [prediction.log for prediction in fit.fit.predictions]
    names = ", ".join(sorted({log.metadata.motion or log.metadata.recording or "log" for log in logs}))
    page = Page(f"Identification from {names}", _lead(fit, ablated))
    _tiles(page, fit, ablated, values)
    if logs[0].metadata.mount == "pendulum":
        _bench_traces(page, fits)
    else:
        _robot_traces(page, fits, joints)
    page.section("Loss")
    page.figure(
        history_figure(
            {f.label: list(f.trials) for f in fits}, {f.label: list(f.refined) for f in fits if f.refined} or None
        ),
        "Best so far as a line, single trials as dots, then rounds of the surrogate and iterations of least squares.",
    )
    terms = {"fit": {f.label: {**f.fit.terms, "paper eq. (7)": f.fit.paper_eq7} for f in fits}}
    if fit.heldout is not None:
        terms["held out"] = {
            f.label: {**f.heldout.terms, "paper eq. (7)": f.heldout.paper_eq7} for f in fits if f.heldout
        }
    page.table(*loss_table(terms, "paper eq. (7)"), caption="Terms of the loss, unweighted.")
    page.section("Parameters")
    models = {f.label: f.model for f in fits}
    page.figure(
        ranges_figure(models, fit.found, fit.bounds, fit.starts),
        "Parameters in the ranges searched, with 90 % intervals from the data.",
    )
    page.table(
        *parameter_table(models, bounds=fit.bounds, starts=fit.starts),
        caption="All parameters; those without an interval were not searched.",
    )
    if fit.identifiability is not None:
        identifiability_section(page, fit.identifiability)
    page.section("Files")
    page.files({"result.yaml": "all numbers of this page", "model.yaml": "the identified model"})
    page.provenance(provenance)
    return page


def _tiles(page: Page, fit: Fit, ablated: Fit | None, values: Mapping[str, Any]) -> None:
    page.tile("loss", fit.fit.loss, note=f"{number(ablated.fit.loss, 3)} {ablated.label}" if ablated else "")
    if fit.heldout is not None:
        other = ablated.heldout if ablated else None
        note = f"{number(other.loss, 3)} {ablated.label}" if other is not None and ablated is not None else ""
        page.tile("held-out loss", fit.heldout.loss, note=note)
        page.tile("held-out error", fit.heldout.error_mrad, "mrad", f"{number(fit.fit.error_mrad, 3)} on fitted logs")
    else:
        page.tile("position error", fit.fit.error_mrad, "mrad")
    page.tile("trials", len(fit.trials), note=f"{number(fit.simulated_seconds, 3)} s simulated")
    page.tile("time", values["wall_seconds"], "s")


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


def _bench_traces(page: Page, fits: Sequence[Fit]) -> None:
    fit = fits[0]
    scores = [fit.fit] + ([fit.heldout] if fit.heldout else [])
    logs = [p.log for score in scores for p in score.predictions]
    heldout = [score is fit.heldout for score in scores for _ in score.predictions]
    errors = {f.label: [*f.fit.errors_mrad, *(f.heldout.errors_mrad if f.heldout else ())] for f in fits}
    page.section("Error of every run")
    page.figure(errors_figure(logs, errors, heldout=heldout), "Mean absolute position error of open-loop replays.")
    page.section("Some runs")
    order = np.argsort(errors[fit.label])
    chosen = order[np.unique(np.linspace(0, len(order) - 1, SHOWN_RUNS).round().astype(int))]
    predictions = {f.label: [*f.fit.predictions, *(f.heldout.predictions if f.heldout else ())] for f in fits}
    page.figure(
        runs_figure([logs[i] for i in chosen], {name: [all_[i] for i in chosen] for name, all_ in predictions.items()}),
        "From the best to the worst, evenly chosen.",
    )
