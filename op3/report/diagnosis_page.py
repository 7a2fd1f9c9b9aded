"""The page of a diagnosis: errors before and after, findings, every joint, and reliability of the baseline fit."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.diagnose import LogSplit, Verdict
from op3.diagnose.window_gaps import CHANNELS, STAGES, StageGap, WindowGaps
from op3.identify.intervals import at_bound
from op3.replay import Prediction
from op3.report.page import Page
from op3.report.panels import Panel, panels_figure
from op3.report.result import RunFolder, publish
from op3.report.style import MUTED, PALETTE, bars_figure
from op3.report.tables import TableRows, in_thousandths, place_in_range, span
from op3.report.trace_figures import checks_table, traces_figure
from op3.report.tracks import SHOWN, predicted
from op3.servo import Parameter, RobotModel, effect_class

SHOWN_STAGES = {"given model": "given", "baseline fit": "before", "returned model": "after"}
"""Names of the stages on the page, and in a verdict."""

COLOURS = dict(zip((*SHOWN_STAGES, "repeats"), (PALETTE[3], PALETTE[1], PALETTE[0], MUTED), strict=True))
"""Colours of the stages in every figure."""


def report_diagnosis(verdict: Verdict, split: LogSplit, content: Mapping[str, Any], run: RunFolder) -> dict[str, Any]:
    """Publish a diagnosis of logs, and store the data for `op3 view`; `content` is the content of ``verdict.yaml``."""
    found, elsewhere = content["findings"], content.get("other_mounts", {})
    values: dict[str, Any] = {
        "verdict": content["verdict"],
        "sentence": content["sentence"],
        "findings": ", ".join(f"{one['effect']} in {', '.join(one['joints'])}" for one in found),
        "probability": max((one["probability"] for one in found), default=None),
        **_flat("", content),
        **_windows(content),
        **{key: value for mount, told in elsewhere.items() for key, value in _flat(f"{mount}.", told).items()},
    }
    figures, joint = {}, ""
    if (worst := _worst(verdict)) is not None:
        before, after = worst["baseline fit"], worst["returned model"]
        for name, log in {"measured": before.log, "before": predicted(before), "after": predicted(after)}.items():
            log.save(run.path / SHOWN / name, overwrite=True)
        joint = before.log.joints[int(_errors(before).argmax())]
        if after is before:
            del worst["returned model"]
        figures = {
            "traces": _coloured(traces_figure(before.log, worst, [joint])),
            "residuals": _coloured(_residuals_figure(worst, joint)),
        }
    if verdict.windows is not None:
        figures["joints"] = _coloured(_joints_figure(verdict.windows))
    page = Page.of(
        "diagnosis", figures, _tables(verdict, split, content), verdict=verdict, content=content, folder=run.path,
        joint=joint, effect=effect_class, where=_where, robot=split.fit[0].robot,
    )  # fmt: skip
    return publish(page, values, run)


def _flat(prefix: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Gap and loss, flattened to one name per number."""
    ends = ("before", "after", "floor", "closure")
    gap = {f"{prefix}gap.{key}.{end}": entry.get(end) for key, entry in content["gap"].items() for end in ends}
    return gap | {f"{prefix}loss.paper_eq7.{end}": content["loss"][end] for end in ends[:2] if content["loss"]}


def _windows(content: Mapping[str, Any]) -> dict[str, Any]:
    """Errors in windows of held-out runs, flattened to one name per number."""
    windows = content.get("windows") or {"whole": {}, "joints": {}, "horizons": {}}
    parts = {"windows": windows["whole"], "horizons": windows["horizons"]}
    parts |= {f"windows.{joint}": channels for joint, channels in windows["joints"].items()}
    ends = (*STAGES, "floor")
    return {f"{at}.{name}.{end}": one[end] for at, of in parts.items() for name, one in of.items() for end in ends}


def _worst(verdict: Verdict) -> dict[str, Any] | None:
    """Predictions of the three models for the run that the baseline predicts worst; None if no simulation finished."""
    shown = {label: verdict.shown.get(key) or () for label, key in SHOWN_STAGES.items()}
    shown = {label: predictions for label, predictions in shown.items() if predictions}
    runs = [dict(zip(shown, run, strict=True)) for run in zip(*shown.values(), strict=True)]
    whole = [run for run in runs if not any(one.failed.any() for one in run.values())]
    return max(whole, key=lambda run: float(_errors(run["baseline fit"]).mean()), default=None)


