"""The servo law as pure functions: what a geared servo does in one simulation step.

Every function maps tensors to tensors, broadcast over ``[sim, joint]``, in SI units, without a Python branch
on data, so that one row (a composer hook), many rows (the batched simulation) and a differentiated evaluation
run the same code. Equation numbers are those of Masuda & Takahashi, "Sim-to-Real Transfer of Compliant Bipedal
Locomotion on Torque Sensor-Less Gear-Driven Humanoid" (2023). Torques are on the joint side of the gear.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

TRACE = 1e-12
"""Share of a torque that decides a direction only where the joint rests exactly."""


def stacked(*parts: Tensor) -> Tensor:
    """Tensors ``[sim, joint]`` as one, ``[part, sim, joint]``, in the memory order of the first.

    Window simulations keep joints in rows; arithmetic between tensors of different order is several times slower.
    """
    if parts[0].stride(-1) > 1:
        return torch.stack([part.mT for part in parts]).mT
    return torch.stack(parts)


def pd_current(position_target: Tensor, position: Tensor, velocity: Tensor, p_gain: Tensor, d_gain: Tensor) -> Tensor:
    """Target current [A] of the variable-gain PD: ``Kp (q* - q) - Kd w``.

    Args:
        position_target: commanded angle [rad], ``[sim, joint]``.
        position: measured angle [rad].
        velocity: measured velocity [rad/s].
        p_gain: [A/rad]. The paper commands 0.1 to 6.
        d_gain: [A s/rad]. The paper fixes 0.1.
    """
    return p_gain * (position_target - position) - d_gain * velocity


def current_control(
    target_current: Tensor,
    back_emf: Tensor,
    terminal_resistance: Tensor,
    bus_voltage: Tensor,
) -> Tensor:
    """Voltage [V] of the current controller, paper eq. (2): ``clip(R I* + Kt w, -V_bus, V_bus)``.

    Args:
        target_current: I* [A], ``[sim, joint]``.
        back_emf: joint torque constant times joint velocity [V].
        terminal_resistance: [ohm].
        bus_voltage: [V].
    """
    wanted = torch.addcmul(back_emf, terminal_resistance, target_current)
    return torch.clamp(wanted, -bus_voltage, bus_voltage)


SETTLING = 4
"""Newton's steps to a settled voltage."""

LEAST_VOLTAGE = 1.0
"""A bus falls no further [V]."""

SUPPLY = "supply"
"""Key of the memory: inner resistance of the supply [ohm], ``[sim, 1]``, where the voltage between two readings of it
follows the currents; the bus voltage of the signals is then that without any current."""


def settled_voltage(
    open_voltage: Tensor, supply_resistance: Tensor, target_current: Tensor, back_emf: Tensor, resistance: Tensor
) -> Tensor:
    """Bus voltage [V] under the currents that it lets through: ``V = V0 - R_s sum |I(V)|``.

    Where no servo is driven back by its speed the currents fall with the voltage, and there is one solution; Newton's
    steps from above reach it as soon as they have found which servos the voltage limits.

    Args:
        open_voltage: V0, ``[sim, joint]``.
        supply_resistance: R_s [ohm], ``[sim, 1]``.
        target_current: as the controllers ask [A].
        back_emf: [V].
        resistance: of the motors [ohm].
    """
    voltage = open_voltage
    for _ in range(SETTLING):
        current = torch.clamp(target_current, (-voltage - back_emf) / resistance, (voltage - back_emf) / resistance)
        # a servo that its speed drives back gives current the more, the lower the voltage is
        slope = torch.where(current == target_current, 0.0, torch.sign(current * target_current) / resistance)
        drawn, slope = current.abs().sum(-1, keepdim=True), slope.sum(-1, keepdim=True).clamp(min=0.0)
        step = (open_voltage - supply_resistance * drawn - voltage) / (1.0 + supply_resistance * slope)
        voltage = torch.minimum((voltage + step).clamp(min=LEAST_VOLTAGE), open_voltage)
    return voltage


def dte_zones(
    motor_torque: Tensor, load_torque: Tensor, forward_efficiency: Tensor, backward_efficiency: Tensor
) -> tuple[Tensor, Tensor]:
    """Whether the motor drives, and whether the load drives, paper eq. (3); neither where they hold each other.

    Where both conditions are met (torques of one direction) the first one counts. Arguments as for `dte_brake`.
    """
    forward = torch.sign(forward_efficiency * motor_torque + load_torque) == torch.sign(motor_torque)
    backward = torch.sign(motor_torque + backward_efficiency * load_torque) == torch.sign(load_torque)
    return forward, backward


