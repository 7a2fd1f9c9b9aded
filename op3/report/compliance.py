"""The page of how soft policies are: gains, joints, landings, pushes, pulls and heat, side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.compliance.compare import Difference
from op3.compliance.energy import Energy
from op3.compliance.gains import Gains
from op3.compliance.study import Measured
from op3.intervals import wilson_interval
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import band, bars_figure, colours, dress, shade, words
from op3.report.tables import Cell, TableRows
from op3.robot import load_robot
from op3.tasks.pushes import DIRECTIONS

MEANINGS = {
    "walk": "share of episodes that went on for the whole time without a fall, at least 1 m forward; speed [m/s]",
    "gain": "P gain of the controlled joints [A/rad], with 95 % intervals over episodes",
    "back_drive": "median over states of the gait, joints and directions: slope [N m/rad], break-away torque [N m]",
    "landing": "means within 50 ms after touchdown: force [N], acceleration [m/s^2]; speed [m/s], step height [m]",
    "push": "largest impulse survived [N s], with 95 % intervals; by direction: forwards, then to the left",
    "led": "displacement per slow force [m/N], and the force at which half have fallen [N]",
    "energy": "power [W], cost of transport [-], root mean square currents [A], temperature after an hour [C]",
    "difference": "the first policy minus another, with 95 % intervals: landings that are alike, bricks passed, pushes",
    "standing": "an hour of standing on a level board",
}


def report_compliance(
    measured: Sequence[Measured],
    differences: Mapping[str, Difference],
    standing: Mapping[str, Energy],
    run: RunFolder,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml`` and print the paths of both.

    Args:
        measured: the policies; the first one is the one in question.
        differences: of the first from others, by their label.
        standing: energy of an hour of standing, by label of who stands.
        run: where it is kept.

    Returns:
        The numbers of ``result.yaml``.
    """
    first, known = measured[0], {each.label: each.gains for each in measured if each.gains is not None}
    page = Page(f"Compliance: {first.label}", _verdict(first, differences))
    _tiles(page, first)
    figures = {
        "gains": _gain_figure(known) if known else None,
        "slope": _back_drive_figure(measured, "slope", "slope [N m/rad]"),
        "break_away": _back_drive_figure(measured, "break_away", "break-away torque [N m]"),
        "pushes": _push_figure(measured),
        "led": _led_figure(measured) if first.led else None,
        "heat": _heat_figure(measured, standing),
    }
    tables = {
        "walks": _walks(measured),
        "differences": _differences(differences),
        **(_gains(known) if known else {}),
        "landings": _landings(measured),
        "pushes": _pushes(measured),
        "energies": _energies(measured, standing),
    }
    page.fill("compliance", figures, tables, differences=differences, gains=next(iter(known), None), led=first.led)
    return publish(page, _numbers(measured, differences, standing), run, MEANINGS)


def _verdict(first: Measured, differences: Mapping[str, Difference]) -> str:
    if first.gains is None:
        head = f"{first.label} drives its servos in position mode."
    else:
        mean, (soft, low, high) = first.gains.mean[0], first.gains.softening
        said = "no other gain in support than in swing" if low <= 0 <= high else (
            f"{abs(soft):.2f} A/rad {'less' if soft < 0 else 'more'} in support than in swing"
        )  # fmt: skip
        head = f"{first.label} commands {mean:.2f} A/rad on average, and {said}."
    better = [f"{', '.join(d.better)} than {label}" for label, d in differences.items() if d.better]
    rest = f" With an interval that excludes no difference it has {'; '.join(better)}." if better else (
        " In landings, bricks and pushes no interval of the difference from another is wholly on its side."
        if differences else ""
    )  # fmt: skip
    return head + rest


