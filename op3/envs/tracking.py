"""Command tracking of a walk: errors under changing commands, a table of speeds, and stopping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from op3.envs.actors import Actor
from op3.servo import RobotModel
from op3.tasks.task import POLICY_PERIOD, Task, find_task

Array = NDArray[np.float64]

AXES = ("forward", "sideways", "turning")
"""Axes of a velocity command [m/s, m/s, rad/s]."""

SETTLED = 1.0
"""Time after a change of the command before errors are evaluated [s]: one stride."""

STANDING_SPEED = 0.02
"""Mean speed over a second below which a robot counts as standing [m/s]."""


@dataclass(frozen=True, eq=False)
class Course:
    """Traces of robots under velocity commands, one row per policy step.

    Attributes:
        command: velocity commands, ``[step, robot, 3]``.
        velocity: velocity forwards and to the left [m/s], and turning rate [rad/s], ``[step, robot, 3]``.
        yaw: measured heading, unwrapped, ``[step, robot]`` in rad.
        place: position of the base in the world, ``[step, robot, 2]`` in m.
        upright: whether the robot has not fallen yet, ``[step, robot]``.
    """

    command: Array
    velocity: Array
    yaw: Array
    place: Array
    upright: NDArray[np.bool_]

    def errors(self, cycle: float) -> Array:
        """Root mean square velocity error, averaged over a stride, by axis: ``[3]`` in m/s, m/s, rad/s.

        Steps count while a robot is upright and its command has been held for `SETTLED`.

        Args:
            cycle: duration of a stride [s].
        """
        length, settled = round(cycle / POLICY_PERIOD), round(SETTLED / POLICY_PERIOD)
        total = np.cumsum(np.pad(self.velocity, ((1, 0), (0, 0), (0, 0))), axis=0)
        mean = (total[length:] - total[:-length]) / length
        changed = np.any(np.diff(self.command, axis=0, prepend=np.nan), axis=2)
        since = np.zeros(self.upright.shape, dtype=int)
        for step in range(1, len(since)):
            since[step] = np.where(changed[step], 0, since[step - 1] + 1)
        counts = (self.upright & (since >= max(settled, length)))[length - 1 :]
        missed = (mean - self.command[length - 1 :])[counts]
        return np.sqrt(np.mean(np.square(missed), axis=0)) if len(missed) else np.full(3, np.nan)


def walk_course(actor: Actor, model: str | RobotModel, task: Task, robots: int, seed: int, **options: Any) -> Course:
    """One episode of each robot under the commands of a task."""
    env = actor.environment(task, model, robots, seed, **options)
    state, rows = env.reset(), []
    upright = np.ones(robots, dtype=bool)
    for _ in range(task.steps):
        command = env.mdp.terms["commands"]["velocity"].at(env.mdp.time)
        state["action"] = actor.policy.act(state["observation"]).to(torch.float32).clamp(-1.0, 1.0)
        after = env.step(state)["next"]
        upright &= ~after["terminated"][:, 0].numpy()
        now = env.mdp.state
        place = now.snapshot.place[:, :2].numpy().copy()
        rows.append(
            (command.numpy(), now.heading_velocity.numpy(), now.orientation[:, 2].numpy(), place, upright.copy())
        )
        state = after.exclude("reward")
    command, velocity, yaw, place, kept = (np.array(values) for values in zip(*rows, strict=True))
    return Course(command, velocity, np.unwrap(yaw, axis=0), place, kept)


def held(task: Task, velocity: tuple[float, float, float], duration: float, stop: float | None = None) -> Task:
    """The task with one commanded velocity, which becomes zero at a given time.

    Args:
        duration: duration of the episode [s].
        stop: time at which the command becomes zero [s]; None: never.
    """
    times, values = [0.0], [list(velocity)]
    if stop is not None:
        times, values = [*times, stop], [*values, [0.0, 0.0, 0.0]]
    sequence = {"function": "stepwise", "times": times, "values": values}
    return find_task(task, {"commands.velocity": sequence, "events.pushing": None}, duration=duration)


@dataclass(frozen=True)
class Obedience:
    """Tracking errors of a walk with velocity commands.

    Attributes:
        errors: root mean square under changing commands, by axis [m/s, m/s, rad/s].
        upright: number of robots that did not fall under these commands.
        robots: number of robots.
        speeds: commanded and achieved forward speed, with the standard deviation over robots [m/s].
        stopped: number of robots that stood within 2 s of a zero command and until the end of the episode.
        stand_drift: mean displacement of the base in the 10 s after these 2 s [m].
        yaw_drift: mean absolute change of the heading in 20 s of walking straight ahead [rad].
    """

    errors: tuple[float, float, float]
    upright: int
    robots: int
    speeds: tuple[tuple[float, float, float], ...]
    stopped: int
    stand_drift: float
    yaw_drift: float

    def __str__(self) -> str:
        forward, sideways, turning = self.errors
        return (
            f"velocity errors are {forward:.3f} m/s forward, {sideways:.3f} m/s sideways, {turning:.3f} rad/s turning"
            f" (RMS over strides); {self.upright} of {self.robots} upright; {self.stopped} of {self.robots} stop within"
            f" 2 s; heading drifts by {np.degrees(self.yaw_drift):.0f} deg in 20 s"
        )


def measure_obedience(
    actor: Actor,
    model: str | RobotModel,
    task: Task,
    robots: int = 50,
    seed: int = 0,
    speeds: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3),
    report: Callable[[str], None] = print,
    **options: Any,
) -> Obedience:
    """Measure how accurately a walk tracks its commands.

    Args:
        task: task with a command ``velocity``.
        robots: number of robots in each measurement.
        speeds: commanded forward speeds for the table [m/s].

    Raises:
        ValueError: if the task has no such command.
    """
    if "velocity" not in task.commands or task.cycle is None:
        raise ValueError(f"task {task.name} commands no velocity; give task=walk_command")
    report("commands: changing every few seconds")
    course = walk_course(actor, model, find_task(task, {"events.pushing": None}), robots, seed, **options)
    table = []
    for speed in speeds:
        report(f"commands: {speed:g} m/s")
        straight = walk_course(actor, model, held(task, (speed, 0.0, 0.0), 8.0), robots, seed, **options)
        late = straight.velocity[round(2.0 / POLICY_PERIOD) :, straight.upright[-1], 0].mean(0)
        table.append((speed, float(late.mean()), float(late.std())) if len(late) else (speed, np.nan, np.nan))
    report("commands: walking straight ahead for 20 s, then stopping")
    long = walk_course(actor, model, held(task, (0.2, 0.0, 0.0), 20.0), robots, seed, **options)
    stop = walk_course(actor, model, held(task, (0.2, 0.0, 0.0), 18.0, stop=4.0), robots, seed, **options)
    second, stands = round(1.0 / POLICY_PERIOD), round(6.0 / POLICY_PERIOD)
    moved = np.linalg.norm(stop.place[stands + second :] - stop.place[stands:-second], axis=-1)
    stopped = stop.upright[-1] & (moved < STANDING_SPEED).all(0)
    ten = stands + round(10.0 / POLICY_PERIOD)
    drift = np.linalg.norm(stop.place[ten] - stop.place[stands], axis=-1)[stop.upright[-1]]
    turned = np.abs(long.yaw[-1] - long.yaw[0])[long.upright[-1]]
    return Obedience(
        errors=tuple(float(value) for value in course.errors(task.cycle)),  # type: ignore[arg-type]
        upright=int(course.upright[-1].sum()),
        robots=robots,
        speeds=tuple(table),
        stopped=int(stopped.sum()),
        stand_drift=float(drift.mean()) if len(drift) else np.nan,
        yaw_drift=float(turned.mean()) if len(turned) else np.nan,
    )
