"""One step of a servo, a fraction of a millisecond, in scalar code compiled by numba.

The forms are chosen to differ from those that identification fits. The gear's loss follows the sign of the power
instead of comparing torques. Friction is an elastic element that slides at a bound (Prandtl's element, the
elasto-plastic limit of the LuGre bristle; Dupont et al. 2002, Hayward and Armstrong 2000), or LuGre's bristle itself
(Canudas de Wit et al. 1995), instead of a constraint of the physics engine. A loose gear has a motor side with an angle
of its own. Parameters and states of all servos are records, one per joint; a zero parameter switches its effect off.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

TICK = 0.001
"""Period of slow updates: noise, drift, voltage, temperature, and the servos' own velocity estimate [s]."""

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which a world's values apply [C]."""

WARM_UP_TIME = 150.0
"""Time constant of friction that decreases over a day [s]."""

MEMORY = 64
"""Ticks of encoder readings that are kept for a velocity from differences."""

STOP_STIFFNESS = 150.0
"""Stiffness of a joint's end stops [N m/rad]."""

STOP_DAMPING = 0.5
"""Damping of a joint's end stops [N m s/rad]."""

_SERVO = """
constant resistance armature current_lag late_stages late_time current_offset magnet_fading
coulomb excess stribeck_velocity fade_form viscous viscous_form drag driving_loss driven_loss loss_form
stiffness damping bristle_form load_friction load_friction_form
oval oval_centre oval_form asymmetry patch patch_centre ageing cogging cogging_periods cogging_phase cogging_form
chip chip_phase gear_stiffness gear_damping half_gap tooth_form output_inertia
spring spring_rest spring_form vibration vibration_frequency vibration_phase stop stop_side stop_edge
creep creep_rate warm_loss warm_form dropout low high
position_gain max_duty goal_speed position_unit supply_share
encoder_offset encoder_bend encoder_phase encoder_form velocity_time velocity_form slower_time slower_form
"""
_STATE = """
position velocity acceleration torque transmitted current goal duty by_voltage enabled late_1 late_2
bristle noise rest_time gear_position gear_velocity slack yielded temperature air gain reach dry static drift_phase out
velocity_1 velocity_2 velocity_3 followed
"""
_ROBOT = """
step time day_time supply open_voltage bus_resistance hidden_resistance bus_voltage drift drift_period noise_memory
noise_gain thermal_resistance thermal_time ticks
"""


def _record(names: str) -> np.dtype:
    return np.dtype([(name, np.float64) for name in names.split()])


SERVO, STATE, ROBOT = _record(_SERVO), _record(_STATE), _record(_ROBOT)
"""Records of a servo's parameters, of its state, and of values shared by a robot's servos. SI units and C."""


@njit(cache=True)
def fade(form: float, speed: float, scale: float) -> float:
    """Remaining share of static friction at a speed: Gaussian, exponential, Lorentz's, stretched exponential, or
    linear."""
    ratio = speed / scale
    if form == 0:
        return np.exp(-ratio * ratio)
    if form == 1:
        return np.exp(-ratio)
    if form == 2:
        return 1 / (1 + ratio * ratio)
    if form == 3:
        return np.exp(-np.sqrt(ratio))
    return max(0.0, 1 - 0.5 * ratio)


@njit(cache=True)
def viscous_rate(p, speed: float) -> float:
    """Viscous torque per velocity [N m s/rad]: constant, or for a shear-thinning grease."""
    return p.viscous if p.viscous_form == 0 else p.viscous * (speed + 0.01) ** -0.3


@njit(cache=True)
def friction_bound(p, s, torque: float, position: float, velocity: float) -> float:
    """Largest friction [N m]: gear loss by the sign of the power, Coulomb, static and hidden friction."""
    speed = abs(velocity)
    # at rest the strain of the teeth gives the direction of the torque; it is continuous, which avoids chattering
    loss = p.driving_loss if torque * s.bristle > 0 else p.driven_loss
    if p.loss_form == 1:
        loss *= 0.85 + 0.3 * np.exp(-speed / 0.3)
    elif p.loss_form == 2:  # seals and grease cost relatively more at light load
        loss *= 0.85 + 0.4 * np.exp(-abs(torque) / 0.3)
    elif p.loss_form == 3:  # teeth mesh better and worse
        loss *= 1 + 0.2 * np.sin(23 * position)
    elif p.loss_form == 4:  # loss grows more slowly than torque
        loss *= 1.2 / np.sqrt(1 + 2 * abs(torque))
    static = s.static
    if p.ageing > 0:
        static += p.ageing * (1 - np.exp(-s.rest_time))
    bound = abs(torque) * loss + s.dry + static * fade(p.fade_form, speed, p.stribeck_velocity)
    if p.load_friction != 0:
        other = s.transmitted if p.load_friction_form == 0 else torque
        bound += p.load_friction * (abs(torque) + abs(other))
    if p.oval != 0:
        away = position - p.oval_centre
        bound += p.oval * (
            np.cos(away - 0.3 * np.pi) ** 2 if p.oval_form == 0 else min(max(0.5 + away / 1.2, 0.0), 1.0)
        )
    if p.asymmetry != 0:
        bound += 0.5 * p.asymmetry * np.tanh(velocity / 0.01)
    if p.patch != 0:
        bound += p.patch * np.exp(-(((position - p.patch_centre) / 0.03) ** 2))
    return max(bound, 1e-6)


