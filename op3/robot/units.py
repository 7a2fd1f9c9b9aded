"""Units of the robot's registers in SI, and gravity: one home for what every room needs.

Registers: control tables of the XM430-W350 and of the OpenCR's firmware for the OP3 (ROBOTIS e-Manual).
"""

from math import pi, radians

GRAVITY = 9.81
"""Gravity of the scenes, and of everything that is compared with them [m/s^2]."""

STANDARD_GRAVITY = 9.80665
"""One g [m/s^2], the unit in which data sheets give accelerations; a unit, and not where the robot stands."""

POSITION_UNIT = 2 * pi / 4096
"""One count of the encoder [rad]."""

VELOCITY_UNIT = 0.229 * 2 * pi / 60
"""One unit of present and goal velocity, 0.229 rpm [rad/s]."""

CURRENT_UNIT = 0.00269
"""One unit of present and goal current [A]."""

CONTINUOUS_CURRENT_COUNTS = 171
"""What a servo carries for ever, in units of current: a fifth of the stall current 2.3 A at 12 V."""

VOLTAGE_UNIT = 0.1
"""One unit of input voltage [V]."""

TEMPERATURE_UNIT = 1.0
"""One unit of temperature [C]."""

ANGLE_UNIT = radians(0.1)
"""One unit of roll, pitch and yaw [rad]."""

GYRO_UNIT = radians(2000 / 32800)
"""One unit of the gyro [rad/s]."""

ACCELERATION_UNIT = 2 * STANDARD_GRAVITY / 32768
"""One unit of the accelerometer, which clips at 2 g [m/s^2]."""
