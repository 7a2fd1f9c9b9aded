"""One step of joints coupled by their masses, with dry friction, compiled to machine code and kept on disk."""

import numpy as np

from op3.servo.machine_code import machine_code, row_at

SWEEPS = 3
"""Sweeps over the joints per step."""


@machine_code
def between(first, second, share, weights, edits, out):
    """Dynamics between two ticks, with what edits of bodies add.

    Args:
        first: at a tick, ``[entry, window]``.
        second: at the next.
        share: of the way from tick to tick.
        weights: of the edits, ``[edit, candidate, window]``.
        edits: addresses of what a weight of one adds at the first tick, ``[entry, window]``; the next tick lies behind.
        out: result, ``[entry, candidate, window]``; one candidate where nothing is edited.
    """
    entries, windows = first.shape
    kind = first.dtype
    share = kind.type(share)
    plain = np.empty(windows, kind)
    counts = np.zeros((len(edits), out.shape[1]), np.bool_)
    for n in range(len(edits)):
        for c in range(out.shape[1]):
            counts[n, c] = np.any(weights[n, c] != 0)
    for e in range(entries):
        for w in range(windows):
            plain[w] = first[e, w] + share * (second[e, w] - first[e, w])
        for c in range(out.shape[1]):
            for w in range(windows):
                out[e, c, w] = plain[w]
            for n in range(len(edits)):
                if counts[n, c]:
                    here = row_at(edits[n] + e * windows * first.itemsize, windows, kind)
                    there = row_at(edits[n] + (entries + e) * windows * first.itemsize, windows, kind)
                    for w in range(windows):
                        out[e, c, w] += weights[n, c, w] * (here[w] + share * (there[w] - here[w]))


@machine_code
def pull_back(gradient, damping, position, velocity, measured_position, measured_velocity, accounted, limbs, out):
    """How the bias changes, to first order, where a window has left the measurement.

    Args:
        gradient: of the bias by positions, ``[joint, joint, 1 | candidate, window]`` [N m/rad].
        damping: by velocities, ``[joint, joint, window]`` [N m s/rad].
        position: ``[joint, candidate, window]`` [rad].
        velocity: [rad/s].
        measured_position: ``[joint, window]`` [rad].
        measured_velocity: [rad/s].
        accounted: how far positions are off that are accounted for elsewhere, ``[joint, candidate, window]`` [rad].
        limbs: first joint and the one after the last of every limb, ``[limb, 2]``.
        out: result, ``[joint, candidate, window]`` [N m].
    """
    _, candidates, windows = position.shape
    away, faster = np.empty(windows, position.dtype), np.empty(windows, position.dtype)
    for c in range(candidates):
        slope = gradient[:, :, min(c, gradient.shape[2] - 1)]
        for limb in limbs:
            for i in range(limb[0], limb[1]):
                for w in range(windows):
                    out[i, c, w] = 0
            for k in range(limb[0], limb[1]):
                for w in range(windows):
                    away[w] = position[k, c, w] - accounted[k, c, w] - measured_position[k, w]
                    faster[w] = velocity[k, c, w] - measured_velocity[k, w]
                for i in range(limb[0], limb[1]):
                    for w in range(windows):
                        out[i, c, w] += slope[i, k, w] * away[w] + damping[i, k, w] * faster[w]