def _errors(prediction: Prediction) -> np.ndarray:
    """Mean squared error of every joint's angle ``[joint]`` [rad^2]."""
    simulated = prediction.channels["joint", "position"][0].numpy()
    return np.square(simulated - prediction.log.array("joint/position")[: len(simulated)]).mean(0)


def _joints_figure(windows: WindowGaps) -> go.Figure:
    """The angle error of every joint under the three models, on one scale."""
    bars = {
        label: {joint: 1e3 * getattr(of["position"], stage) for joint, of in windows.joints.items()}
        for label, stage in zip(SHOWN_STAGES, STAGES, strict=True)
    }
    floors = {joint: of["position"].floor for joint, of in windows.joints.items()}
    if all(floor is not None for floor in floors.values()):
        bars["repeats"] = {joint: 1e3 * (floor or 0.0) for joint, floor in floors.items()}
    return bars_figure(bars, f"angle error in windows of {windows.length:.2g} s, RMS [mrad]")


def _residuals_figure(predictions: Mapping[str, Prediction], joint: str) -> go.Figure:
    """Simulated minus measured angle and current of a joint."""
    grid = []
    for key, unit, scale in ((("joint", "position"), "mrad", 1e3), (("joint", "current"), "A", 1.0)):
        lines = []
        for label, one in predictions.items():
            if key in one.channels and key in one.log:
                column = one.log.joints.index(joint)
                simulated = one.channels[key][0].numpy()[:, column]
                left = simulated - one.log.array(key)[: len(simulated), column]
                time = one.log.array("time")[: len(left), 0]
                lines.append((label, time - time[0], scale * left))
        if lines:
            grid.append(Panel(f"{key[1]} [{unit}]", lines))
    return panels_figure([grid])


def _coloured(figure: go.Figure) -> go.Figure:
    """A figure in which every model has the same colour as in all other figures."""

    def colour(trace: Any) -> None:
        if trace.name in COLOURS:
            trace.update({"marker": {"color": COLOURS[trace.name]}})
            if trace.type == "scatter":
                trace.update({"line": {"color": COLOURS[trace.name]}})

    return figure.for_each_trace(colour)


def _where(joints: Sequence[str], shared: bool) -> str:
    return "all joints" if shared else " and ".join(map(words, joints))


def _tables(verdict: Verdict, split: LogSplit, content: Mapping[str, Any]) -> dict[str, TableRows]:
    """All tables of the page."""
    models, usual = (verdict.base, verdict.model), {one["name"]: one["usual"] for one in verdict.chain}
    tables: dict[str, TableRows] = {
        "findings": (
            [
                "effect", "joints", "parameter", "size", "probability", "gain [SE]", "torque [mN m]", "load [%]",
                "alternatives",
            ],
            [
                [
                    words(one.effect), _where(one.joints, one.shared), words(one.parameter),
                    f"{span((one.size, *one.interval))} {one.unit}".removesuffix(" -")
                    + (", end of the searched range" if one.beyond else ""),
                    one.probability, one.gain.z, 1e3 * max(one.torque.values(), default=0.0), 100 * one.load,
                    "; ".join(f"{words(r.effect)} in {_where(r.joints, r.shared)}, {r.probability:.2f}"
                              for r in one.alternatives),
                ]
                for one in verdict.findings
            ],
        ),
        "ranking": (
            ["effect", "joints", "log odds"],
            [[words(e["effect"]), _where(e["joints"], e["shared"]), e["log_odds"]] for e in verdict.ranking],
        ),
        "joints": (
            ["joint", "baseline fit", "returned model", "resolution", "unexplained", "", "depends on"],
            [
                [
                    words(joint), *(1e3 * value for value in (gap.before, gap.after, gap.floor, gap.unexplained)),
                    "too much" if gap.flagged else "",
                    ", ".join(f"{k} {s:.0%}" for k, s in gap.shape.items() if s > 0.1),
                ]
                for joint, gap in verdict.joints.items()
            ],
        ),
        "gap": (
            ["channel", "unit", "given model", "baseline fit", "returned model", "repeats", "change"],
            [
                [channel.split("/")[1], *in_thousandths(v.get("given"), v["unit"])[::-1],
                 *(_with_interval(v, end) for end in ("before", "after", "floor")),
                 {"alike": "none beyond chance"}.get(v["change"], v["change"])]
                for channel, v in verdict.gap.items()
            ],
        ),
        **_window_tables(verdict.windows),
        "not_shown": (
            ["effect", "joints"],
            [[words(name), ", ".join(map(words, joints)) or "all"] for name, joints in verdict.not_shown.items()],
        ),
        "checks": checks_table((*split.fit, *split.show)),
        "motions": _motions(verdict, split),
        "returns": _returns(content.get("downstream", {})),
        "base": (
            ["parameter", "unit", "usual", "baseline fit", "returned model", ""],
            [
                [words(name), known.unit, usual.get(name),
                 *(m.value(name) if name in m.parameters() else None for m in models),
                 "at its bound" if _ended(verdict.base, known) else ""]
                for name, known in verdict.base.parameters().items()
            ],
        ),
    }  # fmt: skip
    for mount, told in content.get("other_mounts", {}).items():
        header = ["channel", "unit", "baseline fit", "returned model", "repeats"]
        ends = ("unit", "before", "after", "floor")
        tables[f"on_{mount}"] = (header, [[key.split("/")[1], *(v[e] for e in ends)] for key, v in told["gap"].items()])
    return tables


