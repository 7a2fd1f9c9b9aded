"""The page of a diagnosis: whether the base can be trusted, the findings, every joint, and the gap before and after."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from op3.diagnose import Finding, LogSplit, Verdict
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import words
from op3.report.traces import traces_figure
from op3.report.tracks import SHOWN, predicted
from op3.servo import effect_class
from op3.tasks import Prediction

MEANINGS: Mapping[str, str] = {
    "verdict": "named, ambiguous, nothing_missing or unknown; the findings with all they say stand in verdict.yaml",
    "probability": "of the most probable finding",
    "gap": "root mean square over joints and runs that nothing was chosen by; the floor is how far repeats differ",
    "loss": "paper eq. (7) on the same runs",
}


def report_diagnosis(
    verdict: Verdict,
    split: LogSplit,
    content: Mapping[str, Any],
    run: RunFolder,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, log to wandb, and print the paths of both files.

    Args:
        verdict: of a diagnosis.
        split: its logs.
        content: of ``verdict.yaml``.
        run: where it is kept.

    Returns:
        The numbers of ``result.yaml``.
    """
    found, elsewhere = content["findings"], content.get("other_mounts", {})
    values: dict[str, Any] = {
        "verdict": content["verdict"],
        "sentence": content["sentence"],
        "findings": ", ".join(f"{one['effect']} in {', '.join(one['joints'])}" for one in found),
        "probability": max((one["probability"] for one in found), default=None),
        **_flat("", content),
        **{key: value for mount, told in elsewhere.items() for key, value in _flat(f"{mount}.", told).items()},
    }
    save_shown(verdict, run.path / SHOWN)
    return publish(_page(verdict, split, content, run.path), values, run, MEANINGS)


def _page(verdict: Verdict, split: LogSplit, content: Mapping[str, Any], folder: Path) -> Page:
    page = Page("Diagnosis of what the model lacks", lead(verdict))
    for channel, values in verdict.gap.items():
        floor = values["floor"]
        note = f"before {values['before']:.3g}" + ("" if floor is None else f", repeats differ by {floor:.3g}")
        page.tile(f"Gap in {channel.split('/')[1]}", values["after"], values["unit"], note)
    _findings(page, verdict)
    _joints(page, verdict)
    _gap(page, verdict)
    _elsewhere(page, content.get("other_mounts", {}))
    _motions(page, verdict, split)
    _traces(page, verdict)
    if "downstream" in content:
        _returns(page, content["downstream"])
    _base(page, verdict)
    page.section("Next")
    page.text("See the measured robot with its ghosts, and train with the model handed back:")
    page.code(f"op3 view {folder}\nop3 train task=balance model={folder}/model.yaml")
    page.section("Files")
    page.files(
        {"verdict.yaml": "the verdict as data", "model.yaml": "the model that predicts best, for every other command"}
    )
    return page


def lead(verdict: Verdict) -> str:
    """The verdict; what was abstained from with the experiment that would settle it, in the first sentence."""
    rivals = [finding for finding in verdict.findings if finding.alternatives]
    if rivals or verdict.findings:
        settled = [f"What would tell {one.effect} from its rivals: {one.separate_by}." for one in rivals]
        return " ".join([verdict.sentence, *settled])
    if verdict.verdict == "nothing_missing" or not verdict.ranking:
        return verdict.sentence
    best = verdict.ranking[0]
    where = "all joints" if best["shared"] else " and ".join(best["joints"])
    experiment = effect_class(best["effect"]).separating_experiment
    return f"Nothing is named; what would settle the likeliest, {best['effect']} in {where}: {experiment}. " + (
        verdict.sentence
    )


def save_shown(verdict: Verdict, folder: Path) -> None:
    """Keep the run that the base predicts worst, measured and as both models say, for `op3 view`."""
    before, after = (verdict.shown.get(name, ()) for name in ("before", "after"))
    whole = [i for i, pair in enumerate(zip(before, after, strict=True)) if not any(p.failed.any() for p in pair)]
    if whole:
        worst = max(whole, key=lambda i: _angle_error(before[i]))
        tracks = {"measured": before[worst].log, "before": predicted(before[worst]), "after": predicted(after[worst])}
        for name, log in tracks.items():
            log.save(folder / name, overwrite=True)


