"""Checks of angles: turns, jumps, zeros and steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import step
from op3.rollout.servo_file import find_servo
from op3.rollout.units import likely_unit

_TURN = 2 * np.pi
_POSITION = ("joint", "position")


def _small(values: np.ndarray) -> np.ndarray:
    """Which columns are angles in rad at all: others are said by checks of the unit."""
    steps = np.abs(np.diff(values, axis=0))
    return (np.abs(values).max(0) < 50) & ((steps > 1).mean(0) < 0.05 if len(steps) else True)


@check("lost turns")
def lost_turns(view: View) -> Iterator[Finding]:
    """A position or target jumps by whole turns: it was wrapped, or the encoder lost count."""
    for key, values in ((_POSITION, view.position), (("command", "position"), view.command)):
        steps = np.diff(values, axis=0)
        turns = np.round(steps / _TURN)
        jumps = (turns != 0) & (np.abs(steps - turns * _TURN) < 1.0) & _small(values)
        for row, joint in np.argwhere(jumps)[:1]:
            count = int(abs(turns[row, joint]))
            what = "position" if key[0] == "joint" else "target"
            problem = f"{what} jumps by {'one turn' if count == 1 else f'{count} turns'} ({steps[row, joint]:+.3f} rad)"
            problem += f" at row {row + 2}"
            remedy = "write `unwrap: true` into its YAML, or `shift: {joint: rad}` to move its zero as well"
            yield Finding(ERROR, problem, remedy, view.column(key, joint), **view.where(int(row) + 1))


@check("a turn off")
def a_turn_off(view: View) -> Iterator[Finding]:
    """A position is whole turns away from its command."""
    error = view.position - view.command
    offset = np.median(error, axis=0)
    turns = np.round(offset / _TURN)
    follows = (np.ptp(error, axis=0) < np.pi) & _small(view.position) & _small(view.command)
    for joint in np.flatnonzero((turns != 0) & follows & (np.abs(offset - turns * _TURN) < 1.0)):
        problem = f"the position is {offset[joint]:+.3f} rad away from the command, about {turns[joint]:+.0f} turn"
        yield Finding(ERROR, problem, "write `unwrap: true` into its YAML", view.column(_POSITION, int(joint)))


@check("constant offset")
def constant_offset(view: View) -> Iterator[Finding]:
    """A joint stands off its command by the same angle in every pose: a homing offset, another zero, or a sign.

    Where the recorded current is the gain times this angle, the joint is just soft, and yields to what it carries.
    """
    if len(view.time) < 20:
        return
    error = np.where(view.driven, view.position - view.command, np.nan)
    gain, current = view.get(("command", "p_gain")), view.get(("joint", "current"))
    yields = np.zeros(len(view.joints), bool)
    if gain is not None and current is not None:
        pulled = -gain * (view.position - view.command)
        yields = np.median(np.abs(current - pulled), axis=0) < 0.5 * np.median(np.abs(pulled), axis=0)
    error = error[:, view.driven.mean(0) > 0.5]
    joints = np.flatnonzero(view.driven.mean(0) > 0.5)
    middle = np.nanmedian(error, axis=0) if len(joints) else np.zeros(0)
    for place, joint in enumerate(joints):
        others, offset = np.delete(np.abs(middle), place), float(middle[place])
        at, off = view.command[view.driven[:, joint], joint], error[~np.isnan(error[:, place]), place]
        if len(others) >= 3:
            odd = abs(offset) > max(0.15, 5 * float(np.quantile(others, 0.75)))
        else:  # what gravity and a soft loop leave goes with the angle
            about = np.sin(view.position[view.driven[:, joint], joint])
            fit = np.polynomial.polynomial.polyfit(about, off, 1) if np.ptp(about) > 0.5 else np.zeros(2)
            odd, offset = abs(fit[0]) > max(0.2, 3 * float((off - fit[0] - fit[1] * about).std())), float(fit[0])
        dead = np.ptp(view.position[:, joint]) == 0 and np.ptp(at) > 0.2  # a dead sensor is another check's
        if dead or yields[joint] or not odd:
            continue
        mirrored = np.ptp(at) < 0.05 and abs(offset + 2 * float(np.median(at))) < 0.05
        cause = "its sign is turned round" if mirrored else "another zero, or a homing offset in the servo"
        problem = f"the joint stands {offset:+.3f} rad off its command in every pose: {cause}"
        remedy = "write `shift: {joint: rad}` or `columns: {...: {offset: ...}}` into its YAML, or clear the offset"
        yield Finding(WARNING, problem, remedy, view.column(_POSITION, int(joint)))


@check("coarse steps")
def coarse(view: View) -> Iterator[Finding]:
    """Positions lie on a grid coarser than the encoder's: they were rounded, or are in another unit."""
    make = find_servo(view.metadata.servo)
    encoder = 0.0025 if make is None else make.position_unit
    steps = step(view.position)
    exact = 2 * np.pi / 4096 if make is None else encoder
    for joint in np.flatnonzero(steps > 4 * encoder):
        unit = likely_unit(float(steps[joint] / exact), "rad", 0.01)
        problem = f"positions come in steps of {steps[joint]:.4g} rad, where an encoder's are {exact:.4g} rad"
        problem += f", as if they were in {unit}" if unit else ""
        remedy = "convert them to radians" if unit else "write positions with more digits"
        severity = ERROR if unit else WARNING
        yield Finding(severity, problem, remedy, view.column(_POSITION, int(joint)))
