"""The page of a diagnosis: before and after, the findings, every joint, and whether the base can be trusted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.diagnose import LogSplit, Verdict
from op3.identify.intervals import at_bound
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import bars_figure
from op3.report.tables import TableRows, place_in_range, span
from op3.report.traces import checks_table, traces_figure
from op3.report.tracks import SHOWN, predicted
from op3.servo import Parameter, RobotModel, effect_class
from op3.tasks import Prediction


def report_diagnosis(verdict: Verdict, split: LogSplit, content: Mapping[str, Any], run: RunFolder) -> dict[str, Any]:
    """Publish a diagnosis of logs, and keep what `op3 view` shows; `content` is that of ``verdict.yaml``."""
    found, elsewhere = content["findings"], content.get("other_mounts", {})
    values: dict[str, Any] = {
        "verdict": content["verdict"],
        "sentence": content["sentence"],
        "findings": ", ".join(f"{one['effect']} in {', '.join(one['joints'])}" for one in found),
        "probability": max((one["probability"] for one in found), default=None),
        **_flat("", content),
        **{key: value for mount, told in elsewhere.items() for key, value in _flat(f"{mount}.", told).items()},
    }
    figures, joint = {}, ""
    if (worst := _worst(verdict)) is not None:
        before, after = worst
        for name, log in {"measured": before.log, "before": predicted(before), "after": predicted(after)}.items():
            log.save(run.path / SHOWN / name, overwrite=True)
        joint = before.log.joints[int(_errors(before).argmax())]
        told = {"before": before} | ({} if after is before else {"after": after})
        figures = {"traces": traces_figure(before.log, told, [joint]), "joints": _joints_figure(verdict)}
    page = Page.of(
        "diagnosis", figures, _tables(verdict, split, content), verdict=verdict, content=content, folder=run.path,
        joint=joint, effect=effect_class,
    )  # fmt: skip
    return publish(page, values, run)


def _flat(prefix: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Gap and loss under one name each."""
    ends = ("before", "after", "floor", "closure")
    gap = {f"{prefix}gap.{key}.{end}": entry.get(end) for key, entry in content["gap"].items() for end in ends}
    return gap | {f"{prefix}loss.paper_eq7.{end}": content["loss"][end] for end in ends[:2] if content["loss"]}


def _worst(verdict: Verdict) -> tuple[Prediction, Prediction] | None:
    """Predictions before and after of the run that the base predicts worst; None where none went to its end."""
    pairs = zip(*(verdict.shown.get(name, ()) for name in ("before", "after")), strict=True)
    whole = [pair for pair in pairs if not any(one.failed.any() for one in pair)]
    return max(whole, key=lambda pair: float(_errors(pair[0]).mean()), default=None)


def _errors(prediction: Prediction) -> np.ndarray:
    """Mean squared error of every joint's angle ``[joint]`` [rad^2]."""
    simulated = prediction.channels["joint", "position"][0].numpy()
    return np.square(simulated - prediction.log.array("joint/position")[: len(simulated)]).mean(0)


def _joints_figure(verdict: Verdict) -> go.Figure | None:
    """What every joint lacks before and after, on one scale."""
    parts = ("before", "after", "floor")
    bars = {part: {name: 1e3 * getattr(gap, part) for name, gap in verdict.joints.items()} for part in parts}
    return bars_figure(bars, "lacking torque [mN m]") if verdict.joints else None


def _where(joints: Sequence[str], shared: bool) -> str:
    return "all joints" if shared else " and ".join(joints)


