"""The page on the compliance of policies: gains, joints, landings, pushes, guidance by hand and heat, side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.compliance.compare import Difference
from op3.compliance.compliance_study import Measured
from op3.compliance.energy import Energy
from op3.compliance.gains import Gains
from op3.report.page import Page
from op3.report.result import RunFolder, finite, publish
from op3.report.style import GRID, bars_figure, colours, dress, grid_figure, shade
from op3.report.tables import TableRows, span
from op3.tasks.pushes import DIRECTIONS

LANDING = ("force", "acceleration", "speed", "height")


def report_compliance(
    measured: Sequence[Measured], differences: Mapping[str, Difference], standing: Mapping[str, Energy], run: RunFolder
) -> dict[str, Any]:
    """Publish measurements of policies and compare the first policy with the others; `standing` is for an hour."""
    first, known = measured[0], {each.label: each.gains for each in measured if each.gains is not None}
    energies = {each.label: each.energy for each in measured} | {f"{n}, standing": e for n, e in standing.items()}
    currents = {label: dict(zip(e.joints, e.current.tolist(), strict=True)) for label, e in energies.items()}
    limit: dict[str, Any] = dict(
        y=first.energy.continuous, line=dict(dash="dot", width=1), annotation_text="continuous rating"
    )
    figures = {
        **({"gains": _gain_figure(known)} if known else {}),
        "slope": _back_drive_figure(measured, "slope", "slope [N m/rad]"),
        "break_away": _back_drive_figure(measured, "break_away", "break-away torque [N m]"),
        "pushes": _push_figure(measured),
        "led": _led_figure(measured) if first.led else None,
        "heat": bars_figure(currents, "current [A]").add_hline(**limit),
    }
    tables = _tables(measured, differences, energies) | (_gain_tables(known) if known else {})
    page = Page.of(
        "compliance", figures, tables, first=first, differences=differences, with_gains=next(iter(known), None),
        better=[f"{', '.join(d.better)} than `{label}`" for label, d in differences.items() if d.better],
    )  # fmt: skip
    values = {name: {_key(each.label): of(each) for each in measured} for name, of in NUMBERS.items()}
    values["gain"] = {_key(label): _gain_numbers(gains) for label, gains in known.items()}
    values["standing"] = {_key(label): _energy_numbers(energy) for label, energy in standing.items()}
    values["difference"] = {_key(label): _difference_numbers(d) for label, d in differences.items()}
    return publish(page, values, run)


def _tables(
    measured: Sequence[Measured], differences: Mapping[str, Difference], energies: Mapping[str, Energy]
) -> dict[str, TableRows]:
    quarters = range(0, DIRECTIONS, DIRECTIONS // 4)
    joints = next(iter(energies.values())).joints
    return {
        "walks": (
            ["policy", *(text for ground in measured[0].passed for text in (words(ground), "95 %", "m/s"))],
            [[each.label, *(cell for passed in each.passed.values() for cell in _walk(passed))] for each in measured],
        ),
        "differences": (
            ["first policy minus", "peak force [N]", "peak acceleration [m/s²]", "pairs", "share passed", "push [N s]"],
            [
                [label, span(d.landing.force), span(d.landing.acceleration), d.landing.pairs, span(d.bricks),
                 span(d.push)]
                for label, d in differences.items()
            ],
        ),
        "landings": (
            ["policy", "touchdowns", "peak force [N]", "peak acceleration [m/s²]", "speed [m/s]", "step height [m]"],
            [[each.label, len(each.landings.force), *_landing_numbers(each).values()] for each in measured],
        ),
        "pushes": (
            ["policy", "pushes", "all [N s]", "forwards", "to the left", "backwards", "to the right"],
            [
                [m.label, m.survival.survived.size, span(m.survival.mean_largest),
                 *(span(m.survival.largest[i]) for i in quarters)]
                for m in measured
            ],
        ),
        "energies": (
            ["walk or stand", "power [W]", "cost of transport", "hottest servo", "current [A]", "in 1 h [C]", "drift"],
            [
                [label, span(e.power), span(e.cost_of_transport), words(e.hottest),
                 *(float(values[joints.index(e.hottest)]) for values in (e.current, e.temperature)), e.drift]
                for label, e in energies.items()
            ],
        ),
    }  # fmt: skip


def _walk(passed: Any) -> tuple[str, str, float]:
    low, high = passed.interval
    return f"{passed.successes} of {passed.episodes}", f"{low:.2f} to {high:.2f}", round(passed.speed, 3)


def _gain_tables(known: Mapping[str, Gains]) -> dict[str, TableRows]:
    """Gains of the first policy by joint, and of all policies by situation."""
    gains, rows = next(iter(known.values())), []
    for row, joint in enumerate(gains.joints):
        stiff = [float(gains.by_situation[n][row, 0] * gains.stiffness[row]) for n in ("support", "swing")]
        rows.append([words(joint), *(span(values[row]) for values in gains.by_situation.values()), *stiff])
    header = ["joint", "support", "swing", "100 ms after touchdown", "support by gait phase", "swing by gait phase"]
    columns = ["policy", "all", "support minus swing", "100 ms after touchdown minus swing"]
    softening = [[name, span(g.mean), span(g.softening), span(g.landing)] for name, g in known.items()]
    stiffness = ["stiffness in support [N m/rad]", "in swing"]
    return {"gains": ([*header, *stiffness], rows), "softening": (columns, softening)}


def _gain_figure(known: Mapping[str, Gains]) -> go.Figure:
    first = next(iter(known.values()))
    joints = first.joints
    half_way = len(joints) // 2
    pairs = [joint for side in zip(joints[:half_way], joints[half_way:], strict=True) for joint in side]
    panels = {
        words(joint): {label: (g.phase, g.profile[row], *g.profile_interval[row].T) for label, g in known.items()}
        for joint in pairs for row in (joints.index(joint),)
    }  # fmt: skip
    figure = grid_figure(panels, "phase of the gait [cycles]", 980, columns=2, y="P gain [A/rad]")
    for number, joint in enumerate(pairs):
        standing = first.phase[first.loaded[joints.index(joint)] > 0.5]
        shade(figure, standing, len(first.phase), row=number // 2 + 1, col=number % 2 + 1)
    highest = max(float(np.nanmax(gains.profile_interval)) for gains in known.values())
    return figure.update_xaxes(range=[0, 1]).update_yaxes(range=[0, 1.05 * highest])


def _back_drive_figure(measured: Sequence[Measured], name: str, axis: str) -> go.Figure:
    joints = measured[0].back_drive.joints
    middle = {each.label: np.nanmedian(getattr(each.back_drive, name), (0, 2)).tolist() for each in measured}
    return bars_figure({label: dict(zip(joints, values, strict=True)) for label, values in middle.items()}, axis)


def _push_figure(measured: Sequence[Measured]) -> go.Figure:
    figure = go.Figure()
    angle = [360 / DIRECTIONS * i for i in range(DIRECTIONS)]
    for each, colour in zip(measured, colours([m.label for m in measured]).values(), strict=True):
        radius, line = each.survival.largest[:, 0], dict(color=colour, width=2)
        figure.add_scatterpolar(r=[*radius, radius[0]], theta=[*angle, 0], name=each.label, line=line)
    named = {0: "forwards", 90: "to the left", 180: "backwards", 270: "to the right"}
    radial = dict(rangemode="tozero", title="N s", gridcolor=GRID)
    around = dict(rotation=90, gridcolor=GRID, tickvals=list(named), ticktext=list(named.values()))
    return dress(figure, 460, polar=dict(angularaxis=around, bgcolor="rgba(0,0,0,0)", radialaxis=radial))


def _led_figure(measured: Sequence[Measured]) -> go.Figure:
    panels = {
        way: {each.label: (each.led[way].force, *(100 * each.led[way].displacement).T) for each in measured}
        for way in measured[0].led
    }
    return grid_figure(panels, "force [N]", 560, columns=3, mode="lines+markers", y="displacement [cm]")


def _key(label: str) -> str:
    return label.replace(".", "_").replace(",", "").replace(" ", "_").replace("/", "_per_")


def _finite(values: Any) -> list[float | None] | None:
    """Numbers, with None for unknown values."""
    return None if values is None else [finite(value) for value in values]


def _median(values: np.ndarray) -> float | None:
    return finite(np.nanmedian(values)) if np.isfinite(values).any() else None


def _walk_numbers(each: Measured) -> dict[str, Any]:
    return {
        ground: {
            "success": passed.successes / passed.episodes,
            "success_interval": list(passed.interval),
            "episodes": passed.episodes,
            "speed": passed.speed,
        }
        for ground, passed in each.passed.items()
    }


def _gain_numbers(gains: Gains) -> dict[str, Any]:
    return {
        "mean": _finite(gains.mean),
        "support_minus_swing": _finite(gains.softening),
        "landed_minus_swing": _finite(gains.landing),
        **{k: dict(zip(gains.joints, map(_finite, v), strict=True)) for k, v in gains.by_situation.items()},
    }


def _back_drive_numbers(each: Measured) -> dict[str, Any]:
    found = {name: getattr(each.back_drive, name) for name in ("slope", "break_away")}
    by_joint = {
        joint: {name: _median(values[:, i]) for name, values in found.items()}
        for i, joint in enumerate(each.back_drive.joints)
    }
    return {**{name: _median(values) for name, values in found.items()}, **by_joint}


def _landing_numbers(each: Measured) -> dict[str, float | None]:
    found = {name: getattr(each.landings, name) for name in LANDING}
    return {name: float(values.mean()) if len(values) else None for name, values in found.items()}


def _energy_numbers(energy: Energy) -> dict[str, Any]:
    by_joint = {name: getattr(energy, name).tolist() for name in ("current", "temperature")}
    return {
        "power": _finite(energy.power),
        "cost_of_transport": _finite(energy.cost_of_transport),
        **{name: dict(zip(energy.joints, values, strict=True)) for name, values in by_joint.items()},
        "drift": energy.drift,
    }


def _difference_numbers(d: Difference) -> dict[str, Any]:
    landing = {name: _finite(getattr(d.landing, name)) for name in ("force", "acceleration")}
    return {"pairs": d.landing.pairs, **landing, "bricks": _finite(d.bricks), "push": _finite(d.push)}


NUMBERS = {
    "walk": _walk_numbers,
    "back_drive": _back_drive_numbers,
    "landing": lambda each: {"touchdowns": len(each.landings.force), **_landing_numbers(each)},
    "push": lambda each: {
        "largest": _finite(each.survival.mean_largest),
        "by_direction": [_finite(row) for row in each.survival.largest],
    },
    "led": lambda each: {
        _key(way): {"metre_per_newton": led.follows, "fall_force": led.fall_force} for way, led in each.led.items()
    },
    "energy": lambda each: _energy_numbers(each.energy),
}
"""Entries of ``result.yaml`` for each policy, by kind."""
