"""The channels of a log: one table from which validation, CSV headers and documentation derive.

A log is a TensorDict of batch size [time] or [episode, time]. A row holds the sensors at `time` and then the
command issued at that time. Units are SI; orientation is R = Rz(yaw) Ry(pitch) Rx(roll); body rates and
specific force (+9.81 m/s2 upwards at rest) are in the body frame. A channel that was not measured is absent.

Policy channels change once per policy step. If rows are more frequent, their values are held between policy steps, and
the metadata's `policy_rate` states the rate of the policy.

The `raw` group contains the values on the bus of a real or emulated robot in integer register units, so that
conversion, calibration, limits and lost replies can be checked from the log alone. Other code reads only the SI
channels.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

Key = str | tuple[str, str]
"""A TensorDict key: `"time"`, `("joint", "position")`."""

RESERVED = ("imu", "policy", "raw")
"""Names of column groups, which are not allowed as joint names."""


@dataclass(frozen=True)
class Quantity:
    """Physical quantity of a channel.

    Attributes:
        unit: Unit in messages and tables; empty for dimensionless numbers.
        bound: Largest plausible absolute value [unit]; beyond it the unit is wrong.
        mistake: Likely mistake if a value exceeds the bound.
        remedy: How to correct the mistake.
        nonnegative: Whether values below zero are impossible.
        binary: Whether only 0 and 1 are possible.
    """

    unit: str = ""
    bound: float = float("inf")
    mistake: str = ""
    remedy: str = ""
    nonnegative: bool = False
    binary: bool = False


_GAIN = "looks like a gain in firmware units"
NUMBER = Quantity()
SECONDS = Quantity("s", nonnegative=True)
ANGLE = Quantity("rad", 7.0, "looks like degrees", "convert angles to radians")
RATE = Quantity("rad/s", 50.0, "looks like degrees per second or rpm", "convert angular velocities to rad/s")
BODY_RATE = Quantity("rad/s", 60.0, RATE.mistake, RATE.remedy)
FORCE = Quantity("m/s2", 1e5, "exceeds the range of any accelerometer", "convert to m/s2")
STIFFNESS = Quantity("A/rad", 100.0, _GAIN, "convert to A/rad or rename the column to <joint>.firmware_gain", True)
DAMPING = Quantity("A s/rad", 100.0, _GAIN, "convert to A s/rad or omit the column", True)
_TOO_LARGE = "exceeds the largest Dynamixel gain register, 16383"
FIRMWARE = Quantity("firmware units", 16383.0, _TOO_LARGE, "write the raw register value", True)
CURRENT = Quantity("A", 20.0, "looks like mA or register counts", "divide by 1000, or write `unit:` of the column")
FULL_SCALE = "divide by the full scale (100, or 885 on X-series Dynamixels) so that full duty is 1"
DUTY = Quantity("", 1.01, "looks like percent or a PWM register", FULL_SCALE)
VOLTAGE = Quantity("V", 30.0, "looks like units of 0.1 V or mV", "convert to volts", True)
_KELVIN = "subtract 273.15 to get degrees Celsius, or divide by 10"
TEMPERATURE = Quantity("C", 150.0, "looks like kelvin, or units of 0.1 C", _KELVIN)
SWITCH = Quantity(mistake="is not 0 or 1", remedy="write 0 for off and 1 for on", binary=True)
BYTE = Quantity("bits", 255.0, "does not fit into one byte", "write the raw register value", True)


@dataclass(frozen=True)
class Channel:
    """One measured or commanded quantity.

    Attributes:
        name: Key in the TensorDict, as text.
        quantity: Measured quantity with unit and bounds.
        column: CSV column; `{joint}`, `{axis}` and `{index}` are replaced by entries of the last axis.
        description: One sentence.
        marks: `required` if every log must have this channel; `hold` if the value holds until the next row, like a
            command, instead of sampling a signal.
    """

    name: str
    quantity: Quantity
    column: str
    description: str
    marks: str = ""

    @cached_property
    def key(self) -> Key:
        """Key in the TensorDict."""
        return normal_key(self.name)

    @cached_property
    def axes(self) -> str:
        """Last axis: `scalar` [1], `joint` [joint], `imu3` [3], or `vector` [any length]."""
        marks = {"{joint}": "joint", "{axis}": "imu3", "{index}": "vector"}
        return next((axes for mark, axes in marks.items() if mark in self.column), "scalar")

    @property
    def axis_names(self) -> tuple[str, str, str]:
        """Names along an `imu3` axis, as in the CSV."""
        return ("roll", "pitch", "yaw") if self.name == "imu/orientation" else ("x", "y", "z")

    @property
    def required(self) -> bool:
        """Whether every log has this channel."""
        return "required" in self.marks

    @property
    def hold(self) -> bool:
        """Whether the value holds until the next row."""
        return "hold" in self.marks

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return self.quantity.unit


def _register(unit: str) -> Quantity:
    return Quantity(unit, float(2**31), "does not fit into a register", "write the signed register value")


def key_name(key: Key) -> str:
    """A key as text: `joint/position`."""
    return key if isinstance(key, str) else "/".join(key)


def normal_key(key: str | Iterable[str]) -> Key:
    """A key as a tuple or text of the table; accepts `"joint/position"`, `("time",)` and lists."""
    parts = tuple(key.split("/")) if isinstance(key, str) else tuple(key)
    return parts[0] if len(parts) == 1 else parts  # type: ignore[return-value]


_POLICY, _AMPERE, _HOLD = "held between policy steps.", _register("2.69 mA"), "hold"
_DRIVES = "1 while the servo drives, 0 while it is switched off; present in logs in which it changes."
_FIRMWARE = "Proportional gain register of a servo that closes the position loop itself."
_UPWARDS = "Specific force in the body frame, +9.81 m/s2 upwards at rest."
_ANSWERED = "1 if the servo answered in this row; 0 if its values are from an earlier row."
_NINE = "Nine IMU registers: gyro x, y, z, accelerometer x, y, z, roll, pitch, yaw, in the sensor's axes."
_UNSHIFTED = "Present position register, without calibration offset."
_LATENESS = "Delay of this row's tick after its deadline."

_TABLE = (
    Channel("time", Quantity("s"), "time", "Time of the row, strictly increasing.", "required"),
    Channel("command/position", ANGLE, "{joint}.target", "Position target issued at this time.", "required hold"),
    Channel("command/p_gain", STIFFNESS, "{joint}.p_gain", "Proportional gain of the current controller.", _HOLD),
    Channel("command/d_gain", DAMPING, "{joint}.d_gain", "Derivative gain of the current controller.", _HOLD),
    Channel("command/torque_enable", SWITCH, "{joint}.torque_enable", _DRIVES, _HOLD),
    Channel("command/firmware_gain", FIRMWARE, "{joint}.firmware_gain", _FIRMWARE, _HOLD),
    Channel("joint/position", ANGLE, "{joint}.position", "Measured joint position.", "required"),
    Channel("joint/velocity", RATE, "{joint}.velocity", "Measured joint velocity."),
    Channel("joint/current", CURRENT, "{joint}.current", "Measured motor current."),
    Channel("joint/duty", DUTY, "{joint}.duty", "Measured PWM duty, -1 to 1."),
    Channel("joint/load", Quantity("as recorded"), "{joint}.load", "Load or torque reading in the recorder's unit."),
    Channel("joint/voltage", VOLTAGE, "{joint}.voltage", "Measured supply voltage at the servo."),
    Channel("joint/temperature", TEMPERATURE, "{joint}.temperature", "Measured servo temperature."),
    Channel("imu/orientation", ANGLE, "imu.{axis}", "Roll, pitch, yaw of the trunk."),
    Channel("imu/angular_velocity", BODY_RATE, "imu.gyro_{axis}", "Angular velocity in the body frame."),
    Channel("imu/linear_acceleration", FORCE, "imu.acc_{axis}", _UPWARDS),
    Channel("policy/observation", NUMBER, "policy.observation_{index}", f"Observation of the policy, {_POLICY}", _HOLD),
    Channel("policy/action", NUMBER, "policy.action_{index}", f"Action of the policy, {_POLICY}", _HOLD),
    Channel("policy/reward", NUMBER, "policy.reward", f"Reward of the policy step, {_POLICY}", _HOLD),
    Channel(
        "raw/goal_current", _AMPERE, "{joint}.raw_goal_current", "Last goal current sent, after all limits.", _HOLD
    ),
    Channel("raw/current", _AMPERE, "{joint}.raw_current", "Present current register."),
    Channel("raw/velocity", _register("0.229 rpm"), "{joint}.raw_velocity", "Present velocity register."),
    Channel("raw/position", _register("2 pi/4096 rad"), "{joint}.raw_position", _UNSHIFTED),
    Channel("raw/hardware_error", BYTE, "{joint}.raw_hardware_error", "Hardware error status register."),
    Channel("raw/answered", SWITCH, "{joint}.raw_answered", _ANSWERED, _HOLD),
    Channel("raw/imu", _register("counts"), "raw.imu_{index}", _NINE),
    Channel("raw/lateness", SECONDS, "raw.lateness", _LATENESS),
    Channel("done", SWITCH, "done", "True in the row that ends the episode (bool).", _HOLD),
)

CHANNELS: dict[Key, Channel] = {channel.key: channel for channel in _TABLE}
"""Every channel that a log may contain, by key and in CSV order."""


def column_names(channel: Channel, joints: Sequence[str], width: int | None = None) -> tuple[str, ...]:
    """CSV columns of a channel, one per entry of its last axis.

    Args:
        channel: Entry of `CHANNELS`.
        joints: Joint names in the log's order.
        width: Length of the last axis; needed for `vector` channels only.
    """
    if channel.axes == "joint":
        return tuple(channel.column.format(joint=joint) for joint in joints)
    if channel.axes == "imu3":
        return tuple(channel.column.format(axis=axis) for axis in channel.axis_names)
    if channel.axes == "vector":
        return tuple(channel.column.format(index=index) for index in range(width or 0))
    return (channel.column,)


COMMAND_CHANNELS = {
    ("command", "position"): "position_target",
    ("command", "p_gain"): "p_gain",
    ("command", "d_gain"): "d_gain",
    ("command", "firmware_gain"): "firmware_gain",
    ("command", "torque_enable"): "torque_enable",
    ("joint", "voltage"): "bus_voltage",
    ("joint", "temperature"): "temperature",
}
"""Channels of a log that drive the simulation, and the simulation's input for each.

