"""One step of joints coupled by their masses, with dry friction, compiled to machine code and kept on disk."""

import numpy as np

from op3.servo.machine_code import machine_code

SWEEPS = 3
"""Sweeps over the joints per step."""


@machine_code
def joint_step(mass, bias, pull, armature, damping, applied, bound, position, velocity, change, step, limbs):
    """A step of every joint of every candidate in every window.

    Args:
        mass: ``[joint, joint, 1 | candidate, window]`` [kg m^2].
        bias: torque without motion or motors, ``[joint, 1 | candidate, window]`` [N m].
        pull: added to it, ``[joint, candidate, window]`` [N m].
        armature: added to the diagonal of the mass, ``[joint, candidate, 1]`` [kg m^2].
        damping: implicit, ``[joint, candidate, window]`` [N m s/rad].
        applied: torque of the servos [N m].
        bound: largest torque of dry friction [N m].
        position: [rad].
        velocity: [rad/s].
        change: of the velocity in the last step [rad/s].
        step: length of a step [s].
        limbs: first joint and the one after the last of every limb, ``[limb, 2]``; no mass couples two.

    Returns:
        Position, velocity and change of velocity after the step, and the torque at the load [N m].
    """
    joints, candidates, windows = position.shape
    next_position, next_velocity = np.empty_like(position), np.empty_like(velocity)
    next_change, load = np.empty_like(velocity), np.empty_like(velocity)
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
                next_change[i, c, w] = change_of[i, w]
                next_velocity[i, c, w] = rest[i, w] + change_of[i, w]
                next_position[i, c, w] = position[i, c, w] + step * next_velocity[i, c, w]
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
    return next_position, next_velocity, next_change, load


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