def dte_brake(
    motor_torque: Tensor, load_torque: Tensor, forward_efficiency: Tensor, backward_efficiency: Tensor
) -> Tensor:
    """Brake torque [N m] of directional transmission efficiency as printed, paper eq. (3).

    The printed second condition reads ``sign(tau_m + eta_bw tau_m) = sign(tau_a)``, which does not depend on
    the load; it is implemented as ``sign(tau_m + eta_bw tau_a) = sign(tau_a)``. The rule looks at torques
    alone, so it adds energy where the velocity opposes the dominating torque.

    Args:
        motor_torque: tau_m, joint side [N m], ``[sim, joint]``.
        load_torque: tau_a, minus the moment that the output transmits to its child link [N m].
        forward_efficiency: eta_fw in (0, 1].
        backward_efficiency: eta_bw in (0, 1].
    """
    forward, backward = dte_zones(motor_torque, load_torque, forward_efficiency, backward_efficiency)
    return torch.where(
        forward,
        (forward_efficiency - 1.0) * motor_torque,
        torch.where(backward, (backward_efficiency - 1.0) * load_torque, -(motor_torque + load_torque)),
    )


def motor_leads(motor_torque: Tensor, load_torque: Tensor) -> Tensor:
    """Where the motor decides the direction: both torques point the same way, or the motor's is the larger."""
    return (motor_torque * load_torque >= 0) | (motor_torque.abs() >= load_torque.abs())


def dte_passive_loss(
    motor_torque: Tensor, load_torque: Tensor, leads: Tensor, forward_loss: Tensor, backward_loss: Tensor
) -> Tensor:
    """Bound [N m] on a friction that loses what eq. (3) loses but always opposes motion.

    ``(1 - eta_fw) |tau_m|`` where the motor leads or both torques point the same way, otherwise
    ``(1 - eta_bw) |tau_a|``. As a friction it can stop the joint and never push it; the antagonistic zone of
    eq. (3) is reproduced exactly: a hold slips at ``|tau_m| = eta_bw |tau_a|``.

    Args:
        motor_torque: tau_m, joint side [N m], ``[sim, joint]``.
        load_torque: tau_a [N m].
        leads: where the motor leads, see `motor_leads`.
        forward_loss: ``1 - eta_fw``.
        backward_loss: ``1 - eta_bw``.
    """
    return torch.where(leads, forward_loss * motor_torque.abs(), backward_loss * load_torque.abs())


def dte_power_loss(
    motor_torque: Tensor, load_torque: Tensor, direction: Tensor, forward_loss: Tensor, backward_share: Tensor
) -> Tensor:
    """Bound [N m] on a friction that loses by the direction of power: torque arrives as eta_fw or as 1 / eta_bw.

    ``(1 - eta_fw) |tau_m|`` where the motor drives, ``(1 / eta_bw - 1) |tau_m|`` where it is driven back. At rest the
    stronger torque says which.

    Args:
        motor_torque: tau_m, joint side [N m], ``[sim, joint]``.
        load_torque: tau_a [N m].
        direction: any quantity with the sign of the motion; zero at rest.
        forward_loss: ``1 - eta_fw``.
        backward_share: ``1 / eta_bw - 1``.
    """
    power = motor_torque * torch.add(direction, motor_torque + load_torque, alpha=TRACE)
    driven = (power < 0).to(power.dtype)
    return motor_torque.abs() * torch.addcmul(forward_loss, driven, backward_share - forward_loss)


def stribeck_fade(speed: Tensor, stribeck_velocity: Tensor, gaussian: bool = False) -> Tensor:
    """Share of the friction near rest that is left at a speed, paper eq. (4): ``exp(-|w| / w_s)``.

    Armstrong (1994) finds both that and ``exp(-(w / w_s)^2)``, which stays near one for longer and has no tail.

    The paper prints ``s = exp(|w|) / w_static``, which grows without bound; the decaying exponential of the
    Stribeck function is meant.

    Args:
        speed: ``|w|`` [rad/s], ``[sim, joint]``.
        stribeck_velocity: w_static [rad/s].
        gaussian: whether the square of the ratio counts.
    """
    ratio = speed / stribeck_velocity
    return torch.exp(-ratio * ratio if gaussian else -ratio)


def position_duty(
    error: Tensor, error_rate: Tensor, duty_gain: Tensor, derivative_gain: Tensor, max_duty: float
) -> Tensor:
    """Duty cycle of a servo's own position loop: ``clip(kp g e + kd de/dt, -d_max, d_max)``.

    Args:
        error: goal minus measured angle [rad], ``[sim, joint]``.
        error_rate: its derivative [rad/s].
        duty_gain: ``kp g``, duty per radian.
        derivative_gain: kd, duty per rad/s.
        max_duty: largest duty the firmware uses.
    """
    return torch.clamp(duty_gain * error + derivative_gain * error_rate, -max_duty, max_duty)


