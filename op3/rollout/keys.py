"""Short names for the keys of channels."""

POSITION, COMMAND = ("joint", "position"), ("command", "position")
VELOCITY, CURRENT, DUTY, LOAD = ("joint", "velocity"), ("joint", "current"), ("joint", "duty"), ("joint", "load")
VOLTAGE, TEMPERATURE = ("joint", "voltage"), ("joint", "temperature")
SWITCH, P_GAIN, D_GAIN = ("command", "torque_enable"), ("command", "p_gain"), ("command", "d_gain")
FIRMWARE_GAIN = ("command", "firmware_gain")
ORIENTATION, RATE, FORCE = ("imu", "orientation"), ("imu", "angular_velocity"), ("imu", "linear_acceleration")