def _flat(prefix: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Gap and loss under one name each."""
    ends = ("before", "after", "floor", "closure")
    gap = {f"{prefix}gap.{key}.{end}": entry.get(end) for key, entry in content["gap"].items() for end in ends}
    return gap | {f"{prefix}loss.paper_eq7.{end}": content["loss"][end] for end in ends[:2] if content["loss"]}


def _findings(page: Page, verdict: Verdict) -> None:
    """What is missing, how sure, what it could be confused with."""
    page.section("What the model lacks")
    for text in (*(f"The base is in doubt: {doubt}." for doubt in verdict.doubts), *verdict.cannot_tell):
        page.text(text)
    rows = [
        [
            one.effect,
            "all" if one.shared else ", ".join(one.joints),
            one.parameter,
            f"{one.size:.3g} ({one.interval[0]:.3g} to {one.interval[1]:.3g}) {one.unit}",
            one.probability,
            ", ".join(_rival(one)) or None,
            100 * one.explains,
            "yes" if one.in_model else "no",
        ]
        for one in verdict.findings
    ]
    page.table(
        ["effect", "joints", "parameter", "size", "probability", "or", "explains [%]", "in the model"],
        rows,
        "Findings, most probable first; what one explains is of the squared torques that joints lack. A finding that is"
        " not in the model is evident in the windows, and withheld runs are predicted no better with it",
    )
    for one in verdict.findings:
        cls = effect_class(one.effect)
        felt = ", ".join(f"{joint} {1e3 * torque:.0f}" for joint, torque in one.torque.items())
        page.text(
            f"`{one.effect}`: `{cls.equation}`. It shows {cls.fingerprint}."
            + (f" It makes, in mN m: {felt}." if felt else "")
            + (f" What tells it from its rivals: {one.separate_by}." if one.separate_by else "")
        )
    if verdict.ranking:
        ranked = [
            [e["effect"], "all" if e["shared"] else ", ".join(e["joints"]), e["log_odds"]] for e in verdict.ranking
        ]
        page.table(["effect", "joints", "log odds"], ranked, "What was considered before anything was named")


def _rival(finding: Finding) -> list[str]:
    return [f"{one.effect}{'' if one.shared else ' in ' + ', '.join(one.joints)} {one.probability:.2f}"
            for one in finding.alternatives]  # fmt: skip


def _joints(page: Page, verdict: Verdict) -> None:
    """What each joint lacks, and what nobody explains."""
    if not verdict.joints:
        return
    page.section("Joint by joint")
    rows = []
    for joint, gap in verdict.joints.items():
        numbers = [1e3 * value for value in (gap.before, gap.after, gap.floor, gap.unexplained)]
        shape = ", ".join(f"{name} {share:.0%}" for name, share in gap.shape.items() if share > 0.1)
        rows.append([joint, *numbers, "odd" if gap.flagged else None, shape or None])
    page.table(
        ["joint", "before [mN m]", "after [mN m]", "floor [mN m]", "unexplained [mN m]", "", "goes with"],
        rows,
        "Torque that windows of a fifth of a second lack, root mean square: under the base, with the findings, what"
        " sensors make of noise, and what the joint does that no effect of the catalogue explains",
    )


def _gap(page: Page, verdict: Verdict) -> None:
    page.section("The gap on logs that nothing was chosen by")
    page.text(
        "Free runs in closed loop, from the first row and the commands alone, over the logs that show. The floor is how"
        " far repeats of one command differ from their mean. A velocity that is read late is compared as late."
    )
    rows = [
        [
            channel,
            values["unit"],
            *(_with_interval(values, end) for end in ("before", "after", "floor")),
            values["change"],
        ]
        for channel, values in verdict.gap.items()
    ]
    page.table(
        ["channel", "unit", "before", "after", "floor", ""],
        rows,
        "Root mean square over joints and runs; 90 % intervals over seconds",
    )
    if verdict.loss:
        page.text(
            f"Loss of the paper's eq. (7): {verdict.loss['before']:.4g} before, {verdict.loss['after']:.4g} after."
        )
    if len(verdict.choice.get("left", ())) > 1:
        taken = verdict.choice["taken"]
        rows = [
            [number, left, *channels.values(), "taken" if number == taken else None]
            for number, (left, channels) in enumerate(
                zip(verdict.choice["left"], verdict.choice["channels"], strict=True)
            )
        ]
        names = list(verdict.choice["channels"][0])
        page.table(
            ["effects", "left of the base's squares", *names, ""],
            rows,
            "Which model is handed back: the simplest that predicts withheld runs within a standard error of the best",
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


def _motions(page: Page, verdict: Verdict, split: LogSplit) -> None:
    """The gap in angle by motion and by firmware gain, where the runs differ in them."""
    shown = verdict.shown
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


def _traces(page: Page, verdict: Verdict) -> None:
    shown = verdict.shown
    if not shown:
        return
    before, after = shown["before"], shown["after"]
    worst = max(range(len(before)), key=lambda i: _angle_error(before[i]))
    log = before[worst].log
    joint = _worst_joint(before, log.joints)
    predictions = {"before": before[worst].channels} | ({} if after is before else {"after": after[worst].channels})
    page.section("One of the logs")
    page.figure(
        traces_figure(log, predictions, [joint]),
        f"{words(joint)}, the joint that the base model predicts worst, in the run that it predicts worst",
    )


def _worst_joint(predictions: Sequence[Prediction], joints: Sequence[str]) -> str:
    """The joint whose position is predicted worst."""
    totals = torch.zeros(len(joints), dtype=torch.float64)
    for prediction in predictions:
        columns = [prediction.log.joints.index(joint) for joint in joints]
        simulated = prediction.channels["joint", "position"][0][:, columns]
        measured = torch.from_numpy(prediction.log.array("joint/position")[: len(simulated)])[:, columns]
        totals += (simulated - measured).square().mean(0)
    return joints[int(totals.argmax())]


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
    page.section("The base")
    rows = [
        [
            name,
            known.unit,
            verdict.base.value(name),
            verdict.model.value(name) if name in verdict.model.parameters() else None,
        ]
        for name, known in verdict.base.parameters().items()
    ]
    page.table(["parameter", "unit", "base", "handed back"], rows, "Shared values; joints may differ a little")
    if verdict.untold:
        page.text(f"These logs say little of {', '.join(verdict.untold)}: what stands there is what is usual.")
    rows = [[one["name"], one["unit"], one["found"], one["usual"], one["spread"]] for one in verdict.chain]
    page.table(["number", "unit", "found", "usual", "spread"], rows, "The chain of measurement, which every base has")