@njit(cache=True)
def slide(p, s, velocity: float, bound: float, step: float) -> float:
    """Strain the elastic element, let it slide at the bound, and return its torque [N m]."""
    limit = bound / p.stiffness
    if p.bristle_form == 1:  # LuGre: the strain saturates smoothly
        rate = velocity - abs(velocity) * s.bristle / limit
        s.bristle = min(max(s.bristle + step * rate, -limit), limit)
        return min(max(p.stiffness * s.bristle + p.damping * rate, -bound), bound)
    strain = s.bristle + step * velocity
    s.bristle = min(max(strain, -limit), limit)
    return min(max(p.stiffness * strain + p.damping * velocity, -bound), bound)


@njit(cache=True)
def drive(p, s, voltage: float, velocity: float, step: float) -> None:
    """Advance the measured current towards the goal, within the limits of the voltage."""
    induced = s.gain * velocity / p.resistance
    if s.by_voltage > 0:
        goal = s.duty * voltage / p.resistance - induced
    else:
        goal = s.goal
    if s.enabled == 0 or s.out > 0:
        goal = p.current_offset
    if p.late_stages > 0:
        blend = 1 - np.exp(-step * p.late_stages / p.late_time)
        s.late_1 += blend * (goal - s.late_1)
        goal = s.late_1
        if p.late_stages > 1:
            s.late_2 += blend * (goal - s.late_2)
            goal = s.late_2
    current = s.current + (1 - np.exp(-step / p.current_lag)) * (goal - p.current_offset - s.current)
    s.current = max(min(current, s.reach - induced), -s.reach - induced)


@njit(cache=True)
def gear_ripple(p, torque: float, position: float) -> float:
    """Torque that depends on the motor-side angle [N m]: cogging, and a chipped tooth every 0.35 rad."""
    ripple = 0.0
    if p.cogging != 0:
        wave = np.sin(p.cogging_periods * position + p.cogging_phase)
        ripple += p.cogging * (wave if p.cogging_form == 0 else np.tanh(2 * wave) / np.tanh(2.0))
    if p.chip != 0:
        turn = (position / 0.35 + p.chip_phase) % 1.0 - 0.5
        ripple -= p.chip * np.exp(-((turn / 0.06) ** 2)) * torque
    return ripple


@njit(cache=True)
def teeth(p, s) -> float:
    """Torque that a loose or soft gear transmits [N m]: zero within the gap, an elastic push outside it."""
    twist = s.gear_position - s.position
    pressed = max(abs(twist) - p.half_gap, 0.0)
    # curved flanks are soft at first touch (Hertz) and as stiff as the plain form at 1 mrad
    push = p.gear_stiffness * (pressed**1.5 / np.sqrt(0.001) if p.tooth_form == 1 else pressed)
    contact = np.sign(twist) * push
    if pressed > 0:
        damped = contact + p.gear_damping * (s.gear_velocity - s.velocity)
        return damped if damped * contact > 0 or p.half_gap == 0 else 0.0
    return 0.0


@njit(cache=True)
def link_torque(p, s, step: float, time: float) -> float:
    """Torque on the joint itself [N m]: end stops, cables, obstacles, yielding elements, vibration."""
    torque = s.noise
    if s.position < p.low or s.position > p.high:
        beyond = s.position - (p.low if s.position < p.low else p.high)
        torque -= STOP_STIFFNESS * beyond + STOP_DAMPING * s.velocity
    if p.spring != 0:
        s.slack = min(max(s.slack, s.position - 0.05), s.position + 0.05)
        # a cable that rubs against itself follows the joint at a distance: a play operator
        torque -= p.spring * ((s.slack if p.spring_form == 1 else s.position) - p.spring_rest)
    if p.vibration != 0:
        torque += p.vibration * np.sin(2 * np.pi * p.vibration_frequency * time + p.vibration_phase)
    if p.stop != 0:
        torque -= p.stop * p.stop_side * max(p.stop_side * (s.position - p.stop_edge), 0.0)
    if p.creep != 0:  # a spring whose rest angle follows the joint (Maxwell)
        s.yielded += step * p.creep_rate * (s.position - s.yielded)
        torque -= p.creep * (s.position - s.yielded)
    return torque


