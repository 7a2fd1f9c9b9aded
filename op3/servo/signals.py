"""Signals of the servo law: per joint, of the trunk, and its time steps."""

from dataclasses import dataclass

from torch import Tensor

SIGNALS = {
    # inputs: the true state of the joint, and what the output transmitted to its link in the last step
    "position": "of the joint [rad]",
    "velocity": "of the joint [rad/s]",
    "load_torque": "tau_a [N m]",
    "radial_force": "across the output shaft [N]; filled only if an effect reads it",
    # commands, held until the next tick
    "position_target": "[rad]",
    "p_gain": "[A/rad]",
    "d_gain": "[A s/rad]",
    "firmware_gain": "kp of the servo's own position loop [firmware units]",
    "torque_enable": "1 or 0",
    "packet": "whether this tick's packet arrived: 1, or -1 if it was lost; 0 if unknown",
    "bus_voltage": "[V]",
    "temperature": "measured by the servo [C]",
    # clocks
    "time": "since the start [s]",
    "phase": "simulation steps since the last tick",
    # sensing stage: readings of the servo's encoder
    "measured_position": "[rad]",
    "measured_velocity": "[rad/s]",
    # the command that reaches the servo, and the output of its driver
    "target_current": "[A]",
    "ahead": "commanded current at the end of a step minus its mean over the step [A]",
    "since": "share of the step in which the last command acts",
    "goal": "of the servo's own position loop [rad]",
    "duty": "value of the PWM register, -1 to 1",
    "voltage": "[V]",
    "drawn": "sum of the absolute currents of all servos of the robot in the last step [A]",
    "supply_resistance": "fall of the bus voltage with the currents of the same step [ohm]",
    # motor stage
    "torque_constant_factor": "present value relative to the parameter",
    "resistance_factor": "present value relative to the parameter",
    "current": "[A]",
    "motor_torque": "tau_m at the old velocity [N m]",
    "measured_current": "reported by the servo [A]; filled when sensors are read for a log",
    # friction stage
    "speed": "|velocity| [rad/s]",
    "fade": "share of the friction near rest that remains at this speed; 1 without a Stribeck effect",
    # to the physics
    "applied_torque": "at the old velocity [N m]",
    "damping": "minus its derivative by velocity, to be integrated implicitly [N m s/rad]",
    "friction_bound": "[N m]",
    # the joint's own values, while an effect replaces them during a step
    "link_position": "[rad]",
    "link_velocity": "[rad/s]",
    "true_load": "[N m]",
    "open_voltage": "[V]",
    "asked_current": "[A]",
    # a rotor that is a separate body: its velocity after a step is ``rotor_velocity + rotor_gain * velocity``
    "rotor_angle": "before the step [rad]",
    "rotor_velocity": "[rad/s]",
    "rotor_gain": "-",
    "rotor_slips": "direction in which it slipped",
    "rotor_torque": "on it in the last step [N m]",
    "contact_torque": "between it and the link in the last step [N m]",
}
"""Signals of the servo law by joint: the fields of ``s`` in the functions of an effect.

The simulation fills the inputs, the effects fill the rest in the order of their stages, and the simulation hands
torque, damping and friction to the physics."""


@dataclass
class Trunk:
    """Readings of the trunk's IMU.

    Attributes:
        quaternion: orientation, ``[sim, 4]``, w first.
        angular_velocity: in the frame of the body [rad/s], ``[sim, 3]``.
    """

    quaternion: Tensor
    angular_velocity: Tensor


@dataclass(frozen=True)
class Periods:
    """The two time steps of the law.

    Attributes:
        timestep: simulation step [s].
        period: time between ticks, at which commands are computed and sent [s].
    """

    timestep: float
    period: float
