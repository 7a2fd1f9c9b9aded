"""Simulates each window of `op3.sim.WindowSimulation` from its lead to its end.

In all functions, ``motion`` contains measured states and commands, ``[row, joint]`` of `MOTION`; ``along`` the dynamics
at these rows, ``[row, entry]``: mass matrix, bias and gradient of the bias one after the other; ``here`` and ``there``
the dynamics of one candidate at a tick and the next; ``work`` the working memory ``[SLOTS, joint]`` of a window.
"""

from math import copysign

import numpy as np

from op3.servo import kernel, rows
from op3.servo.effects.transmission import behind
from op3.servo.machine_code import entry, part
from op3.sim.inputs import COMMANDS

INPUTS = (*COMMANDS, "packet")
"""Signals that a motion may contain."""

STATE = ("position", "velocity", "acceleration", "read_position", "read_velocity", "radial_force", "current", "time")

MOTION = np.dtype([(name, np.float64) for name in (*STATE, *INPUTS)])
"""Measured and commanded signals of a joint at a tick."""

SWEEPS = 3
"""Sweeps over the joints per step."""

REST = 0.03
"""Speed below which a measured joint counts as resting [rad/s]; half of it is the noise of the estimate."""

SHIFT, ACCOUNTED, AWAY, FASTER, CHANGE, TOTAL, FORCE, BOUND, OWN, SPEED, ACCELERATION, ROOMS = range(12)
SLOTS = ROOMS + 2
"""Slots of a window's work array: offset of joints from their readings, and the part that the dynamics include;
distance from the measurement; change of velocity; unknowns of a step; acceleration."""


@part
def copied(source, target):
    """Copy the numbers of `source` to `target`."""
    for e in range(len(target)):
        target[e] = source[e]


@part
def mix(along, edits, weights, row, out):
    """Dynamics at a row, including the contributions of edited bodies."""
    for e in range(len(out)):
        out[e] = along[row, e]
    for n in range(len(weights)):
        if weights[n] != 0.0:
            for e in range(len(out)):
                out[e] += weights[n] * edits[n, row, e]


@part
def command(s, motion):
    """Inputs of the servos from this row on, ``[joint]``."""
    for j in range(len(s)):
        one, now = s[j], motion[j]
        one.position_target, one.p_gain, one.d_gain = now.position_target, now.p_gain, now.d_gain
        one.firmware_gain, one.torque_enable, one.packet = now.firmware_gain, now.torque_enable, now.packet
        one.bus_voltage, one.temperature = now.bus_voltage, now.temperature
        one.radial_force = now.radial_force


@part
def lead(s, p, motion, here, there, work, row, share):
    """State and load of the measured motion between two rows."""
    joints = len(s)
    for j in range(joints):
        one, now, then = s[j], motion[row, j], motion[row + 1, j]
        one.position = now.position + share * (then.position - now.position) + work[SHIFT, j]
        one.velocity = now.velocity + share * (then.velocity - now.velocity)
        work[ACCELERATION, j] = now.acceleration + share * (then.acceleration - now.acceleration)
    for i in range(joints):
        b = joints * joints + i
        asked = here[b] + share * (there[b] - here[b]) + behind(p[i]) * work[ACCELERATION, i]
        for k in range(joints):
            m = i * joints + k
            asked += (here[m] + share * (there[m] - here[m])) * work[ACCELERATION, k]
        s[i].load_torque = -asked


@part
def begin(s, p, on, motion, misread, weights, work, row, supply_resistance):
    """Place the joints at the beginning of a lead so that the sensors give the measured readings, and set the weights
    of the edits that account for angles that differ from their readings.
    """
    command(s, motion[row])
    for j in range(len(s)):
        one, now = s[j], motion[row, j]
        one.position, one.velocity = now.position, now.velocity
        for _ in range(3):
            rows.sense(one, p[j], on)
            one.position += now.position - one.measured_position
        work[SHIFT, j], work[ACCOUNTED, j] = one.position - now.position, 0.0
        if misread[j] >= 0:
            weights[misread[j]] = -work[SHIFT, j]
            work[ACCOUNTED, j] = work[SHIFT, j]
        one.current, one.time, one.supply_resistance = now.current, now.time, supply_resistance