def _ended(model: RobotModel, known: Parameter) -> bool:
    """Whether the fit of a parameter ended at a bound, so that the logs do not determine its value."""
    fitted = model.estimates.get(known.name)
    return fitted is not None and fitted.low is not None and at_bound(place_in_range(known, fitted.value))


def _with_interval(values: Mapping[str, Any], end: str) -> str | None:
    """A number and its interval."""
    numbers = [] if values[end] is None else [values[end], *values[f"{end}_interval"]]
    return span([in_thousandths(value, values["unit"])[0] for value in numbers]) if numbers else None


def _window_tables(windows: WindowGaps | None) -> dict[str, TableRows]:
    """Errors in windows, by joint, over all joints, and by horizon."""
    if windows is None:
        return {}
    shares = ["given model [%]", "returned model [%]"]

    def row(one: StageGap, scale: float) -> list[Any]:
        floor = None if one.floor is None else scale * one.floor
        errors = [scale * getattr(one, stage) for stage in STAGES]
        return [*errors, floor, one.percent["given"], one.percent["returned"]]

    rows = [
        [words(joint), name, in_thousandths(None, CHANNELS[name])[1], *row(of[name], 1e3)]
        for joint, of in (
            ({"all joints": windows.whole} if len(windows.joints) > 1 else {}) | dict(windows.joints)
        ).items()
        for name in CHANNELS
        if name in of
    ]
    horizons = [[f"{length:g}", *row(one, 1e3)] for length, one in windows.horizons.items()]
    return {
        "windows": (["joint", "channel", "unit", *SHOWN_STAGES, "repeats (torque: resolution)", *shares], rows),
        "horizons": (["horizon [s]", *(f"{end} [mrad]" for end in (*SHOWN_STAGES, "repeats")), *shares], horizons),
    }


def _motions(verdict: Verdict, split: LogSplit) -> TableRows:
    """The angle gap of a bench by motion and by firmware gain, if the runs differ in these."""
    rows: list[list[Any]] = []
    if verdict.shown and split.show[0].metadata.mount == "pendulum":
        for of in (lambda log: log.metadata.motion, lambda log: log.metadata.firmware_gain):
            errors: dict[Any, list[tuple[float, float]]] = {}
            for before, after in zip(verdict.shown["before"], verdict.shown["after"], strict=True):
                errors.setdefault(of(before.log), []).append((_errors(before).mean(), _errors(after).mean()))
            if len(errors) > 1:
                for kind, each in sorted(errors.items(), key=lambda item: str(item[0])):
                    rows.append([str(kind), len(each), *(1e3 * np.sqrt(np.mean(each, 0))).tolist()])
    return ["motion or gain", "runs", "baseline fit [mrad]", "returned model [mrad]"], rows


def _returns(returns: Mapping[str, Any]) -> TableRows:
    """Returns of a policy under the two models, and on the robot."""
    rows = []
    for key, label in (("before", "baseline fit"), ("after", "returned model"), ("actual", "the robot")):
        if value := returns.get(key):
            off = returns.get(f"error_{key}")
            rows.append([label, value["mean"], *(value["interval"] or (None, None)), 100 * value["fallen"], off])
    return ["model", "return", "from", "to", "falls [%]", "difference from the robot"], rows
