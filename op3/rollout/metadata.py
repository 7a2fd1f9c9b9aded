"""The metadata of a log, and their YAML file."""

from __future__ import annotations

import dataclasses
import datetime
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BeforeValidator, Field

from op3.common.settings import Number, Positive, read_yaml, settings, shown
from op3.rollout.errors import LogError, located, rename
from op3.rollout.schema import RESERVED

ROBOTS = ("simulated", "emulated", "real", "rig")
HOLDING = ("stand", "pendulum")
"""Mounts that support the robot's weight, so that joints only carry their limbs."""

MOUNTS = ("floor", *HOLDING, "board", "board_weight", *(f"bricks_{kind}" for kind in "abcd"), "terrain")

OUTCOMES = ("travelled_distance", "episode_duration", "fallen")
"""Fields with one value per episode in a batch."""

_JOINT_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_UNITS = {"rate": "Hz", "mass": "kg", "length": "m", "battery": "V", "policy_rate": "Hz"}
_UNITS |= {"travelled_distance": "m", "episode_duration": "s"}


def _plain(value: Any) -> Any:
    """Values as YAML loads them: numpy scalars and arrays, tuples, dates and paths become plain values."""
    if isinstance(value, Mapping):
        return {str(name): _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path | datetime.date):
        return str(value) if isinstance(value, Path) else value.isoformat()
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, str | bool | int | float | None):
        return value
    raise _wrong("extra", "a plain value (text, number, true/false, list or mapping)", value)


def _tuple(value: Any) -> Any:
    value = _plain(value)
    return tuple(value) if isinstance(value, list) else value


def _wrong(name: str, wanted: str, value: Any) -> LogError:
    """The error for a field's value, with the unit if there is one."""
    name = name.partition(".")[0]
    wanted = {"above 0": "a positive number", "as it is described": "a value of another type"}.get(wanted, wanted)
    wanted += f" [{_UNITS[name]}]" if name in _UNITS else ""
    return LogError(f"{shown(value)} is not {wanted}", f"write {wanted}", column=f"field {name}")


Names = Annotated[tuple[str, ...], BeforeValidator(_tuple)]
Text = Annotated[str | None, Field(min_length=1)]
Outcome = Annotated[float | tuple[Number, ...] | None, BeforeValidator(_tuple)]
Gain = Annotated[Number, Field(ge=0)] | None
Integer = Annotated[int | None, BeforeValidator(_plain)]


@settings(raises=_wrong)
class Metadata:
    """The metadata of a log: everything except its samples.

    Attributes:
        joints: Joint names, in the order of every [joint] axis.
        robot: Kind of robot: `simulated`, `emulated`, `real` or `rig` (a servo on a test bench).
        mount: Support of the robot: `stand` or `pendulum`, or the ground: `floor`, `board`, `board_weight`, `bricks_a`
            to `bricks_d` or `terrain`.
        rate: Rows per second [Hz].
        mass: Mass at the end of the pendulum [kg]; required for the pendulum.
        length: Distance from the servo's axis to that mass [m]; required for the pendulum.
        battery: Nominal supply voltage [V].
        robot_file: The robot that has these joints: a name in `assets/robots` or the path of a robot file; None: the
            OP3, or the bench for a pendulum.
        servo: Servo type, such as `xm430-w350` or `xl330`.
        firmware_gain: Proportional gain register of servos that close the loop themselves [firmware units].
        p_gain: Proportional gain of all joints if no column has gains [A/rad].
        d_gain: Derivative gain of all joints if no column has gains [A s/rad].
        policy_rate: Policy steps per second [Hz].
        motion: Name of the motion or trajectory.
        recording: Identifier of the recording; logs of one session may share the part before a slash.
        model_hash: Hash of the model file that simulated or controlled the robot.
        git_hash: Commit of the code that wrote the log.
        seed: Seed of all random numbers in the log.
        date: Date of the recording, ISO 8601.
        travelled_distance: Distance walked [m]; one number, or one per episode.
        episode_duration: Duration of the episode [s]; one number, or one per episode.
        fallen: Whether the robot fell; one truth value, or one per episode.
        complete: False if a crash interrupted the recording.
        set_aside: Columns without valid measurements, see `Rollout.measured`.
        extra: Further information as plain YAML values.
    """

    joints: Names
    robot: str
    mount: str
    rate: Positive
    mass: Positive | None = None
    length: Positive | None = None
    battery: Positive | None = None
    robot_file: Text = None
    servo: Text = None
    firmware_gain: Gain = None
    p_gain: Gain = None
    d_gain: Gain = None
    policy_rate: Positive | None = None
    motion: Text = None
    recording: Text = None
    model_hash: Text = None
    git_hash: Text = None
    seed: Integer = None
    date: Annotated[str | None, BeforeValidator(_plain)] = None
    travelled_distance: Outcome = None
    episode_duration: Outcome = None
    fallen: Annotated[bool | tuple[bool, ...] | None, BeforeValidator(_tuple)] = None
    complete: bool = True
    set_aside: Names = ()
    extra: Annotated[dict[str, Any], BeforeValidator(_plain)] = dataclasses.field(default_factory=dict, hash=False)

    def __post_init__(self):
        for name in self.joints or (None,):
            if not isinstance(name, str) or not _JOINT_NAME.fullmatch(name) or name in RESERVED:
                raise _wrong("joints", "a name of letters, digits, _ and - other than imu, policy and raw", name)
            if self.joints.count(name) > 1:
                raise LogError(f"joint {name} is listed twice", "list each joint once", column="field joints")
        for name, choices in (("robot", ROBOTS), ("mount", MOUNTS)):
            own = name == "mount" and "." in str(self.mount)  # a scene from the user's module
            if getattr(self, name) not in choices and not own:
                raise _wrong(name, "one of " + ", ".join(choices), getattr(self, name))
        for name in ("mass", "length"):
            if self.mount == "pendulum" and getattr(self, name) is None:
                remedy = f"add `{name}: <value in {_UNITS[name]}>`"
                raise LogError("a pendulum needs mass and length", remedy, column=f"field {name}")
        try:
            datetime.datetime.fromisoformat(self.date or "2026-01-15")
        except ValueError:
            raise _wrong("date", "an ISO 8601 date such as '2026-01-15T10:28:10'", self.date) from None

    def replace(self, **changes: Any) -> Metadata:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Plain YAML values; empty fields are left out."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values = {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
        return {name: v for name, v in values.items() if v not in (None, {}, [])}

    @classmethod
    def from_dict(
        cls, values: Mapping[str, Any], source: str | Path = "metadata", beside: Sequence[str] = ()
    ) -> Metadata:
        """Build from plain values; errors name missing and unknown fields, with suggestions also from `beside`."""
        known = [f.name for f in dataclasses.fields(cls)]
        with located(source=source):
            for name in values:
                if name not in known:
                    remedy = rename(name, [*known, *beside], "move it under `extra:`")
                    raise LogError("no such field", remedy, column=f"field {str(name)[:60]!r}")
            for name in ("joints", "robot", "mount", "rate"):
                if values.get(name) is None:
                    remedy = f"add `{name}:` to the metadata"
                    raise LogError("the field is missing", remedy, column=f"field {name}")
            return cls(**{name: value for name, value in values.items() if value is not None})

    def to_yaml(self) -> str:
        """The text of `metadata.yaml` and of a CSV's sidecar."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False, default_flow_style=None)

    @classmethod
    def read(cls, path: str | Path) -> Metadata:
        """Read a YAML file."""
        return cls.from_dict(read_yaml(path, LogError), path)