def _tiles(page: Page, first: Measured) -> None:
    ground, flat = next(iter(first.passed.items()))
    page.tile("passed", f"{flat.successes} of {flat.episodes}", "", f"`{ground}`, at {flat.speed:.3f} m/s")
    if first.gains is not None:
        page.tile("mean gain", float(first.gains.mean[0]), "A/rad")
        _, low, high = first.gains.landing
        page.tile(
            "after touchdown", float(first.gains.landing[0]), "A/rad", f"against swing; 95 %: {low:.2f} to {high:.2f}"
        )
    page.tile("slope", float(np.nanmedian(first.back_drive.slope)), "N m/rad", "median of a joint that is turned")
    middle, low, high = first.survival.mean_largest
    page.tile("push", float(middle), "N s", f"largest survived, all directions; 95 %: {low:.2f} to {high:.2f}")
    page.tile(
        "hottest servo", float(first.energy.temperature.max()), "C", f"{words(first.energy.hottest)}, after an hour"
    )


def _walks(measured: Sequence[Measured]) -> TableRows:
    grounds = list(measured[0].passed)
    header = ["policy", *(text for ground in grounds for text in (ground, "95 %", "m/s"))]
    rows: list[list[Cell]] = []
    for each in measured:
        row: list[Cell] = [each.label]
        for passed in each.passed.values():
            low, high = wilson_interval(passed.successes, passed.episodes)
            row += [f"{passed.successes} of {passed.episodes}", f"{low:.2f} to {high:.2f}", round(passed.speed, 3)]
        rows.append(row)
    return header, rows


def _said(triple: Any, digits: int = 2) -> str | None:
    """A value with its interval."""
    if triple is None or not np.isfinite(triple[0]):
        return None
    value, low, high = (f"{number:.{digits}f}".replace("-", "−") for number in triple)
    return f"{value} ({low} to {high})" if np.isfinite(triple[1]) else value


def _differences(differences: Mapping[str, Difference]) -> TableRows:
    rows: list[list[Cell]] = [
        [
            label,
            _said(d.landing.force, 1),
            _said(d.landing.acceleration, 1),
            d.landing.pairs,
            _said(d.bricks),
            _said(d.push),
        ]
        for label, d in differences.items()
    ]
    header = ["first policy minus", "peak force [N]", "peak acceleration [m/s²]", "pairs", "share passed", "push [N s]"]
    return header, rows


def _gains(known: Mapping[str, Gains]) -> dict[str, tuple]:
    """Gains of the first policy by joint, and of all by situation."""
    gains, names = next(iter(known.values())), ("support", "swing", "landed", "support_clock", "swing_clock")
    rows: list[list[Cell]] = []
    for row, joint in enumerate(load_robot().controlled):
        stiff = [float(gains.by_situation[n][row, 0] * gains.stiffness[row]) for n in ("support", "swing")]
        rows.append([words(joint), *(_said(gains.by_situation[name][row]) for name in names), *stiff])
    header = ["joint", "support", "swing", "100 ms after touchdown", "support by the clock", "swing by the clock"]
    header += ["stiffness in support [N m/rad]", "in swing"]
    columns = ["policy", "all", "support minus swing", "100 ms after touchdown minus swing"]
    softening = [[name, _said(g.mean), _said(g.softening), _said(g.landing)] for name, g in known.items()]
    return {"gains": (header, rows, 3), "softening": (columns, softening)}