def _tables(verdict: Verdict, split: LogSplit, content: Mapping[str, Any]) -> dict[str, TableRows]:
    """All tables of the page."""
    models = (verdict.base, verdict.model)
    tables: dict[str, TableRows] = {
        "findings": (
            ["effect", "joints", "parameter", "size", "probability", "or", "explains [%]", "in the model"],
            [
                [
                    one.effect, _where(one.joints, one.shared), one.parameter,
                    f"{span((one.size, *one.interval))} {one.unit}".removesuffix(" -"), one.probability,
                    "; ".join(f"{r.effect} in {_where(r.joints, r.shared)}, {r.probability:.2f}"
                              for r in one.alternatives),
                    100 * one.explains, one.in_model,
                ]
                for one in verdict.findings
            ],
        ),
        "ranking": (
            ["effect", "joints", "log odds"],
            [[e["effect"], _where(e["joints"], e["shared"]), e["log_odds"]] for e in verdict.ranking],
        ),
        "joints": (
            ["joint", "before [mN m]", "after [mN m]", "floor [mN m]", "unexplained [mN m]", "", "goes with"],
            [
                [
                    joint, *(1e3 * value for value in (gap.before, gap.after, gap.floor, gap.unexplained)),
                    "odd" if gap.flagged else "", ", ".join(f"{k} {s:.0%}" for k, s in gap.shape.items() if s > 0.1),
                ]
                for joint, gap in verdict.joints.items()
            ],
        ),
        "gap": (
            ["channel", "unit", "before", "after", "floor", ""],
            [
                [channel, v["unit"], *(_with_interval(v, end) for end in ("before", "after", "floor")), v["change"]]
                for channel, v in verdict.gap.items()
            ],
        ),
        "choice": _choice(verdict.choice),
        "checks": checks_table((*split.fit, *split.select, *split.show)),
        "motions": _motions(verdict, split),
        "returns": _returns(content.get("downstream", {})),
        "base": (
            ["parameter", "unit", "base", "handed back", ""],
            [
                [name, known.unit, *(m.value(name) if name in m.parameters() else None for m in models),
                 "at its bound" if _ended(verdict.base, known) else ""]
                for name, known in verdict.base.parameters().items()
            ],
        ),
        "chain": (
            ["number", "unit", "found", "usual", "spread"],
            [[one[key] for key in ("name", "unit", "found", "usual", "spread")] for one in verdict.chain],
        ),
    }  # fmt: skip
    for mount, told in content.get("other_mounts", {}).items():
        ends = ("unit", "before", "after", "floor")
        tables[f"on_{mount}"] = (["channel", *ends], [[key, *(v[e] for e in ends)] for key, v in told["gap"].items()])
    return tables


def _ended(model: RobotModel, known: Parameter) -> bool:
    """Whether the fit of a parameter ended where its range does, so that the logs did not give its value."""
    fitted = model.estimates.get(known.name)
    return fitted is not None and fitted.low is not None and at_bound(place_in_range(known, fitted.value))


def _with_interval(values: Mapping[str, Any], end: str) -> str | None:
    """A number and its interval."""
    return None if values[end] is None else span((values[end], *values[f"{end}_interval"]))


def _choice(choice: Mapping[str, Any]) -> TableRows:
    """What each number of effects leaves of withheld runs."""
    if len(choice.get("left", ())) < 2:
        return [], []
    rows = [
        [number, left, *channels.values(), "taken" if number == choice["taken"] else ""]
        for number, (left, channels) in enumerate(zip(choice["left"], choice["channels"], strict=True))
    ]
    return ["effects", "left of the base's squares", *choice["channels"][0], ""], rows


def _motions(verdict: Verdict, split: LogSplit) -> TableRows:
    """The gap in angle of a bench by motion and by firmware gain, where the runs differ in them."""
    rows: list[list[Any]] = []
    if verdict.shown and split.show[0].metadata.mount == "pendulum":
        for of in (lambda log: log.metadata.motion, lambda log: log.metadata.firmware_gain):
            errors: dict[Any, list[tuple[float, float]]] = {}
            for before, after in zip(verdict.shown["before"], verdict.shown["after"], strict=True):
                errors.setdefault(of(before.log), []).append((_errors(before).mean(), _errors(after).mean()))
            if len(errors) > 1:
                for kind, each in sorted(errors.items(), key=lambda item: str(item[0])):
                    rows.append([str(kind), len(each), *(1e3 * np.sqrt(np.mean(each, 0))).tolist()])
    return ["motion or gain", "runs", "before [mrad]", "after [mrad]"], rows


def _returns(returns: Mapping[str, Any]) -> TableRows:
    """What a policy returns under the two models, and on the robot."""
    rows = []
    for key, label in (("before", "base"), ("after", "with what was named"), ("actual", "the robot")):
        if value := returns.get(key):
            off = returns.get(f"error_{key}")
            rows.append([label, value["mean"], *(value["interval"] or (None, None)), 100 * value["fallen"], off])
    return ["model", "return", "from", "to", "falls [%]", "off the robot by"], rows
