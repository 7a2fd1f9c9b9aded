"""Units of the robot's registers in SI, and gravity, for all subpackages.

Registers: `assets/servos/xm430-w350.yaml`, and the OpenCR's firmware for the OP3 (ROBOTIS e-Manual).
"""

from math import radians

from op3.robot.servo_make import load_servo

GRAVITY = 9.81
"""Gravity of the scenes and of everything compared with them [m/s^2]."""

STANDARD_GRAVITY = 9.80665
"""One g [m/s^2], the unit of accelerations in data sheets, not the local gravity."""

_SERVO = load_servo("xm430-w350")

POSITION_UNIT = _SERVO.position_unit
"""One count of the encoder [rad]."""

VELOCITY_UNIT = _SERVO.counts.velocity.si
"""One unit of present and goal velocity [rad/s]."""

CURRENT_UNIT = _SERVO.unit("current")
"""One unit of present and goal current [A]."""

VOLTAGE_UNIT = _SERVO.counts.voltage.si
"""One unit of input voltage [V]."""

ANGLE_UNIT = radians(0.1)
"""One unit of roll, pitch and yaw [rad]."""

GYRO_UNIT = radians(2000 / 32800)
"""One unit of the gyro [rad/s]."""

ACCELERATION_UNIT = 2 * STANDARD_GRAVITY / 32768
"""One unit of the accelerometer, which clips at 2 g [m/s^2]."""
