"""The page of a diagnosis: the verdict first, then the gap, the rivals, and the base they were weighed against."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from op3.diagnose import LogSplit, Verdict
from op3.diagnose.preflight import FIRMWARE
from op3.diagnose.show import with_whole_limbs, worst_joint
from op3.report.page import Page
from op3.report.run_logger import RunLogger
from op3.report.traces import traces_figure
from op3.servo import effect_class
from op3.tasks import Prediction

LOCATED = 10
"""Cells of residual torque on the page."""

UNUSUAL = 2.5
"""Standard deviations from what is expected of a chain of measurement beyond which the page says so."""

RANKED = 12
"""Hypotheses listed on the page."""


def write_page(
    verdict: Verdict,
    split: LogSplit,
    path: Path,
    provenance: Mapping[str, Any],
    swing: Verdict | None = None,
    returns: Mapping[str, Any] | None = None,
    elsewhere: Mapping[str, Mapping[str, Any]] | None = None,
) -> Path:
    """Write the page of a verdict.

    Args:
        verdict: of a diagnosis.
        split: its logs.
        path: of the page.
        provenance: where the numbers come from, see `op3.report.run_provenance`.
        swing: verdict on the free swings alone, of a bench whose servo was switched off.
        returns: of a policy before and after, see `op3.diagnose.downstream`.
        elsewhere: gap and loss on logs of other mounts, see `op3.diagnose.on_other_mounts`.
    """
    detail = verdict.reason[:1].upper() + verdict.reason[1:] + "."
    if verdict.vetoed:
        detail += " Yet free runs on unseen logs are no better: better one-step physics, no better long-run prediction."
    page = Page("Diagnosis of what the model lacks", f"{verdict.sentence} {detail}")
    for channel, values in verdict.gap.items():
        floor = values["floor"]
        note = f"before {values['before']:.3g}" + ("" if floor is None else f", repeats differ by {floor:.3g}")
        page.tile(f"Gap in {channel.split('/')[1]}", values["after"], values["unit"], note)
    _gap(page, verdict)
    _elsewhere(page, elsewhere or {})
    _where(page, verdict)
    _why(page, verdict)
    _firmware(page, verdict, split)
    _motions(page, verdict, split)
    _traces(page, verdict, split)
    if swing is not None:
        _swing(page, swing)
    if returns is not None:
        _returns(page, returns)
    _base(page, verdict)
    page.section("Files")
    page.files(
        {"verdict.yaml": "the verdict as data", "model.yaml": "the model with what was named, for every other command"}
    )
    page.provenance(provenance)
    return page.write(path)


def log_verdict(
    content: Mapping[str, Any], folder: Path, config: Mapping[str, Any], wandb_mode: str | None = None
) -> None:
    """Log a verdict to wandb; the jobs of a multirun are one group.

    Args:
        content: of ``verdict.yaml``.
        folder: of the run.
        config: settings.
        wandb_mode: ``offline``, ``online`` or ``disabled``.
    """
    if wandb_mode == "disabled":
        return  # half a second that many short runs need not pay
    summary: dict[str, Any] = {
        "verdict": content["verdict"],
        "sentence": content["sentence"],
        "effects": ", ".join(f"{e['name']} in {', '.join(e['joints'])}" for e in content["effects"]),
        "confidence": max((e["confidence"] for e in content["effects"]), default=None),
        **_flat("", content),
        **{
            k: v for mount, told in content.get("other_mounts", {}).items() for k, v in _flat(f"{mount}.", told).items()
        },
    }
    with RunLogger(folder, config=config, mode=wandb_mode) as logger:
        logger.summary({name: value for name, value in summary.items() if value is not None})


def _flat(prefix: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Gap and loss under one name each."""
    ends = ("before", "after", "floor", "ceiling", "closure")
    gap = {f"{prefix}gap.{key}.{end}": entry.get(end) for key, entry in content["gap"].items() for end in ends}
    return gap | {f"{prefix}loss.paper_eq7.{end}": content["loss"][end] for end in ends[:2] if content["loss"]}