@njit(cache=True)
def servo_torque(p, s, robot) -> float:
    """Advance one servo by a physics step and return the torque on its joint [N m]."""
    step, soft = robot.step, p.gear_stiffness > 0
    position = s.gear_position if soft else s.position
    velocity = s.gear_velocity if soft else s.velocity
    drive(p, s, robot.bus_voltage * p.supply_share, velocity, step)
    torque = s.gain * s.current
    if p.load_friction != 0:
        s.transmitted += 0.25 * (s.torque - p.output_inertia * s.acceleration - s.transmitted)
    bound = friction_bound(p, s, torque, position, velocity)
    passed = (
        torque
        - slide(p, s, velocity, bound, step)
        - (viscous_rate(p, abs(velocity)) + p.drag * abs(velocity)) * velocity
    )
    passed += gear_ripple(p, torque, position)
    if soft:
        motor = passed
        passed = teeth(p, s)
        s.gear_velocity += step * (motor - passed) / (p.armature - p.output_inertia)
        s.gear_position += step * s.gear_velocity
    s.torque = passed + link_torque(p, s, step, robot.time + robot.day_time)
    return s.torque


@njit(cache=True)
def step_servos(servos, states, robot, position, velocity, torque) -> None:
    """Torques [joint] in N m of all servos for the next step, from true joint angles and velocities [joint]."""
    for j in range(len(states)):
        s = states[j]
        s.acceleration = (velocity[j] - s.velocity) / robot.step
        s.position, s.velocity = position[j], velocity[j]
        torque[j] = servo_torque(servos[j], s, robot)
    robot.time += robot.step


@njit(cache=True)
def step_limbs(servos, states, robot, index, mount, position, velocity, acceleration, inverse, bias, count) -> None:
    """Advance a robot with a fixed base by `count` steps of Euler's semi-implicit method.

    Args:
        servos: records [joint].
        states: records [joint].
        robot: record.
        index: place of each joint among the degrees of freedom [joint].
        mount: stiffness and damping of the elastic mount, which is the first degrees of freedom [dof, 2].
        position: [dof] in rad.
        velocity: [dof] in rad/s.
        acceleration: [dof] in rad/s^2, mean of the steps made.
        inverse: inverse of the joint-space inertia, its upper triangle [dof, dof] in 1/(kg m^2).
        bias: torque of gravity, Coriolis and centrifugal forces [dof] in N m.
        count: number of steps.
    """
    step, freedoms = robot.step, len(position)
    torque = np.zeros(freedoms)
    change = velocity.copy()
    for _ in range(count):
        for k in range(freedoms):
            torque[k] = -bias[k]
            if k < len(mount):
                torque[k] -= mount[k, 0] * position[k] + mount[k, 1] * velocity[k]
        for j in range(len(states)):
            torque[index[j]] += servo_torque(servos[j], states[j], robot)
        for k in range(freedoms):
            total = 0.0
            for m in range(freedoms):
                total += (inverse[k, m] if k <= m else inverse[m, k]) * torque[m]
            velocity[k] += step * total
        for k in range(freedoms):
            position[k] += step * velocity[k]
        for j in range(len(states)):
            s, k = states[j], index[j]
            s.acceleration = (velocity[k] - s.velocity) / step
            s.position, s.velocity = position[k], velocity[k]
        robot.time += step
    for k in range(freedoms):
        acceleration[k] = (velocity[k] - change[k]) / (count * step)


@njit(cache=True)
def encoder(p, position: float) -> float:
    """Reading of the encoder before rounding [rad]."""
    if p.encoder_bend == 0:
        return position + p.encoder_offset
    bent = np.sin(position + p.encoder_phase) + 0.3 * np.sin(2 * (position + p.encoder_phase))
    return position + p.encoder_offset + p.encoder_bend * bent


