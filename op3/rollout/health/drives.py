"""Checks of the current or duty against the servo's control law."""

from __future__ import annotations

import numpy as np

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import CURRENT
from op3.rollout.match import as_if, fitted
from op3.rollout.schema import CHANNELS

_ZERO = 0.1  # reported offset of a current sensor [A], or 2 % of its readings; sound logs have up to 0.03
_EXPLAINED = "two clocks, position against command, position without its command, torque lost, gains"


@check("current against position error", unless=_EXPLAINED)
def drive(view: View) -> Found:
    """Current or duty has the wrong sign, belongs to another joint, or has another unit than gain times error."""
    rows = view.driven.all(1) & (np.arange(len(view.time)) % (1 + len(view.time) // 20_000) == 0)  # enough rows
    for key, numbers, gain in view.drives if rows.sum() >= 20 else ():
        values, speed, error = numbers[rows], view.speed[rows], -view.error[rows]
        wanted = error if gain is None else error * gain[rows]
        share, factor, zero = _law(values, wanted, speed)
        share_of_sizes, grows, _ = _law(values, np.abs(wanted), speed * np.sign(wanted))
        asked, least, most = error.std(0) > 0.002, wanted.min(0), wanted.max(0)
        sure = np.where(asked, share, 0.0)
        both_ways = asked & (least < -0.3 * most)
        signless = both_ways & (values.min(0) >= 0) & (grows > 0) & (share_of_sizes > np.maximum(0.4, sure + 0.25))
        both_ways &= most > -0.3 * least
        if both_ways.sum() > 1 and signless.any() and (values.min(0) >= 0).all():
            signless = both_ways
        # at a limit, error and speed are correlated, and neither factor is meaningful
        against = ((values - values.mean(0)) * (wanted - wanted.mean(0))).mean(0) < 0
        away = (sure > 0.6) & (factor < 0) & against & ~signless
        # the supply or a limit may reduce large currents, so small currents are tested as well
        some = np.where(np.abs(wanted) >= 1e-3 * np.abs(wanted).max(0), 1.0, np.nan)
        small, its = (np.nanquantile(some * np.abs(table), 0.25, axis=0) for table in (values, wanted))
        typical = small / np.maximum(its, 1e-9)
        lowest, highest = np.fmin(factor, typical), np.fmax(factor, typical)
        known = (gain is not None) & (sure > 0.8) & ~away & ~signless
        clear = (sure > 0.94) & (not view.metadata.fallen)  # the limits differ while a robot falls
        off = known & np.where(clear, (lowest > 1.6) | (highest < 0.6), (lowest > 2.5) | (highest < 0.4))
        if off.sum() == 1 < known.sum() / 3:  # a unit applies to a channel: one deviating joint needs strong evidence
            off &= sure > 0.98
        # a sensor's zero: the mean remainder where the law explains nearly all of the current
        far = np.abs(zero) > np.maximum(_ZERO, 0.02 * np.abs(values).max(0))
        for joint in np.flatnonzero(known & clear & ~off & far & (key == CURRENT)):
            problem = f"current differs from gain times error by {zero[joint]:+.2g} A on average: its zero is off"
            if abs(zero[joint]) > 5 * _ZERO and gain is not None:  # too large for a sensor's offset
                problem += f", or the position is off by {zero[joint] / float(np.median(gain[rows, joint])):+.2g} rad"
            yield view.found((key, joint), problem, "write `columns: {...: {offset: ...}}` into the log's YAML")
        usual = float(np.median(factor[off])) if off.any() else 1.0
        readings = [("it", usual, CHANNELS[key].quantity.unit)]
        readings += [("the gain", 1 / usual if usual else 0.0, "A/rad")] if key == CURRENT else []
        cause = as_if(*readings, tolerance=0.12)
        if not cause and key == CURRENT and usual > 0:
            cause = f", as if p_gain were {1 / usual:.3g} times its value"
        for problem, wrong, remedy in (
            (f"{key[1]} was recorded without its sign", signless, "record it with its sign"),
            (f"{key[1]} drives the joint away from its target", away, "reverse its sign"),
            (f"{key[1]} is {usual:.3g} times gain times error{cause}", off, "check its unit and that of the gain"),
        ):
            # a fault that most assessable joints share belongs to the channel, not to a joint
            all_of_them = 2 * wrong.sum() > (sure > 0.5).sum() and wrong.sum() > 1
            for joint in np.flatnonzero(wrong | all_of_them) if wrong.any() else ():
                yield view.found((key, joint), problem, remedy, aside=True)
        weak = np.flatnonzero((sure < 0.6) & asked & (values.std(0) > 0)).tolist()
        fits = {joint: _law(values[:, [joint]], wanted, speed)[0] for joint in weak}
        whose = {joint: int(fit.argmax()) for joint, fit in fits.items() if 1 - fit.max() < 0.5 * (1 - sure[joint])}
        for joint, other in whose.items():  # exchanged joints; another check reports copies
            if fits[joint][other] > 0.5 and other in whose:
                problem = f"{key[1]} belongs to {view.joints[other]}"
                yield view.found((key, joint), problem, "swap the columns", aside=True)


def _law(values: np.ndarray, wanted: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, ...]:
    """Share of currents [row, joint] that a proportional and a damping term explain, the factor of the proportional
    term, and the mean remainder."""
    fits = []
    for value, want, rate in zip(np.broadcast_to(values, wanted.shape).T, wanted.T, speed.T, strict=True):
        weights = fitted(causes := np.column_stack([want, rate, np.ones(len(rate))]), value)
        share = 1 - (value - causes @ weights).var() / max(value.var(), 1e-24)
        fits.append((share, weights[0], weights[2]))
    return tuple(np.array(fits).T)
