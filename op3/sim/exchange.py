"""Exchange of data between servos and MuJoCo in every step, without copies.

Arrays are MuJoCo's own, ``[sim, ...]``; ``at`` is `op3.sim.ServoPorts.table`.
"""

import numpy as np

from op3.servo.machine_code import entry


@entry
def read(s, at, forces, qpos, qvel, sensordata, applied):
    """Copy joint states, transmitted torques and, if requested, `forces` into the signals ``[sim, joint]``.

    The sensors measure the servo's torque and the torque `applied` in addition, which is a load on the servo.
    """
    for i in range(s.shape[0]):
        for j in range(s.shape[1]):
            one, force = s[i, j], at[4, j]
            one.position, one.velocity = qpos[i, at[0, j]], qvel[i, at[1, j]]
            one.load_torque = applied[i, at[1, j]] - sensordata[i, at[3, j]]
            if forces:
                one.radial_force = np.hypot(sensordata[i, force], sensordata[i, force + 1])


@entry
def hand_over(s, at, timestep, rotor, ctrl, armature, friction, failed):
    """Pass torque, implicit damping and friction of the next step to MuJoCo.

    Damping ``D`` is integrated implicitly as armature ``h D`` of that step, see `op3.sim.BatchSimulation`.

    Args:
        s: signals, ``[sim, joint]``.
        timestep: h [s].
        rotor: inertia of the rotors [kg m^2], ``[sim, joint]``.
        failed: ``[sim]``, set if a value is not finite.
    """
    for i in range(s.shape[0]):
        for j in range(s.shape[1]):
            one, dof = s[i, j], at[1, j]
            ctrl[i, at[2, j]] = one.applied_torque
            armature[i, dof] = rotor[i, j] + timestep * one.damping
            friction[i, dof] = one.friction_bound
            if not np.isfinite(one.applied_torque + one.damping + one.friction_bound):
                failed[i] = True