@njit(cache=True)
def encoders(servos, position) -> NDArray[np.float64]:
    """Readings of all encoders before rounding [joint] in rad, of joints at `position`."""
    said = np.empty(len(servos))
    for j in range(len(servos)):
        said[j] = encoder(servos[j], position[j])
    return said


@njit(cache=True)
def estimate_velocity(p, s, memory, ticks: int) -> float:
    """The servo's velocity estimate [rad/s]: one lag, two lags, or a difference over a window."""
    bent = p.encoder_bend != 0 and p.encoder_form == 1
    slope = 1.0
    if bent:
        phase = s.position + p.encoder_phase
        slope += p.encoder_bend * (np.cos(phase) + 0.6 * np.cos(2 * phase))
    window = 2 * p.velocity_time * (p.velocity_form == 2) + 2 * p.slower_time * (p.slower_form == 1)
    value = s.velocity * slope
    if window > 0:
        age = min(max(round(window / TICK), 1), MEMORY - 1)
        value = (memory[ticks % MEMORY] - memory[(ticks - age) % MEMORY]) / (age * TICK)
    if p.velocity_form < 2:
        stages = 1 + p.velocity_form
        blend = 1 - np.exp(-TICK * stages / p.velocity_time)
        s.velocity_1 += blend * (value - s.velocity_1)
        s.velocity_2 += blend * (s.velocity_1 - s.velocity_2)
        value = s.velocity_2 if p.velocity_form == 1 else s.velocity_1
    if p.slower_time > 0 and p.slower_form == 0:
        s.velocity_3 += (1 - np.exp(-TICK / p.slower_time)) * (value - s.velocity_3)
        value = s.velocity_3
    return value


@njit(cache=True)
def step_slow(servos, states, robot, memory, speed, normal, uniform) -> None:
    """Advance noise, drift, supply, temperature and the velocity estimates by `TICK`.

    Args:
        servos: records [joint].
        states: records [joint].
        robot: record.
        memory: encoder readings of the last ticks [joint, MEMORY] in rad.
        speed: the estimates [joint] in rad/s, written.
        normal: standard normal numbers [joint].
        uniform: numbers between 0 and 1 [joint].
    """
    robot.ticks += 1
    ticks = int(robot.ticks)
    drawn, total = 0.0, 0.0
    for j in range(len(states)):
        s = states[j]
        # drivers chop the voltage, so the battery supplies their power rather than their currents; none feeds back
        drawn += max(s.current * (servos[j].resistance * s.current + s.gain * s.velocity), 0.0)
        total += abs(s.current)
    given = np.isfinite(robot.supply)
    reach = robot.supply if given else robot.open_voltage - robot.bus_resistance * drawn / max(robot.bus_voltage, 1.0)
    robot.bus_voltage = reach
    for j in range(len(states)):
        p, s = servos[j], states[j]
        s.noise = robot.noise_memory * s.noise + robot.noise_gain * normal[j]
        drift = 1 + robot.drift * np.sin(2 * np.pi * robot.time / robot.drift_period + s.drift_phase)
        if p.warm_loss != 0:
            worked = 1 - np.exp(-(robot.day_time + robot.time) / WARM_UP_TIME)
            warm = min(max((s.temperature - REFERENCE_TEMPERATURE) / 35.0, 0.0), 1.1)
            drift *= 1 - p.warm_loss * (worked if p.warm_form == 0 else warm)
        s.dry, s.static = p.coulomb * drift, p.excess * drift
        heating = robot.thermal_resistance * p.resistance * s.current**2
        s.temperature += TICK / robot.thermal_time * (s.air + heating - s.temperature)
        s.gain = p.constant * (1 - p.magnet_fading * (s.temperature - REFERENCE_TEMPERATURE))
        s.reach = p.supply_share * (reach - robot.hidden_resistance * total) / p.resistance
        s.rest_time = s.rest_time + TICK if abs(s.velocity) < 0.01 else 0.0
        if p.dropout > 0:  # the driver pauses for 20 ms now and then
            s.out = max(s.out - TICK, 0.0)
            if uniform[j] < p.dropout * TICK:
                s.out = 0.02
        seen = encoder(p, s.position)
        memory[j, ticks % MEMORY] = seen
        if p.position_gain > 0:  # the servo's position loop, in integer counts, towards a goal that it follows
            s.followed += min(max(s.goal - s.followed, -p.goal_speed * TICK), p.goal_speed * TICK)
            error = s.followed - np.round(seen / p.position_unit) * p.position_unit
            s.duty = min(max(p.position_gain * error, -p.max_duty), p.max_duty)
        speed[j] = estimate_velocity(p, s, memory[j], ticks)
