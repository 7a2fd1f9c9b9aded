"""Map from actions to target angles and P gains of the controlled joints (paper Sec. action space)."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from op3.common.settings import GAIN_HIGH, GAIN_LOW, Listed, NotNegative, Number, Some, Text, nearest, settings
from op3.robot import DEFAULT, Robot, load_robot

Array = TypeVar("Array", NDArray[Any], torch.Tensor)

D_GAIN = 0.1
"""D gain [A s/rad] of every joint (paper Sec. action space)."""

SPAN = 0.6
"""Largest distance of a target from the stand pose [rad]; the paper gives no number.

With it, a leg can compensate 10 degrees of tilt at hip and ankle and shorten by half of its travel. Every controlled
joint stays inside its soft limits, so that action 0 is the stand pose.
"""


HELD_GAIN = 6.0
"""P gain of joints without a commanded gain [A/rad], such as joints that hold the stand pose."""


@settings("action map")
class ActionMap:
    """Actions in [-1, 1] as target angles and P gains, both linear in the action.

    An action ``[..., 2 joint]`` contains the angles of all joints, then their gains; without commanded gains it
    contains only angles. Values beyond [-1, 1] are clipped, so no action commands an angle outside the range.

    Attributes:
        joints: the controlled joints, in the order of the action.
        position_low: target angle [rad] of each joint at action -1.
        position_high: target angle [rad] of each joint at action +1.
        gain_low: P gain at action -1 [A/rad]; None: actions command no gains. Current-controlled servos then get
            `HELD_GAIN`.
        gain_high: P gain at action +1 [A/rad]; if equal to `gain_low`, the gain is fixed.
        d_gain: D gain of every joint [A s/rad].
        robot: robot of these joints.
    """

    joints: Some[str]
    position_low: Listed[Number]
    position_high: Listed[Number]
    gain_low: NotNegative | None = GAIN_LOW
    gain_high: NotNegative | None = GAIN_HIGH
    d_gain: NotNegative = D_GAIN
    robot: Text = DEFAULT  # for manifests without a robot

    def __post_init__(self):
        robot = load_robot(self.robot)
        limits = robot.limits[robot.indices(self.joints)]
        if len(set(self.joints)) != len(self.joints):
            raise ValueError(f"action map: each joint must be listed once, got {', '.join(self.joints)}")
        for name in ("position_low", "position_high"):
            if len(getattr(self, name)) != len(self.joints):
                given = len(getattr(self, name))
                raise ValueError(f"action map: {name} has {given} angles for {len(self.joints)} joints")
        for joint, (lowest, highest), low, high in zip(
            self.joints, limits.tolist(), self.position_low, self.position_high, strict=True
        ):
            if not lowest <= low < high <= highest:
                raise ValueError(
                    f"action map: {joint} ranges from {low} to {high} rad; it must rise within [{lowest}, {highest}]"
                )
        if (self.gain_low is None) != (self.gain_high is None):
            raise ValueError("action map: give both gain_low and gain_high, or neither")
        if self.gain_low is not None and self.gain_high is not None and not self.gain_low <= self.gain_high:
            raise ValueError(
                f"action map: gain_high must not be below gain_low, got {self.gain_low} to {self.gain_high} A/rad"
            )

    @classmethod
    def of_terms(cls, terms: Mapping[str, Mapping[str, Any]], robot: Robot) -> "ActionMap":
        """The action map of a task's action terms.

        Args:
            terms: ``position`` with ``span`` [rad] about the home pose and ``joints``, by default those that the
                robot's file calls controlled; ``p_gain`` with ``low`` and ``high`` [A/rad], equal for a fixed gain, or
                none for servos that close their own loop.

        Raises:
            ValueError: if a field is unknown or missing; the message names the term and the field.
        """
        known = {"position": ("span", "joints"), "p_gain": ("low", "high"), "d_gain": ("value",)}
        for name, fields in terms.items():
            if name not in known:
                raise ValueError(f"actions.{name}: unknown action term{nearest(name, known)}")
            if unknown := [entry for entry in fields if entry not in known[name]]:
                raise ValueError(f"actions.{name}.{unknown[0]}: unknown field{nearest(unknown[0], known[name])}")
        if "position" not in terms:
            raise ValueError("actions.position is missing: give it, for example {span: 0.4}")
        gain, joints, span = terms.get("p_gain"), terms["position"].get("joints"), terms["position"].get("span", SPAN)
        if type(span) not in (int, float) or not span > 0:
            raise ValueError(f"actions.position.span must be a number above 0, got {span!r}")
        if unknown := [joint for joint in joints or () if joint not in robot.joints]:
            raise ValueError(
                f"actions.position.joints: unknown joint {unknown[0]!r}{nearest(unknown[0], robot.joints)}"
            )
        made = cls.around_stand(robot, span, None if joints is None else tuple(joints))
        if gain is None or all(servo.loop == "firmware" for servo in robot.servos):
            return dataclasses.replace(made, gain_low=None, gain_high=None)
        low, high = gain.get("low", GAIN_LOW), gain.get("high", GAIN_HIGH)
        d_gain = terms.get("d_gain", {}).get("value", D_GAIN)
        return dataclasses.replace(made, gain_low=low, gain_high=high, d_gain=d_gain)

    @classmethod
    def around_stand(cls, robot: Robot, span: float = SPAN, joints: tuple[str, ...] | None = None) -> "ActionMap":
        """Targets within `span` [rad] of the stand pose, clipped to the soft limits.

        Args:
            robot: robot with stand pose, joints and limits.
            span: largest distance from the stand pose [rad].
            joints: the controlled joints; None: those of the robot.
        """
        joints = robot.controlled if joints is None else joints
        places = robot.indices(joints)
        stand, limits = robot.home[places], robot.limits[places].T
        lowest, highest = (np.clip(np.round(stand + side, 9), *limits).tolist() for side in (-span, span))
        return cls(tuple(joints), tuple(lowest), tuple(highest), robot=robot.reference)

    @property
    def span(self) -> float:
        """Largest distance of a target from the stand pose [rad]."""
        stand = load_robot(self.robot).home[self._places]
        return float(np.abs(np.array([self.position_low, self.position_high]) - stand).max())

    @property
    def size(self) -> int:
        """Number of entries in an action: an angle per joint, and a gain per joint if commanded."""
        return (1 if self.gain_low is None else 2) * len(self.joints)

    def targets(self, action: Array) -> tuple[Array, Array]:
        """Target angles and P gains of actions.

        Args:
            action: [..., 2 joint], numpy or torch.

        Returns:
            position_target [..., joint] in rad and p_gain [..., joint] in A/rad, of the same array type as the action;
            gains are empty, [..., 0], for servos that close their own loop.

        Raises:
            ValueError: if the last axis has another length.
        """
        self._check(action, self.size, "an action")
        low, high = self._bounds(action)
        share = (action.clip(-1.0, 1.0) + 1.0) / 2.0
        values = low + share * (high - low)
        return values[..., : len(self.joints)], values[..., len(self.joints) :]

    def commands(self, action: Array) -> dict[str, Any]:
        """Commands of all joints for an action; joints that are not controlled hold the stand pose.

        Tasks, environments and the real robot all use this function.

        Args:
            action: [..., 2 joint], numpy or torch.

        Returns:
            position_target in rad, p_gain in A/rad and d_gain in A s/rad, each [..., robot joint] of the same array
            type as the action; for servos that close their own loop also firmware_gain in firmware units.
        """
        position, p_gain = self.targets(action)
        robot = load_robot(self.robot)
        nothing, count = position[..., :0], len(robot.joints)
        commands = {
            "position_target": self._whole(robot.home, position),
            "p_gain": self._whole(np.full(count, HELD_GAIN), p_gain),
            "d_gain": self._whole(np.full(count, self.d_gain), nothing),
        }
        if any(robot.firmware_gain):
            commands["firmware_gain"] = self._whole(robot.firmware_gain, nothing)
        return commands

    def _whole(self, rest: NDArray[np.float64], values: Any) -> Any:
        """Values of all joints: those given for the controlled joints, the others at rest."""
        whole = np.broadcast_to(rest, (*values.shape[:-1], len(rest))).copy()
        full: Any = torch.from_numpy(whole).to(values) if isinstance(values, torch.Tensor) else whole
        if values.shape[-1]:
            full[..., self._places] = values
        return full

    def action(self, position_target: Array, p_gain: Array) -> Array:
        """The action that commands these targets; the inverse of `targets`.

        Args:
            position_target: [..., joint] in rad, clipped to the range.
            p_gain: [..., joint] in A/rad, clipped to the range; ignored for servos that close their own loop.

        Returns:
            [..., 2 joint] in [-1, 1].
        """
        self._check(position_target, len(self.joints), "position_target")
        if self.gain_low is None:
            p_gain = position_target[..., :0]
        else:
            self._check(p_gain, len(self.joints), "p_gain")
        if isinstance(position_target, torch.Tensor):
            values: Any = torch.cat([position_target, torch.as_tensor(p_gain).to(position_target)], -1)
        else:
            values = np.concatenate([position_target, p_gain], -1)
        low, high = self._bounds(values)
        fixed = high == low  # every action commands this gain; 0 is the middle
        return (2.0 * values.clip(low, high) - low - high) / (high - low + fixed)

    def stand(self, p_gain: float | None = None) -> NDArray[np.float64]:
        """The action [2 joint] that holds the stand pose.

        Args:
            p_gain: P gain of every joint [A/rad]; None: the highest.
        """
        gain = self.gain_high if p_gain is None else p_gain
        return self.action(load_robot(self.robot).home[self._places], np.full(len(self.joints), gain or 0.0))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a manifest."""
        values = dataclasses.asdict(self)
        return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "ActionMap":
        """The inverse of `to_dict`.

        Raises:
            ValueError: if a field is missing, unknown or impossible; the message names it.
        """
        known = {field.name for field in dataclasses.fields(cls)}
        # bundles without a robot are for the default robot
        if not isinstance(values, Mapping) or {*values, "robot"} != known:
            given = ", ".join(map(str, values)) if isinstance(values, Mapping) else repr(values)
            raise ValueError(f"action map: needs exactly the fields {', '.join(sorted(known))}, got {given}")
        return cls(**values)

    @cached_property
    def _range(self) -> NDArray[np.float64]:
        """Lowest and highest commands [2, 2 joint]."""
        count = 0 if self.gain_low is None else len(self.joints)
        return np.array(
            [
                (*self.position_low, *[self.gain_low] * count),
                (*self.position_high, *[self.gain_high] * count),
            ],
            dtype=float,
        )

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        """Index of each controlled joint among the robot's joints."""
        return load_robot(self.robot).indices(self.joints)

    def _bounds(self, like: Any) -> tuple[Any, Any]:
        if isinstance(like, torch.Tensor):
            low, high = torch.from_numpy(self._range).to(like)
        else:
            low, high = self._range
        return low, high

    def _check(self, values: Any, size: int, name: str) -> None:
        if not values.ndim or values.shape[-1] != size:
            raise ValueError(
                f"{name} of {len(self.joints)} joints must have {size} numbers, got shape {tuple(values.shape)}"
            )