def _gap(page: Page, verdict: Verdict) -> None:
    page.section("The gap on logs that nothing was chosen by")
    page.text(
        "Free runs in closed loop, from the first row and the commands alone, over the logs that show. The floor is how"
        " far repeats of one command differ from their mean: a model that is better than that fits these runs as well"
        " as they repeat. The black box may be worse than before where it has learned what does not hold here."
    )
    rows = [
        [
            channel,
            values["unit"],
            _with_interval(values, "before"),
            _with_interval(values, "after"),
            _with_interval(values, "ceiling"),
            _with_interval(values, "floor"),
            None if values["closure"] is None else 100 * values["closure"],
        ]
        for channel, values in verdict.gap.items()
    ]
    page.table(
        ["channel", "unit", "before", "after", "black box", "floor", "closed [%]"],
        rows,
        "Root mean square over joints and runs; 90 % intervals over seconds",
    )
    if verdict.loss:
        page.text(
            f"Loss of the paper's eq. (7): {verdict.loss['before']:.4g} before, {verdict.loss['after']:.4g} after."
        )


def _with_interval(values: Mapping[str, Any], end: str) -> str | None:
    """A number and its interval."""
    if values[end] is None:
        return None
    low, high = values[f"{end}_interval"]
    return f"{values[end]:.3g} ({low:.3g} to {high:.3g})"


def _elsewhere(page: Page, elsewhere: Mapping[str, Mapping[str, Any]]) -> None:
    """The gap on logs of other mounts, of which nothing was fitted or chosen."""
    for mount, told in elsewhere.items():
        rows = [[channel, v["unit"], v["before"], v["after"], v["floor"]] for channel, v in told["gap"].items()]
        page.table(
            ["channel", "unit", "before", "after", "floor"],
            rows,
            f"The same models on {told['logs']} logs of the mount {mount}, the first {told['seconds']:.3g} s of each",
        )
        page.text(
            f"Loss of the paper's eq. (7): {told['loss']['before']:.4g} before, {told['loss']['after']:.4g} after."
        )


def _where(page: Page, verdict: Verdict) -> None:
    """Cells of residual torque, and what a black box makes of them."""
    cells = verdict.details.get("located", ())[:LOCATED]
    if not cells:
        return
    page.section("Where the refitted base lacks torque")
    rows = [
        [c["joint"], c["speed"], c["driven"], c["load"], 1e3 * c["torque"], c["t"], 100 * c["chance"]] for c in cells
    ]
    page.table(
        ["joint", "speed", "motor", "load", "torque [mN m]", "t", "by chance [%]"],
        rows,
        "Mean residual torque in the direction of motion, the surest first; the last column is how often the largest of"
        " all cells is as large when the signs of whole seconds are drawn at random",
    )
    box = verdict.details.get("ceiling", {})
    if box:
        page.text(
            f"A black box learned on the fitted runs explains {max(box['gain'], 0.0):.0%} of the residual of the"
            f" choosing runs, {box['inputs']}."
        )


def _why(page: Page, verdict: Verdict) -> None:
    page.section("Why this, and what it is not")
    for effect in verdict.effects:
        cls = effect_class(effect.name)
        sure = f"Its confidence is {effect.confidence:.2f}."
        page.text(f"`{effect.name}`: `{cls.equation}`. It shows {cls.fingerprint}. {sure}")
    if verdict.separate_by:
        page.text(f"To tell the candidates apart: {verdict.separate_by}.")
    for text in (*verdict.cannot_tell, *verdict.assumed):
        page.text(text)
    ranking = verdict.details.get("ranking", ())[:RANKED]
    rows = [
        [
            entry["name"],
            "all" if len(entry["joints"]) == len(verdict.details.get("joints", ())) else ", ".join(entry["joints"]),
            100 * entry["gain"],
            100 * entry["fit_gain"] if "fit_gain" in entry else None,
            100 * entry["share"] if "share" in entry else None,
            entry["score"],
        ]
        for entry in ranking
    ]
    page.table(
        ["effect", "joints", "explains, choosing runs [%]", "fitted runs [%]", "wins [%]", "score"],
        rows,
        "Hypotheses, best first; those with a share of wins were refitted together with the base. Wins are of"
        " resamples; a stated confidence may be less, as these do not tell what a law does that is a little wrong",
    )


def _firmware(page: Page, verdict: Verdict, split: LogSplit) -> None:
    """What the measured duty says of a servo's own loop."""
    named = {effect.name for effect in verdict.effects}
    gains = {entry["name"]: max(entry["gain"], 0.0) for entry in verdict.details.get("ranking", ())}
    if "joint/duty" not in split.show[0] or named & set(FIRMWARE) or not set(FIRMWARE) <= set(gains):
        return
    page.text(
        f"It is neither a wrong controller gain, which explains {gains['position_servo']:.0%} of the residual, nor a"
        f" delay, {gains['latency']:.0%}: the servo's duty was measured and is compared too."
    )


