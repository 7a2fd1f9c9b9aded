"""Checks of angles: turns, jumps, zeros and steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import step
from op3.rollout.servo_file import find_servo

_TURN = 2 * np.pi


@check("lost turns")
def lost_turns(view: View) -> Iterator[Finding]:
    """A position or target jumps by whole turns: it was wrapped, or the encoder lost count."""
    for key in (("joint", "position"), ("command", "position")):
        steps = np.diff(view.log.array(key), axis=0)
        turns = np.round(steps / _TURN)
        jumps = (turns != 0) & (np.abs(steps - turns * _TURN) < 1.0)
        if not 0 < jumps.any(1).mean() < 0.05:  # more would be angles in another unit
            continue
        row, joint = (int(i) for i in np.argwhere(jumps)[0])
        count = int(abs(turns[row, joint]))
        what = "position" if key[0] == "joint" else "target"
        problem = f"{what} jumps by {'one turn' if count == 1 else f'{count} turns'} ({steps[row, joint]:+.3f} rad)"
        problem += f" at row {row + 2}"
        remedy = "write `unwrap: true` into its YAML, or `shift: {joint: rad}` to move its zero as well"
        yield Finding(ERROR, problem, remedy, view.column(key, joint), **view.where(row + 1))


@check("a turn off")
def a_turn_off(view: View) -> Iterator[Finding]:
    """A position is whole turns away from its command."""
    error = view.log.array(("joint", "position")) - view.log.array(("command", "position"))
    offset = np.median(error, axis=0)
    turns = np.round(offset / _TURN)
    follows = np.ptp(error, axis=0) < np.pi
    for joint in np.flatnonzero((turns != 0) & follows & (np.abs(offset - turns * _TURN) < 1.0)):
        problem = f"the position is {offset[joint]:+.3f} rad away from the command, about {turns[joint]:+.0f} turn"
        remedy = "write `unwrap: true` into its YAML"
        yield Finding(ERROR, problem, remedy, view.column(("joint", "position"), int(joint)))


@check("constant offset")
def constant_offset(view: View) -> Iterator[Finding]:
    """At rest a joint stands off its command by the same angle in every pose: a homing offset or another zero."""
    rows = round(0.4 / view.interval) if np.isfinite(view.interval) else 0
    if not rows or len(view.time) < 3 * rows:
        return
    position, command = view.log.array(("joint", "position")), view.log.array(("command", "position"))
    some = slice(rows, None, max(1, rows // 2))
    still = np.abs(command[rows:] - command[:-rows])[:: max(1, rows // 2)] < 1e-3
    still &= np.abs(position[rows:] - position[:-rows])[:: max(1, rows // 2)] < 0.01
    still &= view.driven[some]
    for joint in range(len(view.joints)):
        at = command[some, joint][still[:, joint]]
        if len(at) < 4 or np.ptp(at) < 0.2:
            continue
        error = (position - command)[some, joint][still[:, joint]]
        mean = float(error.mean())
        if abs(mean) > 0.1 and error.std() < 0.15 * abs(mean):
            problem = f"at rest the joint stands {mean:+.3f} rad off its command in every pose"
            problem += ": another zero, or a homing offset in the servo"
            remedy = "write `columns: {...: {offset: ...}}` into its YAML, or clear the offset"
            yield Finding(WARNING, problem, remedy, view.column(("joint", "position"), joint))


@check("coarse steps")
def coarse(view: View) -> Iterator[Finding]:
    """Positions lie on a grid coarser than the encoder's: they were rounded when they were written."""
    make = find_servo(view.metadata.servo)
    encoder = 0.0025 if make is None else make.position_unit
    steps = step(view.log.array(("joint", "position")))
    for joint in np.flatnonzero(steps > 4 * encoder):
        problem = f"positions come in steps of {steps[joint]:.4g} rad, where an encoder's are {encoder:.4g} rad"
        remedy = "write positions with more digits"
        yield Finding(WARNING, problem, remedy, view.column(("joint", "position"), int(joint)))
