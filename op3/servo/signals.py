"""Signals of the servo law: per joint, of the trunk, and its time steps."""

from dataclasses import dataclass

from torch import Tensor

SIGNALS = {
    # inputs: the true state of the joint, and what the output transmitted to its link in the last step
    "position": "of the joint [rad]",
    "velocity": "of the joint [rad/s]",
    "load_torque": "tau_a [N m]",
    "radial_force": "across the output shaft [N]; filled only where an effect reads it",
    # commands, held until the next tick
    "position_target": "[rad]",
    "p_gain": "[A/rad]",
    "d_gain": "[A s/rad]",
    "firmware_gain": "kp of the servo's own position loop [firmware units]",
    "torque_enable": "1 or 0",
    "packet": "whether that of this tick arrived, where it is known: 1, -1 where it was lost; 0 elsewhere",
    "bus_voltage": "[V]",
    "temperature": "of the servo, as it measures it [C]",
    # clocks
    "time": "since the start [s]",
    "phase": "simulation steps since the last tick",
    # sensing stage: what the servo's encoder says
    "measured_position": "[rad]",
    "measured_velocity": "[rad/s]",
    # what reaches the servo, and what its driver applies
    "target_current": "[A]",
    "ahead": "by how much the current wanted at the end of a step exceeds its mean over the step [A]",
    "since": "share of the step for which the command at its end has acted",
    "goal": "of the servo's own position loop [rad]",
    "duty": "what the PWM register says, -1 to 1",
    "voltage": "[V]",
    "drawn": "sum of the currents of all servos of the robot in the last step, without signs [A]",
    "supply_resistance": "by which the bus voltage of this step falls with the currents of this step [ohm]",
    # motor stage
    "torque_constant_factor": "by which the motor's constant differs now",
    "resistance_factor": "by which its resistance differs now",
    "current": "[A]",
    "motor_torque": "tau_m at the old velocity [N m]",
    "measured_current": "what the servo says of it [A]; filled when sensors are read for a log",
    # friction stage
    "speed": "|velocity| [rad/s]",
    "fade": "share of the friction near rest that is left at this speed; 1 without a Stribeck effect",
    # to the physics
    "applied_torque": "at the old velocity [N m]",
    "damping": "minus its derivative by velocity, to be integrated implicitly [N m s/rad]",
    "friction_bound": "[N m]",
    # the joint's own, where an effect puts others in their place during a step
    "link_position": "[rad]",
    "link_velocity": "[rad/s]",
    "true_load": "[N m]",
    "open_voltage": "[V]",
    "asked_current": "[A]",
    # a rotor that is a body of its own: its velocity after a step is ``rotor_velocity + rotor_gain * velocity``
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