def _gain_figure(known: Mapping[str, Gains]) -> go.Figure:
    joints = load_robot().controlled
    half_way = len(joints) // 2
    pairs = [joint for side in zip(joints[:half_way], joints[half_way:], strict=True) for joint in side]
    figure = make_subplots(
        rows=5, cols=2, shared_xaxes=True, shared_yaxes=True, vertical_spacing=0.035, horizontal_spacing=0.04,
        subplot_titles=[words(joint) for joint in pairs],
    )  # fmt: skip
    looks, first = colours(list(known)), next(iter(known.values()))
    for number, joint in enumerate(pairs):
        place: Any = dict(row=number // 2 + 1, col=number % 2 + 1)
        row = load_robot().controlled.index(joint)
        for label, gains in known.items():
            low, high = gains.profile_interval[row].T
            band(figure, gains.phase, low, high, looks[label], legendgroup=label, **place)
            figure.add_scatter(
                x=gains.phase, y=gains.profile[row], name=label, legendgroup=label, showlegend=not number, mode="lines",
                line=dict(color=looks[label], width=1.8), **place,
            )  # fmt: skip
        shade(figure, first.phase[first.loaded[row] > 0.5], len(first.phase), **place)
    figure.update_xaxes(range=[0, 1])
    figure.update_xaxes(title_text="phase of the gait [cycles]", row=5)
    highest = max(float(np.nanmax(gains.profile_interval)) for gains in known.values())
    figure.update_yaxes(range=[0, 1.05 * highest])
    figure.update_yaxes(title_text="P gain [A/rad]", col=1)
    return dress(figure, 980)


def _back_drive_figure(measured: Sequence[Measured], name: str, axis: str) -> go.Figure:
    bars = {}
    for each in measured:
        middle = np.nanmedian(getattr(each.back_drive, name), (0, 2))
        bars[each.label] = dict(zip(load_robot().controlled, middle.tolist(), strict=True))
    return bars_figure(bars, axis)


def _landings(measured: Sequence[Measured]) -> TableRows:
    header = ["policy", "touchdowns", "peak force [N]", "peak acceleration [m/s²]", "speed [m/s]", "step height [mm]"]
    rows: list[list[Cell]] = []
    for each in measured:
        landings = each.landings
        known = [float(v.mean()) if len(v) else None for v in (landings.force, landings.acceleration, landings.speed)]
        height = float(1000 * landings.height.mean()) if len(landings.height) else None
        rows.append([each.label, len(landings.force), *known, height])
    return header, rows


def _push_figure(measured: Sequence[Measured]) -> go.Figure:
    figure = go.Figure()
    angle = [360 / DIRECTIONS * i for i in range(DIRECTIONS)]
    for each, colour in zip(measured, colours([m.label for m in measured]).values(), strict=True):
        radius = each.survival.largest[:, 0]
        figure.add_scatterpolar(
            r=[*radius, radius[0]], theta=[*angle, 0], name=each.label, line=dict(color=colour, width=2)
        )
    around = dict(
        rotation=90, tickvals=[0, 90, 180, 270], ticktext=["forwards", "to the left", "backwards", "to the right"]
    )
    return dress(figure, 460, polar=dict(angularaxis=around, radialaxis=dict(rangemode="tozero", title="N s")))


def _pushes(measured: Sequence[Measured]) -> TableRows:
    header = ["policy", "pushes", "all [N s]", "forwards", "to the left", "backwards", "to the right"]
    rows: list[list[Cell]] = []
    for each in measured:
        by_direction = [_said(each.survival.largest[i]) for i in range(0, DIRECTIONS, DIRECTIONS // 4)]
        rows.append([each.label, each.survival.survived.size, _said(each.survival.mean_largest), *by_direction])
    return header, rows


def _led_figure(measured: Sequence[Measured]) -> go.Figure:
    ways = list(measured[0].led)
    figure = make_subplots(rows=2, cols=3, subplot_titles=ways, vertical_spacing=0.16, horizontal_spacing=0.08)
    for number, way in enumerate(ways):
        place = dict(row=number // 3 + 1, col=number % 3 + 1)
        for each, colour in zip(measured, colours([m.label for m in measured]).values(), strict=True):
            led = each.led[way]
            middle, low, high = 100 * led.displacement.T
            spread = dict(type="data", symmetric=False, array=high - middle, arrayminus=middle - low)
            figure.add_scatter(
                x=led.force, y=middle, error_y=spread, name=each.label, legendgroup=each.label, showlegend=not number,
                line=dict(color=colour), **place,
            )  # fmt: skip
    figure.update_xaxes(title_text="force [N]", row=2)
    figure.update_yaxes(title_text="displacement [cm]", col=1)
    return dress(figure, 560)


def _energies(measured: Sequence[Measured], standing: Mapping[str, Energy]) -> TableRows:
    header = ["who", "power [W]", "cost of transport", "hottest servo", "its current [A]", "after an hour [C]", "drift"]
    known = {each.label: each.energy for each in measured} | {f"{name}, standing": e for name, e in standing.items()}
    rows: list[list[Cell]] = []
    for label, energy in known.items():
        hottest = load_robot().joints.index(energy.hottest)
        current, temperature = (float(values[hottest]) for values in (energy.current, energy.temperature))
        row = [label, _said(energy.power), _said(energy.cost_of_transport), words(energy.hottest)]
        rows.append([*row, current, temperature, energy.drift])
    return header, rows


def _heat_figure(measured: Sequence[Measured], standing: Mapping[str, Energy]) -> go.Figure:
    known = {each.label: each.energy for each in measured} | {f"{name}, standing": e for name, e in standing.items()}
    bars = {
        label: dict(zip(load_robot().joints, energy.current.tolist(), strict=True)) for label, energy in known.items()
    }
    figure = bars_figure(bars, "current [A]")
    return figure.add_hline(y=measured[0].energy.continuous, line=dict(dash="dot", width=1), annotation_text="for ever")


def _numbers(
    measured: Sequence[Measured], differences: Mapping[str, Difference], standing: Mapping[str, Energy]
) -> dict[str, Any]:
    """Numbers for ``result.yaml``, by kind and then by label."""
    found: dict[str, Any] = {}
    for each in measured:
        label = _key(each.label)
        for ground, passed in each.passed.items():
            interval = list(wilson_interval(passed.successes, passed.episodes))
            share = {"success": passed.successes / passed.episodes, "success_interval": interval}
            found[f"walk.{label}.{ground}"] = {**share, "episodes": passed.episodes, "speed": passed.speed}
        if each.gains is not None:
            gains, names = each.gains, load_robot().controlled
            found[f"gain.{label}"] = {
                "mean": _finite(gains.mean), "support_minus_swing": _finite(gains.softening),
                "landed_minus_swing": _finite(gains.landing),
                **{k: dict(zip(names, map(_finite, v), strict=True)) for k, v in gains.by_situation.items()},
            }  # fmt: skip
        slope, break_away = each.back_drive.slope, each.back_drive.break_away
        by_joint = {
            joint: {"slope": _median(slope[:, i]), "break_away": _median(break_away[:, i])}
            for i, joint in enumerate(load_robot().controlled)
        }
        found[f"back_drive.{label}"] = {"slope": _median(slope), "break_away": _median(break_away), **by_joint}
        found[f"landing.{label}"] = {
            "touchdowns": len(each.landings.force),
            **{name: _mean(getattr(each.landings, name)) for name in ("force", "acceleration", "speed", "height")},
        }
        by_direction = [_finite(row) for row in each.survival.largest]
        found[f"push.{label}"] = {"largest": _finite(each.survival.mean_largest), "by_direction": by_direction}
        for way, led in each.led.items():
            found[f"led.{label}.{_key(way)}"] = {"metre_per_newton": led.follows, "fall_force": led.fall_force}
        found[f"energy.{label}"] = _energy_numbers(each.energy)
    for label, energy in standing.items():
        found[f"standing.{_key(label)}"] = _energy_numbers(energy)
    for label, d in differences.items():
        pairs = {
            "pairs": d.landing.pairs,
            "force": _finite(d.landing.force),
            "acceleration": _finite(d.landing.acceleration),
        }
        found[f"difference.{_key(label)}"] = {**pairs, "bricks": _finite(d.bricks), "push": _finite(d.push)}
    return found


def _energy_numbers(energy: Energy) -> dict[str, Any]:
    return {
        "power": _finite(energy.power),
        "cost_of_transport": _finite(energy.cost_of_transport),
        "current": dict(zip(load_robot().joints, energy.current.tolist(), strict=True)),
        "temperature": dict(zip(load_robot().joints, energy.temperature.tolist(), strict=True)),
        "drift": energy.drift,
    }


def _key(label: str) -> str:
    return label.replace(".", "_").replace(",", "").replace(" ", "_").replace("/", "_per_")


def _finite(values: Any) -> list[float | None] | None:
    """Numbers with None for those that are not known."""
    return None if values is None else [float(v) if np.isfinite(v) else None for v in values]


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None