@part
def let_go(s, p, on, motion, here, work, row, offset, step):
    """Begin the window: resting joints are in balance, and initial states have a candidate's offsets.

    Args:
        offset: offset of position and velocity, ``[2, joint]``.
        step: step of the simulation [s].
    """
    joints = len(s)
    for i in range(joints):
        rests = abs(motion[row, i].velocity) < REST
        needed = here[joints * joints + i]
        if not rests:
            needed += behind(p[i]) * work[ACCELERATION, i]
        for k in range(joints):
            if abs(motion[row, k].velocity) >= REST:
                needed += here[i * joints + k] * work[ACCELERATION, k]
        kernel.balance(s[i], p[i], s[i].applied_torque - needed, rests, on)
        work[CHANGE, i] = work[ACCELERATION, i] * step
    for i in range(joints):
        s[i].position += offset[0, i]
        s[i].velocity += offset[1, i]


@part
def move(s, p, now, then, here, there, damping, share, limbs, matrix, work, step):
    """Step all joints with the outputs of the law.

    The bias changes, to first order, where a window has left the measurement; with velocities it does so at the end of
    the step, otherwise gyroscopic torques would excite a foot that rattles in its backlash.

    Args:
        now, then: the measured motion at this tick and the next.
        damping: derivative of the bias by velocities at this tick.
        matrix: two rooms ``[2, joint, joint]``.
    """
    joints = len(s)
    whole, gradient = matrix[0], joints * joints + joints
    for i in range(joints):
        one, measured = s[i], now[i].position + share * (then[i].position - now[i].position)
        work[AWAY, i] = one.position - work[ACCOUNTED, i] - measured
        work[FASTER, i] = one.velocity - (now[i].velocity + share * (then[i].velocity - now[i].velocity))
    for limb in range(len(limbs)):
        first, last = limbs[limb, 0], limbs[limb, 1]
        dry = False
        for i in range(first, last):
            one, b = s[i], joints * joints + i
            own = here[b] + share * (there[b] - here[b])
            for k in range(first, last):
                m = i * joints + k
                own += here[gradient + m] * work[AWAY, k] + damping[i, k] * work[FASTER, k]
                whole[i, k] = here[m] + share * (there[m] - here[m]) + step * damping[i, k]
            work[OWN, i] = own
            work[TOTAL, i] = whole[i, i] + (p[i].armature + step * one.damping)
            work[FORCE, i] = step * (one.applied_torque - own)
            work[BOUND, i], work[SPEED, i] = step * one.friction_bound, one.velocity
            dry = dry or work[BOUND, i] != 0.0
        if dry:
            solve_dry(
                whole, work[TOTAL], work[SPEED], work[FORCE], work[BOUND], work[CHANGE], work[ROOMS:], first, last
            )
        else:
            solve_linear(whole, work[TOTAL], work[FORCE], work[CHANGE], matrix[1], first, last)
        for i in range(first, last):
            load = work[OWN, i]
            for k in range(first, last):
                load += whole[i, k] * work[CHANGE, k] / step
            s[i].load_torque = -load
            s[i].velocity += work[CHANGE, i]
            s[i].position += step * s[i].velocity


@part
def solve_dry(mass, total, velocity, force, bound, change, rooms, first, last):
    """Change of velocity in one step under coupled dry friction, from a guess.

    Minimises ``u' A u / 2 - u' force + bound |velocity + u|`` by sweeps over the joints, A being `mass` with `total` on
    its diagonal. Each sweep is exact for its joint, and leaves one that friction holds at exactly zero speed.

    Args:
        mass: ``[joint, joint]``, of which the off-diagonal counts [kg m^2].
        total: diagonal of A, ``[joint]``.
        velocity: before the step [rad/s].
        force: impulses without friction [N m s].
        bound: largest impulses of friction [N m s].
        change: guess, and result [rad/s].
        rooms: to work in, ``[2, joint]``.
        first: joint of the limb.
        last: the joint after its last.
    """
    left, inverse = rooms[0], rooms[1]
    for i in range(first, last):
        left[i], inverse[i] = force[i] + total[i] * velocity[i], 1.0 / total[i]
        for k in range(first, last):
            if k != i:
                left[i] -= mass[i, k] * change[k]
    for i in range(first, last):
        change[i] += velocity[i]
    for _ in range(SWEEPS):
        for i in range(first, last):
            # what friction leaves of the impulse, never reversed; a bound that is not a number shows
            impulse = left[i]
            excess = abs(impulse) - bound[i]
            speed = 0.0 if excess <= 0.0 else copysign(excess, impulse) * inverse[i]
            faster = speed - change[i]
            change[i] = speed
            for k in range(first, last):
                left[k] -= mass[k, i] * faster
            left[i] = impulse
    for i in range(first, last):
        change[i] -= velocity[i]


