"""The channels of a log: one table from which validation, CSV headers and documentation derive.

A log is a TensorDict of batch size [time] or [episode, time]. A row holds the sensors at `time` and then the
command issued at that time. Units are SI; orientation is R = Rz(yaw) Ry(pitch) Rx(roll); body rates and
specific force (+9.81 m/s2 upwards at rest) are in the body frame. A channel that was not measured is absent.

Policy channels change once per policy step. In a log whose rows are faster than the policy they are held
between policy steps, and the metadata's `policy_rate` says how fast the policy was.

The `raw` group keeps what crossed the bus of a real or emulated robot, in whole register units, so that a doubt
about conversion, calibration, limits or lost replies can be settled from the log alone. Consumers read the SI
channels; the raw ones are for checking.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

Key = str | tuple[str, str]
"""A TensorDict key: `"time"`, `("joint", "position")`."""


@dataclass(frozen=True)
class Channel:
    """One measured or commanded quantity.

    Attributes:
        key: Key in the TensorDict.
        unit: Unit, as printed in messages and tables; empty for pure numbers.
        axes: Last axis: `scalar` [1], `joint` [joint], `imu3` [3], or `vector` [any length].
        description: One sentence.
        column: CSV column; `{joint}`, `{axis}` and `{index}` stand for the last axis.
        bound: Largest plausible absolute value [unit]; beyond it the unit is wrong.
        mistake: What a value beyond the bound looks like.
        remedy: What to do about it.
        nonnegative: Whether values below zero are impossible.
        binary: Whether only 0 and 1 are possible.
        required: Whether every log has this channel.
        hold: Whether the value holds until the next row (a command), instead of being a sample of a signal.
        axis_names: Names along an `imu3` axis, as in the CSV.
    """

    key: Key
    unit: str
    axes: str
    description: str
    column: str
    bound: float = float("inf")
    mistake: str = ""
    remedy: str = ""
    nonnegative: bool = False
    binary: bool = False
    required: bool = False
    hold: bool = False
    axis_names: tuple[str, ...] = ()


_RADIANS: dict[str, Any] = dict(bound=7.0, mistake="looks like degrees", remedy="convert angles to radians")
_RATES: dict[str, Any] = dict(
    mistake="looks like degrees per second or rpm", remedy="convert angular velocities to rad/s"
)
_GAINS: dict[str, Any] = dict(bound=100.0, mistake="looks like a gain in firmware units", nonnegative=True, hold=True)
_SWITCH: dict[str, Any] = dict(mistake="is not 0 or 1", remedy="write 0 for off and 1 for on", binary=True, hold=True)
_COUNTS: dict[str, Any] = dict(
    bound=float(2**31), mistake="does not fit into a register", remedy="write the register's value, sign included"
)
_XYZ = ("x", "y", "z")

_TABLE = (
    Channel("time", "s", "scalar", "Time of the row, strictly increasing.", "time", required=True),
    Channel(
        ("command", "position"),
        "rad",
        "joint",
        "Position target issued at this time.",
        "{joint}.target",
        required=True,
        hold=True,
        **_RADIANS,
    ),
    Channel(
        ("command", "p_gain"),
        "A/rad",
        "joint",
        "Proportional gain of the current controller.",
        "{joint}.p_gain",
        remedy="convert to A/rad or name the column <joint>.firmware_gain",
        **_GAINS,
    ),
    Channel(
        ("command", "d_gain"),
        "A s/rad",
        "joint",
        "Derivative gain of the current controller.",
        "{joint}.d_gain",
        remedy="convert to A s/rad or leave the column out",
        **_GAINS,
    ),
    Channel(
        ("command", "torque_enable"),
        "",
        "joint",
        "1 while the servo drives, 0 while it is switched off; present where it changes.",
        "{joint}.torque_enable",
        **_SWITCH,
    ),
    Channel(
        ("command", "firmware_gain"),
        "firmware units",
        "joint",
        "Proportional gain register of a servo that closes the position loop itself.",
        "{joint}.firmware_gain",
        bound=16383.0,
        mistake="is beyond the largest Dynamixel gain register, 16383",
        remedy="write the register's value",
        nonnegative=True,
        hold=True,
    ),
    Channel(
        ("joint", "position"),
        "rad",
        "joint",
        "Measured joint position.",
        "{joint}.position",
        required=True,
        **_RADIANS,
    ),
    Channel(
        ("joint", "velocity"),
        "rad/s",
        "joint",
        "Measured joint velocity.",
        "{joint}.velocity",
        bound=50.0,
        **_RATES,
    ),
    Channel(
        ("joint", "current"),
        "A",
        "joint",
        "Measured motor current.",
        "{joint}.current",
        bound=20.0,
        mistake="looks like mA",
        remedy="divide by 1000",
    ),
    Channel(
        ("joint", "duty"),
        "",
        "joint",
        "Measured PWM duty, -1 to 1.",
        "{joint}.duty",
        bound=1.01,
        mistake="looks like percent or a PWM register",
        remedy="divide by the full scale (100, or 885 on X-series Dynamixels) so that full duty is 1",
    ),
    Channel(
        ("joint", "voltage"),
        "V",
        "joint",
        "Measured supply voltage at the servo.",
        "{joint}.voltage",
        bound=30.0,
        mistake="looks like units of 0.1 V or mV",
        remedy="convert to volts",
        nonnegative=True,
    ),
    Channel(
        ("joint", "temperature"),
        "C",
        "joint",
        "Measured servo temperature.",
        "{joint}.temperature",
        bound=150.0,
        mistake="looks like kelvin",
        remedy="subtract 273.15 to get degrees Celsius",
    ),
    Channel(
        ("imu", "orientation"),
        "rad",
        "imu3",
        "Roll, pitch, yaw of the trunk.",
        "imu.{axis}",
        axis_names=("roll", "pitch", "yaw"),
        **_RADIANS,
    ),
    Channel(
        ("imu", "angular_velocity"),
        "rad/s",
        "imu3",
        "Angular velocity in the body frame.",
        "imu.gyro_{axis}",
        bound=60.0,
        axis_names=_XYZ,
        **_RATES,
    ),
    Channel(
        ("imu", "linear_acceleration"),
        "m/s2",
        "imu3",
        "Specific force in the body frame, +9.81 m/s2 upwards at rest.",
        "imu.acc_{axis}",
        bound=1e5,
        mistake="is beyond anything an accelerometer reads",
        remedy="convert to m/s2",
        axis_names=_XYZ,
    ),
    Channel(
        ("policy", "observation"),
        "",
        "vector",
        "What the policy saw, held between policy steps.",
        "policy.observation_{index}",
        hold=True,
    ),
    Channel(
        ("policy", "action"),
        "",
        "vector",
        "What the policy answered, held between policy steps.",
        "policy.action_{index}",
        hold=True,
    ),
    Channel(
        ("policy", "reward"),
        "",
        "scalar",
        "Reward of the policy step, held between policy steps.",
        "policy.reward",
        hold=True,
    ),
    Channel(
        ("raw", "goal_current"),
        "2.69 mA",
        "joint",
        "Goal current last written to the servo, after every limit.",
        "{joint}.raw_goal_current",
        hold=True,
        **_COUNTS,
    ),
    Channel(("raw", "current"), "2.69 mA", "joint", "Present current register.", "{joint}.raw_current", **_COUNTS),
    Channel(("raw", "velocity"), "0.229 rpm", "joint", "Present velocity register.", "{joint}.raw_velocity", **_COUNTS),
    Channel(
        ("raw", "position"),
        "2 pi/4096 rad",
        "joint",
        "Present position register, without calibration offset.",
        "{joint}.raw_position",
        **_COUNTS,
    ),
    Channel(
        ("raw", "hardware_error"),
        "bits",
        "joint",
        "Hardware error status register.",
        "{joint}.raw_hardware_error",
        bound=255.0,
        mistake="does not fit into one byte",
        remedy="write the register's value",
        nonnegative=True,
    ),
    Channel(
        ("raw", "answered"),
        "",
        "joint",
        "1 where the servo answered in this row; 0 where its values are those of an earlier row.",
        "{joint}.raw_answered",
        **_SWITCH,
    ),
    Channel(
        ("raw", "imu"),
        "counts",
        "vector",
        "Nine IMU registers: gyro x, y, z, accelerometer x, y, z, roll, pitch, yaw, in the sensor's own axes.",
        "raw.imu_{index}",
        **_COUNTS,
    ),
    Channel(
        ("raw", "lateness"),
        "s",
        "scalar",
        "How long after its deadline the tick of this row began.",
        "raw.lateness",
        nonnegative=True,
    ),
    Channel("done", "", "scalar", "True in the row that ends the episode (bool).", "done", **_SWITCH),
)

CHANNELS: dict[Key, Channel] = {channel.key: channel for channel in _TABLE}
"""Every channel a log may hold, by key and in CSV order."""


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


def joint_suffixes() -> dict[str, Channel]:
    """What may follow `<joint>.` in a column name, and the channel it names."""
    return {c.column.split(".", 1)[1]: c for c in CHANNELS.values() if c.axes == "joint"}


def vector_column(name: str) -> tuple[Channel, int] | None:
    """The vector channel and index that a column such as `policy.action_3` names, or None."""
    match = re.fullmatch(r"(.+)_(0|[1-9][0-9]{0,5})", name)
    if match is None:
        return None
    for channel in CHANNELS.values():
        if channel.axes == "vector" and channel.column == match[1] + "_{index}":
            return channel, int(match[2])
    return None


def key_name(key: Key) -> str:
    """A key as text: `joint/position`."""
    return key if isinstance(key, str) else "/".join(key)


def normal_key(key: str | Iterable[str]) -> Key:
    """A key as the table spells it; `"joint/position"`, `("time",)` and lists are understood."""
    parts = tuple(key.split("/")) if isinstance(key, str) else tuple(key)
    return parts[0] if len(parts) == 1 else parts  # type: ignore[return-value]


def schema_table() -> str:
    """The table as Markdown, for documentation."""
    lines = ["| channel | unit | CSV column | meaning |", "|---|---|---|---|"]
    for channel in CHANNELS.values():
        column = channel.column.replace("{joint}", "<joint>").replace("{index}", "<i>")
        column = column.replace("{axis}", "|".join(channel.axis_names)).replace("|", "\\|")
        lines.append(f"| {key_name(channel.key)} | {channel.unit} | `{column}` | {channel.description} |")
    return "\n".join(lines) + "\n"
