"""Commands to robots, drawn for every episode and observed by the policy.

A command is a class with ``at(time)``, ``[env, number]``, and any of ``begin(episodes)``, ``begun(rows, yaw)`` and
``follow(yaw, commands)``; its attribute ``mirror`` has the signs of its numbers in the robot's plane of symmetry.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import ceil

import mujoco
import numpy as np
import torch
from torch import Tensor

from op3.policy.heading import HeadingReference
from op3.robot import Robot
from op3.tasks.episodes import Episodes

__all__ = ["Heading", "Stepwise", "Target", "Velocity"]

Range = tuple[float, float] | list[float]


class Velocity:
    """Velocity forwards and to the left [m/s] and rate of turning [rad/s], ``[env, 3]``, in the robot's heading.

    A command is drawn uniformly from the ranges and held for an interval. Standing and turning on the spot have
    separate probabilities: draws from the ranges would never give them.

    Args:
        forward: smallest and largest speed [m/s].
        sideways: smallest and largest speed [m/s].
        turning: smallest and largest rate [rad/s].
        interval: time for which a command is held [s]; the first command of an episode is held for a random part of it.
        zero_share: probability of standing.
        turn_share: probability of turning on the spot.
        straight_share: probability of moving without turning.
        single_share: probability of one of the three numbers alone: forward, sideways or turning on the spot.
        scale: factor on all ranges, which a curriculum may raise from 0 to 1.
        corners: 1: forward, sideways and turning are drawn independently, so all three may be at their ends. 0: draws
            outside the ellipsoid of the ranges are scaled back to it. A curriculum may raise it.
    """

    mirror = (1.0, -1.0, -1.0)

    def __init__(
        self,
        num_envs: int,
        duration: float,
        forward: Range = (0.3, 0.3),
        sideways: Range = (0.0, 0.0),
        turning: Range = (0.0, 0.0),
        interval: float = 2.0,
        zero_share: float = 0.0,
        turn_share: float = 0.0,
        straight_share: float = 0.0,
        single_share: float = 0.0,
        scale: float = 1.0,
        corners: float = 1.0,
    ):
        for name, bounds in (("forward", forward), ("sideways", sideways), ("turning", turning)):
            if len(bounds) != 2 or bounds[0] > bounds[1]:
                raise ValueError(f"{name} must be a smallest and a largest value, got {list(bounds)}")
        if not interval > 0:
            raise ValueError(f"interval must be above 0 s, got {interval}")
        shares = (zero_share, turn_share, straight_share, single_share)
        if min(shares) < 0 or sum(shares) > 1:
            names = "zero_share, turn_share, straight_share and single_share"
            raise ValueError(f"{names} must be at least 0 and at most 1 together, got {shares}")
        self._interval, self._shares = interval, np.cumsum(shares)
        self.scale, self.corners = scale, corners
        self._low, self._high = np.array([forward, sideways, turning], dtype=float).T
        self._count = ceil(duration / interval) + 1
        self._shift = torch.zeros(num_envs, dtype=torch.float64)
        self._schedule = torch.zeros(num_envs, self._count, 3, dtype=torch.float64)

    def begin(self, episodes: Episodes) -> None:
        """Draw the commands of whole episodes."""
        for row, generator in zip(episodes.rows, episodes.generators(6), strict=True):
            drawn = generator.uniform(self._low, self._high, (self._count, 3))
            end = np.where(drawn < 0, self._low, self._high)
            part = np.divide(drawn, end, out=np.zeros_like(drawn), where=end != 0)
            drawn *= self.scale / np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1.0) ** (1.0 - self.corners)
            kind = np.searchsorted(self._shares, generator.random(self._count), side="right")
            self._shift[row] = generator.uniform(0.0, self._interval)
            others = np.arange(3) != generator.integers(3, size=(self._count, 1))
            drawn[kind == 1, :2] = drawn[kind == 2, 2] = drawn[kind == 0] = 0.0
            drawn[(kind == 3)[:, None] & others] = 0.0
            self._schedule[row] = torch.from_numpy(drawn)

    def at(self, time: Tensor) -> Tensor:
        """The current commands at a time of each episode [s], ``[env, 3]``."""
        number = ((time + self._shift) / self._interval).long().clamp(max=self._count - 1)
        return _held(self._schedule, number)


class Stepwise:
    """The same commands for all robots, each held until the next one, ``[env, number]``.

    Args:
        times: start of each command [s], rising from 0.
        values: the commands.
    """

    def __init__(self, num_envs: int, times: Iterable[float], values: Iterable[Iterable[float]]):
        del num_envs
        self._times = torch.tensor(list(times), dtype=torch.float64)
        self._values = torch.tensor([list(v) for v in values], dtype=torch.float64)
        if len(self._times) != len(self._values) or (self._times.diff() <= 0).any() or self._times[:1] != 0.0:
            raise ValueError(f"times must increase from 0, with a value for each, got {self._times.tolist()}")

    def at(self, time: Tensor) -> Tensor:
        """The current commands at a time of each episode [s]."""
        return self._values[torch.searchsorted(self._times, time + 1e-9, side="right") - 1]


class Heading:
    """The heading that follows from a velocity command, ``[env, 1]`` in rad; see `op3.policy.heading`.

    Args:
        rate: name of the command whose last number is the turning rate.
    """

    mirror = (-1.0,)

    def __init__(self, num_envs: int, policy_period: float, rate: str = "velocity"):
        self.rate, self._period = rate, policy_period
        self._reference = HeadingReference(num_envs)

    def begun(self, rows: Tensor, yaw: Tensor) -> None:
        """Begin the episodes of a mask of robots, at a measured yaw [rad]."""
        self._reference.begin(rows, yaw)

    def follow(self, yaw: Tensor, commands: Mapping[str, Tensor]) -> None:
        """Advance by one policy step under these commands, to a measured yaw [rad]."""
        self._reference.step(yaw, commands[self.rate][:, -1], self._period)

    def at(self, time: Tensor) -> Tensor:
        """The current reference."""
        del time
        return self._reference.heading[:, None]


class Target:
    """A target position for the tip of an arm, relative to its base and in the base's frame, ``[env, 3]`` in m.

    Targets are tip positions in random poses within the robot's limits, so that each can be reached.

    Args:
        share: share of each joint's range, about its middle, from which poses are drawn.
        least_height: smallest height of a target above the base's origin [m].
        interval: time for which a target is held [s]; None: the whole episode.
    """

    mirror = (1.0, -1.0, 1.0)

    def __init__(
        self,
        num_envs: int,
        duration: float,
        robot: Robot,
        share: float = 0.8,
        least_height: float = 0.02,
        interval: float | None = None,
    ):
        if robot.file.tip is None:
            raise ValueError(f"the file of the robot {robot.name} has no tip; add tip: <site at the end of the arm>")
        self._robot, self._share, self._least = robot, share, least_height
        self._interval = duration if interval is None else interval
        self._count = ceil(duration / self._interval)
        self._data = mujoco.MjData(robot.bare_model)
        self._places = torch.zeros(num_envs, self._count, 3, dtype=torch.float64)

    def begin(self, episodes: Episodes) -> None:
        """Draw the targets of whole episodes."""
        for row, generator in zip(episodes.rows, episodes.generators(6), strict=True):
            self._places[row] = torch.tensor(np.array([self._draw(generator) for _ in range(self._count)]))

    def at(self, time: Tensor) -> Tensor:
        """The current targets at a time of each episode [s], ``[env, 3]``."""
        return _held(self._places, (time / self._interval).long().clamp(max=self._count - 1))

    def _draw(self, generator: np.random.Generator) -> np.ndarray:
        robot, data = self._robot, self._data
        middle, half = robot.limits.mean(1), self._share * np.ptp(robot.limits, axis=1) / 2
        controlled = robot.indices(robot.controlled)
        place = np.zeros(3)
        for _ in range(100):
            position = robot.home.copy()
            position[controlled] = generator.uniform(middle - half, middle + half)[controlled]
            data.qpos[[robot.bare_model.joint(name).qposadr[0] for name in robot.joints]] = position
            mujoco.mj_kinematics(robot.bare_model, data)
            base = 0 if robot.file.base is None else robot.bare_model.body(robot.file.base).id
            turn = data.xmat[base].reshape(3, 3)
            place = turn.T @ (data.site(robot.file.tip).xpos - data.xpos[base])
            if place[2] >= self._least:
                return place
        raise ValueError(f"no pose of {robot.name} brings its tip {self._least:g} m above its base")


def _held(schedule: Tensor, number: Tensor) -> Tensor:
    """The command of a number [env] in each schedule [env, number, value]."""
    return schedule[torch.arange(len(number), device=number.device), number]
