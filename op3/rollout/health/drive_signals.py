"""Checks of the current or duty against what the servo's law asks for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import CURRENT, WARNING, LogFinding, View, check
from op3.rollout.schema import CHANNELS
from op3.rollout.units import likely_unit

_ZERO = 0.1
"""No current sensor is so far off at nothing [A], nor by 2 % of what it reads; 0.03 in sound logs of squats."""


@check(
    "current against position error",
    unless=("two clocks", "position against command", "position without its command", "gains"),
)
def drive(view: View) -> Iterator[LogFinding]:
    """Current or duty drives away from the target, is another joint's, or is in another unit than gain times error."""
    error, rows = view.command - view.position, np.array(view.driven.all(1))
    rows &= np.arange(len(view.time)) % (1 + len(view.time) // 20_000) == 0  # so many tell
    speed = np.gradient(view.position, view.time, axis=0) if len(view.time) > 1 else error
    for key, gain in ((CURRENT, view.get(("command", "p_gain"))), (("joint", "duty"), view.duty_gain)):
        values = view.get(key)
        if values is None or rows.sum() < 20:
            continue
        values, moved = values[rows], speed[rows]
        wanted = (error if gain is None else error * gain)[rows]
        asked = error[rows].std(0) > 0.002
        sure, factor, zero = _law(values, wanted, moved)
        sure_of_sizes, grows, _ = _law(values, np.abs(wanted), moved * np.sign(wanted))
        sure = np.where(asked, sure, 0.0)
        signless = (values.min(0) >= 0) & (wanted.min(0) < -0.3 * wanted.max(0)) & asked
        signless &= (grows > 0) & (sure_of_sizes > np.maximum(0.4, sure + 0.25))
        both = asked & (wanted.min(0) < -0.3 * wanted.max(0)) & (wanted.max(0) > -0.3 * wanted.min(0))
        if both.sum() > 1 and signless.any() and (values.min(0) >= 0).all():
            signless = both
        # where a limit decides, error and speed go together, and neither's factor means anything
        against = ((values - values.mean(0)) * (wanted - wanted.mean(0))).mean(0) < 0
        away = (sure > 0.6) & (factor < 0) & against & ~signless
        # where the supply or a limit decides, currents are less than was wanted: small ones are asked as well
        some = np.where(np.abs(wanted) >= 1e-3 * np.abs(wanted).max(0), 1.0, np.nan)
        small, its = (np.nanquantile(some * np.abs(one), 0.25, axis=0) for one in (values, wanted))
        typical = small / np.maximum(its, 1e-9)
        least, most = np.fmin(factor, typical), np.fmax(factor, typical)
        told = (gain is not None) & (sure > 0.8) & ~away & ~signless
        clear = (sure > 0.94) & (not view.metadata.fallen)  # arms that are flung about are limited otherwise
        off = told & np.where(clear, (least > 1.6) | (most < 0.6), (least > 2.5) | (most < 0.4))
        if off.sum() == 1 < told.sum() / 3:  # a unit is a channel's: one joint among many has to be very sure
            off &= sure > 0.98
        # a sensor's zero: what the law leaves on average, where it explains nearly all
        shifted = (
            told & clear & ~off & (np.abs(zero) > np.maximum(_ZERO, 0.02 * np.abs(values).max(0))) & (key == CURRENT)
        )
        for joint in np.flatnonzero(shifted):
            problem = f"current is {zero[joint]:+.2g} A off gain times error on average: its sensor has another zero"
            if abs(zero[joint]) > 5 * _ZERO and gain is not None:  # no sensor is so far off
                problem += f", or the position one of {zero[joint] / float(np.median(gain[:, joint])):+.2g} rad"
            yield view.found(WARNING, (key, joint), problem, "write `columns: {...: {offset: ...}}` into its YAML")
        usual = float(np.median(factor[off])) if off.any() else 1.0
        units = {"it": likely_unit(usual, CHANNELS[key].quantity.unit)}
        units["the gain"] = likely_unit(1 / usual if usual else 0.0, "A/rad") if key == CURRENT else None
        cause = next((f", as if {what} were in {unit}" for what, unit in units.items() if unit), "")
        if not cause and key == CURRENT and usual > 0:
            cause = f", as if p_gain were {1 / usual:.3g} times what it is"
        for problem, wrong, remedy in (
            (f"{key[1]} has lost its sign", signless, "record it with its sign"),
            (f"{key[1]} drives away from the target", away, "turn its sign round"),
            (
                f"{key[1]} is {usual:.3g} times gain times error{cause}",
                off,
                "look at its unit and the gain's",
            ),
        ):
            # what most joints show that show anything is the channel's, not a joint's
            all_of_them = 2 * wrong.sum() > (sure > 0.5).sum() and wrong.sum() > 1
            for joint in np.flatnonzero(wrong | all_of_them) if wrong.any() else ():
                yield view.found(WARNING, (key, joint), problem, remedy, aside=True)
        weak = [int(joint) for joint in np.flatnonzero((sure < 0.6) & asked & (values.std(0) > 0))]
        fits = {joint: _law(values[:, [joint]], wanted, moved)[0] for joint in weak}
        whose = {joint: int(fit.argmax()) for joint, fit in fits.items() if 1 - fit.max() < 0.5 * (1 - sure[joint])}
        for joint, other in whose.items():  # of those that were exchanged none is its own; copies are told elsewhere
            if fits[joint][other] > 0.5 and other in whose:
                problem = f"{key[1]} is that of {view.joints[other]}"
                yield view.found(WARNING, (key, joint), problem, "swap the columns back", aside=True)


def _law(values: np.ndarray, wanted: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of currents [row, joint] that a proportional and a damping term explain, the factor of the first, and what
    both leave on average."""
    v, w, s = (x - x.mean(0) for x in (values, wanted, speed))
    vw, vs, ws, ww, ss = ((x * y).mean(0) for x, y in ((v, w), (v, s), (w, s), (w, w), (s, s)))
    spread = np.maximum(ww * ss - ws * ws, 1e-24)
    factor, damping = (vw * ss - vs * ws) / spread, (vs * ww - vw * ws) / spread
    zero = values.mean(0) - factor * wanted.mean(0) - damping * speed.mean(0)
    return (factor * vw + damping * vs) / np.maximum((v * v).mean(0), 1e-24), factor, zero
