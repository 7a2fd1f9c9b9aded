"""The law over ``[sim, joint]``: the functions that Python calls.

In all functions ``s`` are the signals and memory, ``[sim, joint]``; ``p`` the parameters, ``[sim | 1, joint]``;
``past`` the deeper memory of effects that have one, ``[sim, joint, effect, number]``; and ``on`` the bits of effects
that are on.
"""

from op3.servo import kernel
from op3.servo.effects.motor import settle
from op3.servo.machine_code import entry, part


@part
def sense(one, p, on):
    """Compute the servo's sensor readings of a joint."""
    one.measured_position, one.measured_velocity = one.position, one.velocity
    kernel.sense(one, p, on)


@part
def reset_robot(s, p, past, on):
    """Start the joints of a robot from their state and commands, as if these had been held for long."""
    drawn = sum_of_currents(s)
    for j in range(len(s)):
        one = s[j]
        one.phase, one.drawn, one.ahead, one.since = 0.0, drawn, 0.0, 1.0
        one.torque_constant_factor = one.resistance_factor = 1.0
        sense(one, p[j], on)
        one.goal = one.position_target
        kernel.command(one, p[j], past[j], on)
        kernel.reset(one, p[j], past[j], on)


@part
def tick_robot(s, p, past, on):
    """A control period begins; the sensors were read."""
    for j in range(len(s)):
        s[j].phase, s[j].goal = 0.0, s[j].position_target
        kernel.tick(s[j], p[j], past[j], on)


@part
def step_robot(s, p, past, on):
    """One simulation step of the joints of a robot, from their state to torque, damping and friction bound."""
    drawn, supplied = sum_of_currents(s), s[0].supply_resistance > 0.0
    for j in range(len(s)):
        one = s[j]
        if one.phase > 0.0:
            sense(one, p[j], on)
        one.drawn = drawn
        one.link_position, one.link_velocity = one.position, one.velocity
        one.true_load, one.open_voltage, one.asked_current = one.load_torque, one.bus_voltage, one.target_current
        kernel.begin(one, p[j], on)
        one.speed, one.fade, one.friction_bound = abs(one.velocity), 1.0, 0.0
        one.ahead, one.since = 0.0, 1.0
        kernel.drive(one, p[j], past[j], on)
        if not supplied:
            respond(one, p[j], past[j], on)
    if supplied:
        settle(s, p)
        for j in range(len(s)):
            respond(s[j], p[j], past[j], on)


@part
def respond(one, p, past, on):
    """The part of a step from the motor to the link."""
    kernel.respond(one, p, past, on)
    one.position, one.velocity, one.load_torque = one.link_position, one.link_velocity, one.true_load
    one.bus_voltage, one.target_current = one.open_voltage, one.asked_current
    kernel.finish(one, p, on)
    one.time += p.timestep
    one.phase += 1.0


@part
def report(one, p, on):
    """Compute the values that the servo reports in a log, after its sensors were read."""
    one.measured_current, velocity = one.current, one.velocity
    kernel.motor_side(one, p, on)
    kernel.report(one, p, on)
    one.velocity = velocity


@part
def sum_of_currents(s):
    """Sum of the absolute currents [A]."""
    drawn = 0.0
    for j in range(len(s)):
        drawn += abs(s[j].current)
    return drawn


@entry
def prepare_all(p, on):
    """Compute the constants of all rows of parameters."""
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            kernel.prepare(p[i, j], on)


@entry
def reset_all(s, p, past, on, rows):
    """Restart the simulations with these indices."""
    for i in rows:
        reset_robot(s[i], p[min(i, len(p) - 1)], past[i], on)


@entry
def tick_all(s, p, past, on):
    """Read the sensors, compute and send commands."""
    for i in range(len(s)):
        row = p[min(i, len(p) - 1)]
        for j in range(s.shape[1]):
            sense(s[i, j], row[j], on)
        tick_robot(s[i], row, past[i], on)


@entry
def step_all(s, p, past, on):
    """One simulation step."""
    for i in range(len(s)):
        step_robot(s[i], p[min(i, len(p) - 1)], past[i], on)


@entry
def sense_all(s, p, on):
    """Read the sensors."""
    for i in range(len(s)):
        for j in range(s.shape[1]):
            sense(s[i, j], p[min(i, len(p) - 1), j], on)


@entry
def report_all(s, p, on):
    """Read the sensors, and compute the values that servos report."""
    for i in range(len(s)):
        for j in range(s.shape[1]):
            sense(s[i, j], p[min(i, len(p) - 1), j], on)
            report(s[i, j], p[min(i, len(p) - 1), j], on)


@entry
def balance_all(s, p, torque, rests, on):
    """Deflect elastic elements so that joints move as measured; `torque` and `rests` are ``[sim, joint]``."""
    for i in range(len(s)):
        for j in range(s.shape[1]):
            kernel.balance(s[i, j], p[min(i, len(p) - 1), j], torque[i, j], rests[i, j], on)