@machine_code
def joint_step(mass, bias, pull, armature, damping, applied, bound, position, velocity, change, load, step, limbs):
    """A step of every joint of every candidate in every window, in place.

    Args:
        mass: ``[joint, joint, 1 | candidate, window]`` [kg m^2].
        bias: torque without motion or motors, ``[joint, 1 | candidate, window]`` [N m].
        pull: added to it, ``[joint, candidate, window]`` [N m].
        armature: added to the diagonal of the mass, ``[joint, candidate, 1]`` [kg m^2].
        damping: implicit, ``[joint, candidate, window]`` [N m s/rad].
        applied: torque of the servos [N m].
        bound: largest torque of dry friction [N m].
        position: [rad]; what it is after the step takes its place, as that of the velocity and its change does.
        velocity: [rad/s].
        change: of the velocity in the last step [rad/s].
        load: result, torque at the load [N m].
        step: length of a step [s].
        limbs: first joint and the one after the last of every limb, ``[limb, 2]``; no mass couples two.
    """
    joints, candidates, windows = position.shape
    kind = position.dtype
    local = np.empty((6, joints, windows), kind)
    total, force, high, change_of, own, rest = local[0], local[1], local[2], local[3], local[4], local[5]
    step = kind.type(step)
    for c in range(candidates):
        here = mass[:, :, min(c, mass.shape[2] - 1)]
        outside = bias[:, min(c, bias.shape[1] - 1)]
        dry = np.any(bound[:, c] != 0)
        for i in range(joints):
            for w in range(windows):
                own[i, w] = outside[i, w] + pull[i, c, w]
                total[i, w] = here[i, i, w] + (armature[i, c, 0] + step * damping[i, c, w])
                force[i, w] = step * (applied[i, c, w] - own[i, w])
                high[i, w] = step * bound[i, c, w]
                rest[i, w] = velocity[i, c, w]
                change_of[i, w] = change[i, c, w]
        for limb in limbs:
            if dry:
                solve_dry(here, total, rest, force, high, change_of, limb[0], limb[1])
            else:
                solve_linear(here, total, force, change_of, limb[0], limb[1])
        for i in range(joints):
            for w in range(windows):
                change[i, c, w] = change_of[i, w]
                velocity[i, c, w] = rest[i, w] + change_of[i, w]
                position[i, c, w] += step * velocity[i, c, w]
                if not dry:
                    moved = (armature[i, c, 0] + step * damping[i, c, w]) * change_of[i, w] / step
                    load[i, c, w] = moved - applied[i, c, w]
        if dry:
            for limb in limbs:
                for i in range(limb[0], limb[1]):
                    rest[i] = 0
                    for k in range(limb[0], limb[1]):
                        for w in range(windows):
                            rest[i, w] += here[i, k, w] * change_of[k, w]
                    for w in range(windows):
                        load[i, c, w] = -(rest[i, w] / step + own[i, w])


@machine_code
def solve_dry(mass, total, velocity, force, bound, change, first, last):
    """Change of velocity in one step under coupled dry friction, from a guess.

    Minimises ``u' A u / 2 - u' force + bound |velocity + u|`` by sweeps over the joints, A being `mass` with
    `total` on its diagonal.

    Args:
        mass: ``[joint, joint, window]``, of which the off-diagonal counts [kg m^2].
        total: diagonal of A, ``[joint, window]``.
        velocity: before the step [rad/s].
        force: impulses without friction [N m s].
        bound: largest impulses of friction [N m s].
        change: guess, and result.
        first: joint of the limb.
        last: the joint after its last.
    """
    impulse = np.empty(total.shape[1], total.dtype)
    for _ in range(SWEEPS):
        for i in range(first, last):
            impulse[:] = 0
            for k in range(first, last):
                if k != i:
                    for w in range(len(impulse)):
                        impulse[w] += mass[i, k, w] * change[k, w]
            for w in range(len(impulse)):
                left = force[i, w] + total[i, w] * velocity[i, w] - impulse[w]
                # what friction leaves of the impulse, never reversed
                lost = np.minimum(np.maximum(left, -bound[i, w]), bound[i, w])
                change[i, w] = (left - lost) / total[i, w] - velocity[i, w]


@machine_code
def solve_linear(mass, total, force, change, first, last):
    """Change of velocity in one step without dry friction: Gauss elimination, side by side for all windows.

    Args:
        mass: ``[joint, joint, window]``, of which the off-diagonal counts [kg m^2].
        total: what stands on the diagonal, ``[joint, window]``.
        force: impulses [N m s].
        change: result.
        first: joint of the limb.
        last: the joint after its last.
    """
    count, windows = last - first, total.shape[1]
    rows = np.empty((count, count, windows), total.dtype)
    for i in range(count):
        for k in range(count):
            rows[i, k] = total[first + i] if i == k else mass[first + i, first + k]
        change[first + i] = force[first + i]
    share = np.empty(windows, total.dtype)
    for k in range(count - 1):
        for i in range(k + 1, count):
            for w in range(windows):
                share[w] = rows[i, k, w] / rows[k, k, w]
                change[first + i, w] -= share[w] * change[first + k, w]
            for j in range(k + 1, count):
                for w in range(windows):
                    rows[i, j, w] -= share[w] * rows[k, j, w]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            for w in range(windows):
                change[first + k, w] -= rows[k, j, w] * change[first + j, w]
        for w in range(windows):
            change[first + k, w] /= rows[k, k, w]