def _motions(page: Page, verdict: Verdict, split: LogSplit) -> None:
    """The gap in angle by motion and by firmware gain, where the runs differ in them."""
    shown = verdict.details.get("shown")
    if not shown:
        return
    for title, of in (("motion", lambda log: log.metadata.motion), ("gain", lambda log: log.metadata.firmware_gain)):
        errors: dict[Any, list[tuple[float, float]]] = {}
        for before, after in zip(shown["before"], shown["after"], strict=True):
            errors.setdefault(of(before.log), []).append((_angle_error(before), _angle_error(after)))
        if split.show[0].metadata.mount != "pendulum" or len(errors) < 2:
            continue
        rows = [
            [kind, len(each), *(1e3 * float(np.sqrt(np.mean(np.square(column)))) for column in zip(*each, strict=True))]
            for kind, each in sorted(errors.items(), key=lambda item: str(item[0]))
        ]
        page.table([title, "runs", "before [mrad]", "after [mrad]"], rows, f"Root mean square of the angle, by {title}")


def _angle_error(prediction: Prediction) -> float:
    """Root mean square of a prediction's angle [rad]."""
    simulated = prediction.channels["joint", "position"][0].numpy()
    return float(np.sqrt(np.square(simulated - prediction.log.array("joint/position")[: len(simulated)]).mean()))


def _traces(page: Page, verdict: Verdict, split: LogSplit) -> None:
    shown = verdict.details.get("shown")
    if not shown:
        return
    log = split.show[0]
    joint = worst_joint(shown["before"], log.joints)
    predictions = {"before": shown["before"][0].channels}
    if shown["after"] is not shown["before"]:
        predictions["after"] = shown["after"][0].channels
    page.section("One of the logs")
    page.figure(
        traces_figure(with_whole_limbs(log), predictions, [joint]),
        f"{joint}, the joint that the base model predicts worst",
    )


def _swing(page: Page, swing: Verdict) -> None:
    """The verdict on free swings."""
    page.section("While torque is off")
    page.text(
        "The parts in which the servo was switched off and the pendulum swung free, diagnosed by themselves from the"
        f" same model: {swing.sentence} {swing.reason[:1].upper() + swing.reason[1:]}."
    )
    for effect in swing.effects:
        cls = effect_class(effect.name)
        values = ", ".join(f"{name} {value:.3g}" for name, value in effect.parameters.items())
        page.text(f"`{effect.name}`: `{cls.equation}`. It shows {cls.fingerprint}. Found: {values} [{effect.unit}].")
    if swing.separate_by:
        page.text(f"To tell the candidates apart: {swing.separate_by}.")
    rows = [[key, v["unit"], v["before"], v["after"]] for key, v in swing.gap.items()]
    page.table(["channel", "unit", "before", "after"], rows, "Root mean square over swings that nothing was chosen by")


def _returns(page: Page, returns: Mapping[str, Any]) -> None:
    """What a policy returns under the two models, and on the robot."""
    page.section("What it means for a policy")
    page.text(
        f"Return R_eval of `{returns['policy']}` on `{returns['task']}`, {returns['episodes']} episodes under each"
        " model, the same ones; intervals of 90 % over episodes."
    )
    rows = []
    for key, label in (("before", "base"), ("after", "with what was named"), ("actual", "the robot")):
        if key in returns:
            value = returns[key]
            low, high = value["interval"] or (None, None)
            rows.append([label, value["mean"], low, high, 100 * value["fallen"], returns.get(f"error_{key}")])
    page.table(["model", "return", "from", "to", "falls [%]", "off the robot by"], rows, "Returns of one policy")


def _base(page: Page, verdict: Verdict) -> None:
    page.section("The base, refitted")
    rows = [
        [
            name,
            known.unit,
            verdict.base.value(name),
            verdict.model.value(name) if name in verdict.model.parameters() else None,
        ]
        for name, known in verdict.base.parameters().items()
    ]
    page.table(["parameter", "unit", "base", "with what was named"], rows, "Shared values; joints may differ a little")
    unusual = [one for one in verdict.measurement_chain() if abs(one["deviations"]) > UNUSUAL]
    if unusual:
        said = ", ".join(f"`{one['name']}` {one['found']:.3g} {one['unit']}" for one in unusual)
        page.text(
            f"The base takes more upon itself than a chain of measurement usually has: {said}. That may be an effect by"
            " itself; measure it apart."
        )