Two of them are measured: the bus voltage and the servo temperatures."""


_SUFFIXES = {channel.column.split(".", 1)[1]: channel for channel in _TABLE if channel.axes == "joint"}
_FIXED = {
    name: channel for channel in _TABLE if channel.axes in ("scalar", "imu3") for name in column_names(channel, ())
}
_VECTORS = {channel.column.removesuffix("_{index}"): channel for channel in _TABLE if channel.axes == "vector"}


def place(name: str) -> tuple[Channel, str] | None:
    """The channel that a column of the wide CSV belongs to, and its joint, axis or index; None for other names."""
    joint, _, suffix = name.rpartition(".")
    if suffix in _SUFFIXES and joint and joint not in RESERVED:
        return _SUFFIXES[suffix], joint
    if name in _FIXED:
        return _FIXED[name], name
    entry = re.fullmatch(r"(.+)_(0|[1-9][0-9]{0,5})", name)
    return (_VECTORS[entry[1]], entry[2]) if entry and entry[1] in _VECTORS else None


def schema_table() -> str:
    """The table as Markdown, for documentation."""
    lines = ["| channel | unit | CSV column | meaning |", "|---|---|---|---|"]
    for channel in CHANNELS.values():
        column = channel.column.replace("{joint}", "<joint>").replace("{index}", "<i>")
        column = column.replace("{axis}", "|".join(channel.axis_names)).replace("|", "\\|")
        lines.append(f"| {key_name(channel.key)} | {channel.unit} | `{column}` | {channel.description} |")
    return "\n".join(lines) + "\n"