def lifted_voltage(voltage: Tensor, bus_voltage: Tensor, lift: Tensor, fade: Tensor) -> Tensor:
    """Voltage [V] of a driver that adds to small duties: ``V + V_bus d0 sign(V) (1 - exp(-|V| / (V_bus d1)))``.

    Zero stays zero, duties far above d1 are raised by d0, and the bus voltage bounds the whole.

    Args:
        voltage: as the controller asks [V], ``[sim, joint]``.
        bus_voltage: [V].
        lift: d0, as a duty.
        fade: duty d1 over which the lift sets in.
    """
    raised = voltage + torch.sign(voltage) * bus_voltage * lift * -torch.expm1(-voltage.abs() / (bus_voltage * fade))
    return torch.clamp(raised, -bus_voltage, bus_voltage)


def load_friction(motor_torque: Tensor, load_torque: Tensor, motor_share: Tensor, load_share: Tensor) -> Tensor:
    """Friction bound [N m] in proportion to the torque that the gear passes on: ``|lm tau_m - le tau_a|``.

    Equal shares give the load-dependent friction of a gear box, ``l |tau_m - tau_a|``: torques that oppose each
    other press the teeth together. Duclusaud et al. (2024), models M3 to M5.

    Args:
        motor_torque: tau_m, joint side [N m], ``[sim, joint]``.
        load_torque: tau_a [N m].
        motor_share: lm.
        load_share: le.
    """
    return (motor_share * motor_torque - load_share * load_torque).abs()


def antagonistic_friction(
    motor_torque: Tensor, load_torque: Tensor, motor_square: Tensor, load_square: Tensor
) -> Tensor:
    """Friction bound [N m] that grows with the square of the weaker torque where motor and load oppose each other.

    ``qe tau_a^2`` where the motor is the stronger, ``qm tau_m^2`` where the load is; zero where both torques point
    the same way. Duclusaud et al. (2024), model M6.

    Args:
        motor_torque: tau_m, joint side [N m], ``[sim, joint]``.
        load_torque: tau_a [N m].
        motor_square: qm [1/(N m)].
        load_square: qe [1/(N m)].
    """
    motor_leads = motor_torque.abs() > load_torque.abs()
    square = torch.where(motor_leads, load_square * load_torque.square(), motor_square * motor_torque.square())
    return torch.where(motor_torque * load_torque < 0, square, 0.0)


def delay_weights(latency: Tensor, timestep: float, period: float, depth: int) -> Tensor:
    """How much each held command contributes to each simulation step when commands arrive late.

    A command issued at tick k acts from ``k * period + latency`` for one period. A step that straddles an
    arrival sees both commands in proportion to time, which is linear interpolation on the time grid: latency
    is a continuous parameter, not a whole number of steps.

    Args:
        latency: [s], ``[sim, joint]``; at most ``(depth - 1) * period``.
        timestep: simulation step [s].
        period: control period [s], a multiple of the timestep.
        depth: number of past commands kept, newest first.

    Returns:
        Weights ``[phase, command, sim, joint]``; phase counts the steps since the last tick, and the weights
        of one phase sum to one.
    """
    phases = round(period / timestep)
    start = torch.arange(phases, dtype=latency.dtype, device=latency.device) * timestep
    age = torch.arange(depth, dtype=latency.dtype, device=latency.device)
    start = start.view(-1, 1, *([1] * latency.ndim))
    arrival = latency - age.view(1, -1, *([1] * latency.ndim)) * period
    # time of the step [start, start + timestep] that lies after this command's arrival
    after = ((start + timestep - arrival) / timestep).clamp(0.0, 1.0)
    superseded = torch.cat([torch.zeros_like(after[:, :1]), after[:, :-1]], dim=1)
    return after - superseded


ARRIVED = "arrived"
"""Key of the memory: by how much the command at the end of a step exceeds its mean over the step [A], and for which
share of the step it has acted."""


LAGGED = "current_lag"
"""Key of the memory of a current that follows its command late: the current at the end of a step, by how much it
exceeds its mean over the step, and the command at the end [A]."""


def ahead(state: Mapping[str, Tensor]) -> Tensor | float:
    """By how much the current that is wanted at the end of a step exceeds its mean over the step [A].

    Args:
        state: memory of the effects.
    """
    if LAGGED in state:
        return state[LAGGED][1]
    return state[ARRIVED][0] if ARRIVED in state else 0.0


def last_arrivals(weights: Tensor) -> Tensor:
    """Which command is in force at the end of each simulation step.

    Args:
        weights: see `delay_weights`.

    Returns:
        1 for the newest command that acts in the step, 0 for the others, ``[phase, command, sim, joint]``.
    """
    acts = (weights > 0).unbind(1)
    newest, known = [], torch.zeros_like(acts[0])
    for each in acts:
        newest.append(each & ~known)
        known = known | each
    return torch.stack(newest, 1).to(weights.dtype)


def at_phase(table: Tensor, phase: int | Tensor) -> Tensor:
    """Entry of a table over the steps of a control period.

    Args:
        table: ``[phase, ...]``.
        phase: steps since the last tick; a tensor ``[1]`` where the same operations serve every step.
    """
    return table[phase] if isinstance(phase, int) else table.index_select(0, phase)[0]