@part
def solve_linear(mass, total, force, change, rows, first, last):
    """Change of velocity in one step without dry friction, by elimination.

    Arguments as for `solve_dry`; `rows` is working memory, ``[joint, joint]``.
    """
    for i in range(first, last):
        for k in range(first, last):
            rows[i, k] = total[i] if i == k else mass[i, k]
        change[i] = force[i]
    for k in range(first, last):
        for i in range(k + 1, last):
            share = rows[i, k] / rows[k, k]
            change[i] -= share * change[k]
            for j in range(k + 1, last):
                rows[i, j] -= share * rows[k, j]
    for k in range(last - 1, first - 1, -1):
        for j in range(k + 1, last):
            change[k] -= rows[k, j] * change[j]
        change[k] /= rows[k, k]


def coupled(mass: np.ndarray) -> np.ndarray:
    """Groups of consecutive joints that no mass couples to other joints: first joint and end, ``[limb, 2]``.

    Args:
        mass: ``[tick, joint, joint]``.
    """
    linked = np.abs(mass).max(0) > 1e-12
    ends = [joint for joint in range(1, len(linked)) if not linked[:joint, joint:].any()]
    return np.array([*zip([0, *ends], [*ends, len(linked)], strict=True)])


@entry
def simulate(
    begin_row, end_row, s, flat, past, p, on, motion, along, damping, starts, dynamics_starts, edits, weights, misread,
    offsets, limbs, here, there, row_weights, matrix, work, preroll, substeps, step, supply_resistance, out,
):  # fmt: skip
    """Simulate some windows of some candidates.

    Args:
        begin_row: first row; a row is a candidate times the number of windows, plus a window.
        end_row: row after the last.
        s: memory for the signals, ``[joint]``; ``flat`` is the same memory as numbers.
        past: memory for earlier values that the law needs.
        p: parameters, ``[candidate | 1, joint]``; and ``on``, the effects that are on.
        motion, along, damping: see above; damping is ``[row, joint, joint]``.
        starts, dynamics_starts: rows at which the lead of each window begins, ``[window]``.
        edits: dynamics that edits of bodies add per unit, ``[edit, row, entry]``.
        weights: weights of the edits, ``[candidate, edit]``.
        misread: edit for the encoder offset of each joint, ``[joint]``, or -1.
        offsets: offsets of initial position and velocity, ``[candidate, 2, joint]``.
        limbs: limbs, see `coupled`.
        here, there, row_weights, matrix, work: rooms.
        preroll: ticks of a lead.
        substeps: steps of a tick.
        step: [s].
        supply_resistance: [ohm].
        out: result, position, velocity and current as read, ``[row, tick, joint, 3]``.
    """
    windows, ticks = len(starts), out.shape[1]
    for number in range(begin_row, end_row):
        candidate, first = number // windows, starts[number % windows]
        at = dynamics_starts[number % windows]
        own = p[min(candidate, len(p) - 1)]
        flat[:] = 0.0
        copied(weights[candidate], row_weights)
        begin(s, own, on, motion, misread, row_weights, work, first, supply_resistance)
        mix(along, edits, row_weights, at, there)
        for tick in range(preroll + ticks):
            row, leading = first + tick, tick < preroll
            copied(there, here)
            if tick < preroll + ticks - 1:
                mix(along, edits, row_weights, at + tick + 1, there)
            if tick <= preroll:
                lead(s, own, motion, here, there, work, row, 0.0)
            if tick == 0:
                rows.reset_robot(s, own, past, on)
            if tick == preroll:
                let_go(s, own, on, motion, here, work, row, offsets[candidate], step)
            for j in range(len(s)):
                rows.sense(s[j], own[j], on)
            if not leading:
                for j in range(len(s)):
                    rows.report(s[j], own[j], on)
                    read = out[number, tick - preroll, j]
                    read[0], read[1] = s[j].measured_position, s[j].measured_velocity
                    read[2] = s[j].measured_current
                if tick == preroll + ticks - 1:
                    break
            command(s, motion[row])
            for j in range(len(s)):  # a controller on the computer gets the readings of the log
                if np.isfinite(motion[row, j].read_position):
                    s[j].measured_position = motion[row, j].read_position
                    s[j].measured_velocity = motion[row, j].read_velocity
            rows.tick_robot(s, own, past, on)
            for phase in range(substeps):
                if leading and phase > 0:
                    lead(s, own, motion, here, there, work, row, phase / substeps)
                rows.step_robot(s, own, past, on)
                if not leading:
                    part_of_tick = (phase + 0.5) / substeps
                    now, then = motion[row], motion[row + 1]
                    move(s, own, now, then, here, there, damping[at + tick], part_of_tick, limbs, matrix, work, step)
