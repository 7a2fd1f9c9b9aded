"""The laws of a geared servo as scalar functions that effects share and tests compare with closed forms.

SI units; torques are on the joint side of the gear. Equation numbers are those of Masuda & Takahashi, "Sim-to-Real
Transfer of Compliant Bipedal Locomotion on Torque Sensor-Less Gear-Driven Humanoid" (2023).
"""

from math import exp, expm1

import numpy as np

from op3.servo.machine_code import scalar

ROUNDING = 1e-9
"""Share of a step that counts as zero, so that a command with a latency of whole steps arrives between two steps."""

CURRENT = 0
"""Index of the target current in the lists of signals that can be delayed, lag or be lost."""

GAUSSIAN, LORENTZ = 1, 2
"""Indices of these decays of static friction in their list, whose first is the exponential one."""

TRACE = 1e-12
"""Share of a torque by which the direction is chosen only if the joint is exactly at rest."""


@scalar
def clip(value, low, high):
    """The value clipped to bounds; NaN remains NaN, so that a diverged simulation is detected."""
    if value < low:
        return low
    return high if value > high else value


@scalar
def zones(motor_torque, load_torque, forward_efficiency, backward_efficiency):
    """Whether the motor drives, and whether the load drives, paper eq. (3); neither if they hold each other."""
    forward = np.sign(forward_efficiency * motor_torque + load_torque) == np.sign(motor_torque)
    backward = np.sign(motor_torque + backward_efficiency * load_torque) == np.sign(load_torque)
    return forward, backward


@scalar
def dte_brake(motor_torque, load_torque, forward_efficiency, backward_efficiency):
    """Brake torque [N m] of directional transmission efficiency as printed, paper eq. (3).

    The printed second condition reads ``sign(tau_m + eta_bw tau_m) = sign(tau_a)``, which does not depend on the load;
    it is implemented as ``sign(tau_m + eta_bw tau_a) = sign(tau_a)``. The rule depends only on torques, so it adds
    energy if the velocity opposes the dominating torque.

    Args:
        motor_torque: tau_m, joint side [N m].
        load_torque: tau_a, minus the moment that the output transmits to its child link [N m].
        forward_efficiency: eta_fw in (0, 1].
        backward_efficiency: eta_bw in (0, 1].
    """
    forward, backward = zones(motor_torque, load_torque, forward_efficiency, backward_efficiency)
    if forward:
        return (forward_efficiency - 1.0) * motor_torque
    if backward:
        return (backward_efficiency - 1.0) * load_torque
    return -(motor_torque + load_torque)


@scalar
def motor_leads(motor_torque, load_torque):
    """Whether the motor decides the direction: both torques point the same way, or the motor's is the larger."""
    return motor_torque * load_torque >= 0 or abs(motor_torque) >= abs(load_torque)


@scalar
def dte_passive_loss(motor_torque, load_torque, forward_efficiency, backward_efficiency):
    """Bound [N m] on a friction with the same loss as eq. (3) that always opposes motion.

    As friction, it can stop the joint but never drive it. It reproduces the antagonistic zone of eq. (3) exactly: a
    held joint slips at ``|tau_m| = eta_bw |tau_a|``. Arguments as for `dte_brake`.
    """
    if motor_leads(motor_torque, load_torque):
        return (1.0 - forward_efficiency) * abs(motor_torque)
    return (1.0 - backward_efficiency) * abs(load_torque)


@scalar
def dte_power_loss(motor_torque, load_torque, direction, forward_efficiency, backward_efficiency):
    """Bound [N m] on a friction whose loss depends on the direction of power: torque is scaled by eta_fw or 1 / eta_bw.

    Mesh efficiency of Pelchen, Schweiger & Otter (2002), constant over speed. `direction` has the sign of the motion;
    if it is zero, the larger torque decides. The other arguments are those of `dte_brake`.
    """
    power = motor_torque * (direction + TRACE * (motor_torque + load_torque))
    if power < 0:
        return abs(motor_torque) * (1.0 / max(backward_efficiency, 1e-3) - 1.0)
    return abs(motor_torque) * (1.0 - forward_efficiency)


@scalar
def stribeck_fade(speed, stribeck_velocity, form):
    """Share of the friction near rest that is left at a speed [rad/s], paper eq. (4): ``exp(-|w| / w_static)``.

    The paper prints ``s = exp(|w|) / w_static``, which grows without bound; the decaying exponential of the Stribeck
    function is meant (Tustin 1947). Armstrong-Helouvry, Dupont & Canudas de Wit (1994) compare it with the gaussian
    ``exp(-(w / w_static)^2)`` and Lorentz's curve ``1 / (1 + (w / w_static)^2)`` of Hess & Soom (1990).
    """
    ratio = speed / stribeck_velocity
    if form == GAUSSIAN:
        return exp(-ratio * ratio)
    return 1.0 / (1.0 + ratio * ratio) if form == LORENTZ else exp(-ratio)


@scalar
def lifted_voltage(voltage, bus_voltage, lift, fade):
    """Voltage [V] of a driver that adds to small duties: ``V + V_bus d0 sign(V) (1 - exp(-|V| / (V_bus d1)))``.

    d0 is the added duty, and d1 the duty over which it sets in; the result is limited to the bus voltage.
    """
    raised = voltage + np.sign(voltage) * bus_voltage * lift * -expm1(-abs(voltage) / (bus_voltage * fade))
    return clip(raised, -bus_voltage, bus_voltage)


@scalar
def load_friction(motor_torque, load_torque, motor_share, load_share):
    """Friction bound [N m] proportional to the transmitted torque: ``|lm tau_m - le tau_a|``.

    Torques that oppose each other press the teeth together. Duclusaud et al. (2025), models M3 to M5.
    """
    return abs(motor_share * motor_torque - load_share * load_torque)


@scalar
def antagonistic_friction(motor_torque, load_torque, motor_square, load_square):
    """Friction bound [N m] that grows with the square of the weaker torque where motor and load oppose each other.

    The squares qm and qe are in 1/(N m). Duclusaud et al. (2025), model M6.
    """
    if motor_torque * load_torque >= 0:
        return 0.0
    if abs(motor_torque) > abs(load_torque):
        return load_square * load_torque * load_torque
    return motor_square * motor_torque * motor_torque


@scalar
def acted(age, phase, steps, steps_per_tick):
    """Share of a step during which a delayed command of this age acts.

    A command issued at tick k acts from ``k * period + latency`` for one period. A step that straddles an arrival sees
    both commands in proportion to time, which is linear interpolation on the time grid: latency is a continuous
    parameter, not a whole number of steps.

    Args:
        age: ticks since the command was sent.
        phase: steps since the last tick.
        steps: latency, in simulation steps.
        steps_per_tick: control period, in simulation steps.
    """
    share = phase + 1.0 - steps + age * steps_per_tick
    if share < ROUNDING:
        return 0.0
    return share if share < 1.0 else 1.0


@scalar
def lags_per_step(time_constant, timestep):
    """Step length in time constants of a first-order lag, limited to 1000, after which no deviation remains."""
    return timestep / max(time_constant, 1e-3 * timestep)
