"""What is known about a log besides its samples, and its YAML file."""

from __future__ import annotations

import dataclasses
import datetime
import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from op3.rollout.errors import LogError

ROBOTS = ("simulated", "emulated", "real", "rig")
MOUNTS = (
    "floor",
    "stand",
    "pendulum",
    "board",
    "board_weight",
    "bricks_a",
    "bricks_b",
    "bricks_c",
    "bricks_d",
    "terrain",
)

_JOINT_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_RESERVED = ("imu", "policy", "raw")
_REQUIRED = ("joints", "robot", "mount", "rate")


@dataclass(frozen=True)
class Metadata:
    """What is known about a log besides its samples.

    Attributes:
        joints: Joint names, in the order of every [joint] axis.
        robot: Who made the log: `simulated`, `emulated`, `real` or `rig` (a servo on a test bench).
        mount: What holds the robot: `stand` or `pendulum`, or what it stands on: `floor`, `board`, `board_weight`,
            `bricks_a` to `bricks_d` or `terrain`.
        rate: Rows per second [Hz].
        mass: Mass at the end of the pendulum [kg]; required for the pendulum.
        length: Distance from the servo's axis to that mass [m]; required for the pendulum.
        battery: Nominal supply voltage [V].
        servo: Servo type, such as `xm430-w350` or `xl330`.
        firmware_gain: Proportional gain register of servos that close the loop themselves [firmware units].
        policy_rate: Policy steps per second [Hz].
        motion: Name of the motion or trajectory.
        recording: Identity of the recording; logs of one sitting may share the part before a slash.
        model_hash: Hash of the model file that made or drove the log.
        git_hash: Commit of the code that made the log.
        seed: Seed of every random number in the log.
        date: When it was recorded, ISO 8601.
        travelled_distance: Distance walked [m]; one number, or one per episode.
        episode_duration: Duration of the episode [s]; one number, or one per episode.
        fallen: Whether the robot fell; one truth value, or one per episode.
        complete: False where a crash ended the recording before it was closed.
        extra: Anything else, as plain YAML values.
    """

    joints: tuple[str, ...]
    robot: str
    mount: str
    rate: float
    mass: float | None = None
    length: float | None = None
    battery: float | None = None
    servo: str | None = None
    firmware_gain: float | None = None
    policy_rate: float | None = None
    motion: str | None = None
    recording: str | None = None
    model_hash: str | None = None
    git_hash: str | None = None
    seed: int | None = None
    date: str | None = None
    travelled_distance: float | tuple[float, ...] | None = None
    episode_duration: float | tuple[float, ...] | None = None
    fallen: bool | tuple[bool, ...] | None = None
    complete: bool = True
    extra: dict[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self):
        self._set("joints", _joints(self.joints))
        self._set("robot", _choice("robot", self.robot, ROBOTS))
        self._set("mount", _choice("mount", self.mount, MOUNTS))
        self._set("rate", _number("rate", self.rate, "Hz"))
        for name, unit in (("mass", "kg"), ("length", "m"), ("battery", "V"), ("policy_rate", "Hz")):
            if getattr(self, name) is not None:
                self._set(name, _number(name, getattr(self, name), unit))
            elif self.mount == "pendulum" and name in ("mass", "length"):
                raise LogError(
                    "a pendulum needs its mass and length",
                    f"add `{name}: <value in {unit}>`",
                    column=f"field {name}",
                )
        if self.firmware_gain is not None:
            self._set("firmware_gain", _number("firmware_gain", self.firmware_gain, "", positive=False))
        for name in ("servo", "motion", "recording", "model_hash", "git_hash"):
            if getattr(self, name) is not None:
                self._set(name, _text(name, getattr(self, name)))
        if self.date is not None:
            self._set("date", _date(self.date))
        if self.seed is not None:
            self._set("seed", _integer("seed", self.seed))
        for name, unit in (("travelled_distance", "m"), ("episode_duration", "s")):
            self._set(name, _per_episode(getattr(self, name), lambda v, n=name, u=unit: _number(n, v, u, None)))
        self._set("fallen", _per_episode(self.fallen, lambda v: _truth("fallen", v)))
        self._set("complete", _truth("complete", self.complete))
        if not isinstance(self.extra, Mapping):
            raise _wrong("extra", self.extra, "a mapping of names to values")
        self._set("extra", _plain(self.extra))

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def replace(self, **changes: Any) -> Metadata:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Plain YAML values; fields that say nothing are left out."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        values = {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
        return {name: v for name, v in values.items() if v is not None and v != {}}

    @classmethod
    def from_dict(cls, values: object, source: str | Path = "metadata") -> Metadata:
        """Build from plain values, refusing missing and unknown fields by name."""
        if not isinstance(values, Mapping):
            remedy = "write one `field: value` per line"
            raise LogError(f"the metadata is {_kind(values)} and not a mapping", remedy, source=source)
        known = [f.name for f in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                close = difflib.get_close_matches(str(name), known, n=1)
                remedy = f"rename it `{close[0]}` if that is meant" if close else "move it under `extra:`"
                raise LogError("no such field", remedy, source=source, column=f"field {str(name)[:60]!r}")
        for name in _REQUIRED:
            if values.get(name) is None:
                remedy = f"add `{name}:` to the metadata"
                raise LogError("the field is missing", remedy, source=source, column=f"field {name}")
        try:
            return cls(**{name: value for name, value in values.items() if value is not None})
        except LogError as error:
            raise error.at(source) from None

    def to_yaml(self) -> str:
        """The text of `metadata.yaml` and of a CSV's sidecar."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False, default_flow_style=None)

    @classmethod
    def read(cls, path: str | Path) -> Metadata:
        """Read a YAML file."""
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            problem = f"the metadata cannot be read ({getattr(error, 'strerror', None) or 'not UTF-8 text'})"
            raise LogError(problem, "write a UTF-8 YAML file there", source=path) from None
        try:
            values = yaml.safe_load(text)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            problem = f"invalid YAML at line {line} ({error.problem})"
            raise LogError(problem, "correct that line", source=path) from None
        except (yaml.YAMLError, ValueError, OverflowError, RecursionError, AttributeError, TypeError):
            # PyYAML lets errors of its value constructors (a date 2026-99-99) through unmarked.
            remedy = "write plain `field: value` lines with valid dates and numbers"
            raise LogError("invalid YAML", remedy, source=path) from None
        return cls.from_dict(values, path)


def _kind(value: object) -> str:
    return "empty" if value is None else f"a {type(value).__name__}"


def _wrong(name: str, value: object, wanted: str) -> LogError:
    return LogError(f"{_show(value)} is not {wanted}", f"write {wanted}", column=f"field {name}")


def _show(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _number(name: str, value: object, unit: str, positive: bool | None = True) -> float:
    """A finite float; `positive` True asks for > 0, False for >= 0, None for any sign."""
    wanted = {True: "a positive number", False: "a number of at least 0", None: "a number"}[positive]
    wanted += f" [{unit}]" if unit else ""
    item = getattr(value, "item", None)
    value = item() if callable(item) else value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong(name, value, wanted)
    try:
        number = float(value)
    except OverflowError:
        raise _wrong(name, value, wanted) from None
    if not math.isfinite(number) or (positive and number <= 0) or (positive is False and number < 0):
        raise _wrong(name, value, wanted)
    return number


def _integer(name: str, value: object) -> int:
    item = getattr(value, "item", None)
    value = item() if callable(item) else value
    if isinstance(value, bool) or not isinstance(value, int):
        raise _wrong(name, value, "a whole number")
    return value


def _truth(name: str, value: object) -> bool:
    item = getattr(value, "item", None)
    value = item() if callable(item) else value
    if not isinstance(value, bool):
        raise _wrong(name, value, "true or false")
    return value


def _text(name: str, value: object) -> str:
    if not isinstance(value, str) or not value:
        raise _wrong(name, value, "a text (quote it if it looks like a number)")
    return value


def _date(value: object) -> str:
    """ISO 8601 text; YAML turns an unquoted date into a date object, which is turned back."""
    if isinstance(value, datetime.date):
        return value.isoformat()
    wanted = "an ISO 8601 date such as '2026-01-15T10:28:10'"
    try:
        datetime.datetime.fromisoformat(_text("date", value))
    except ValueError:
        raise _wrong("date", value, wanted) from None
    return str(value)


def _choice(name: str, value: object, choices: tuple[str, ...]) -> str:
    if not isinstance(value, str) or value not in choices:
        raise _wrong(name, value, "one of " + ", ".join(choices))
    return value


def _joints(value: object) -> tuple[str, ...]:
    if isinstance(value, str) or not isinstance(value, list | tuple) or not value:
        raise _wrong("joints", value, "a list of joint names")
    for name in value:
        if not isinstance(name, str) or not _JOINT_NAME.fullmatch(name) or name in _RESERVED:
            raise _wrong("joints", name, "a joint name of letters, digits, _ and -, and not imu, policy or raw")
        if value.count(name) > 1:
            raise LogError(f"joint {name} is listed twice", "list each joint once", column="field joints")
    return tuple(value)


def _per_episode(value: Any, check: Any) -> Any:
    if value is None:
        return None
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(check(v) for v in value) if isinstance(value, list | tuple) else check(value)


def _plain(value: Any) -> Any:
    """Values as YAML gives them back: numpy scalars and arrays, tuples and paths become plain."""
    if isinstance(value, Mapping):
        return {str(name): _plain(v) for name, v in value.items()}
    if isinstance(value, str | bool | int | float | None):
        return value
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path | datetime.date):
        return str(value) if isinstance(value, Path) else value.isoformat()
    if hasattr(value, "tolist"):
        return value.tolist()
    raise _wrong("extra", value, "a plain value (text, number, true/false, list or mapping)")
