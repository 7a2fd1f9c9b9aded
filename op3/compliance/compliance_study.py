"""All measurements of one policy, on the same episodes for every policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from op3.common.settings import CONTROL_PERIOD, Count, Positive, settings
from op3.compliance.backdrive import BackDrive, back_drive
from op3.compliance.energy import Energy, measure_energy, robot_mass
from op3.compliance.gains import TICK, Gains, measure_gains
from op3.compliance.landing import Landings, find_landings
from op3.compliance.leading import Led, lead
from op3.compliance.pushing import Survival, survive_pushes
from op3.compliance.robustness import Passed
from op3.envs.actors import Actor, FixedGain, find_actor
from op3.envs.record import record_episodes
from op3.envs.step_traces import SKIPPED, StepWatch, Traces
from op3.motions import SinusoidalGait
from op3.policy import PolicyBundle
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks.baselines import StiffWalk, position_mode
from op3.tasks.task import Task, find_task

Array = NDArray[np.float64]

FAMILY = tuple((step, height) for step in (0.03, 0.045, 0.06) for height in (0.02, 0.04, 0.06))
"""Step lengths and foot heights [m] of the stiff walks with which landings are compared."""

MINUTE = 60.0
"""Duration of standing [s]; equal losses in both halves justify extrapolation to an hour."""

STANDING = 4
"""Number of standing robots."""


@settings("sizes")
class Sizes:
    """Numbers of measured episodes and states.

    Attributes:
        episodes: number of episodes of walking on each ground.
        push_rungs: number of impulses in the ladder.
        push_episodes: number of episodes on each rung in each of eight directions.
        push_most: largest impulse of the ladder [N s].
        lead_episodes: number of episodes for each kind of pull.
        states: number of states of the gait at which joints are turned.
    """

    episodes: Annotated[Count, Field(ge=2)] = 50
    push_rungs: Annotated[Count, Field(ge=2)] = 10
    push_episodes: Count = 5
    push_most: Positive = 3.0
    lead_episodes: Annotated[Count, Field(ge=2)] = 8
    states: Count = 8


@dataclass(frozen=True, eq=False)
class Measured:
    """Results of one policy.

    Attributes:
        passed: successful episodes by ground.
        landings: landings on the flat floor.
        survival: survival of pushes.
        led: displacements by kind of pull; empty if not requested.
        energy: energy of walking.
        back_drive: back-drivability at states of the gait.
        gains: gains over the gait; None for servos in position mode.
    """

    label: str
    passed: dict[str, Passed]
    landings: Landings
    survival: Survival
    led: dict[str, Led]
    energy: Energy
    back_drive: BackDrive
    gains: Gains | None


def contestants(names: Sequence[str], task: Task, fixed_gains: Sequence[float], gain_scale: float = 1.0) -> list[Actor]:
    """The policies to measure: bundles and baselines by name, and the first policy's targets with fixed gains.

    Raises:
        ValueError: if a name occurs twice, or a policy does not fit the task or the robot.
    """
    for name in names:
        made = PolicyBundle.load(name).manifest.action_map.robot if Path(name).is_dir() else task.robot
        if load_robot(made).name != task.robot:
            raise ValueError(
                f"policy={name} was trained for the robot {made}, but the task's robot is {task.robot}; give a policy"
                f" for {task.robot}"
            )
    actors = [find_actor(name, task, gain_scale=gain_scale) for name in names]
    first = actors[0]
    if not first.stiff:
        for gain in fixed_gains:
            fixed = FixedGain(first.policy, first.action_map, gain)
            actors.append(Actor(f"{first.label}, gain fixed at {gain:g} A/rad", fixed, first.action_map))
    labels = [actor.label for actor in actors]
    if len(set(labels)) < len(labels):
        raise ValueError(f"policies must have folders of different names, got {', '.join(labels)}")
    return actors


class Study:
    """Measures policies that walk.

    Args:
        grounds: names of tasks on which walking is evaluated; the first is analysed in detail.
        seed: seed of the episodes, the same for all policies.
        gain_scale: factor on every commanded gain.
    """

    def __init__(
        self,
        model: RobotModel,
        grounds: Sequence[str],
        sizes: Sizes | None = None,
        seed: int = 0,
        *,
        gain_scale: float = 1.0,
        num_threads: int = 1,
    ):
        self.model, self.sizes, self.seed = model, sizes or Sizes(), seed
        self.tasks = {name: find_task(name) for name in grounds}
        self.task = next(iter(self.tasks.values()))
        self._options: dict[str, Any] = {"num_threads": num_threads, "gain_scale": gain_scale}
        for task in self.tasks.values():
            if task.cycle is None:
                raise ValueError(f"grounds: task {task.name} has no gait; give only walking tasks")

    def measure(self, actor: Actor, led: bool = True) -> Measured:
        """Measure everything for one policy."""
        sizes, known = self.sizes, {"seed": self.seed, **self._options}
        ladder = {"most": sizes.push_most, "rungs": sizes.push_rungs, "episodes": sizes.push_episodes}
        print(f"{actor.label}: {self.task.name}", flush=True)
        logs, landings, traces, mass = self._watched(actor, sizes.episodes)
        passed = {self.task.name: Passed.of(logs, self.task)}
        for name, task in list(self.tasks.items())[1:]:
            print(f"{actor.label}: {name}", flush=True)
            env = actor.environment(task, self.model, sizes.episodes, self.seed, **self._options)
            passed[name] = Passed.of(record_episodes(env, actor.policy), task)
        print(f"{actor.label}: pushes, pulls, joints", flush=True)
        return Measured(
            label=actor.label,
            passed=passed,
            landings=landings,
            survival=survive_pushes(actor, self.model, self.task, **ladder, **known),
            led=lead(actor, self.model, self.task, episodes=sizes.lead_episodes, **known) if led else {},
            energy=measure_energy(logs, self.model, load_robot(self.task.robot), mass, travels=True),
            back_drive=self._back_drive(actor, logs),
            gains=None if actor.stiff else measure_gains(logs, traces, self.task, self.model),
        )

    def stand(self, name: str) -> Energy:
        """Energy of standing on a level board for a minute, for extrapolation to an hour.

        Args:
            name: folder of a bundle for balancing, or hold.
        """
        task = find_task("balance", {"events.board.motion": "still"}, duration=MINUTE)
        actor = find_actor(name, task, field="standing")
        print(f"{actor.label}: standing", flush=True)
        env = actor.environment(task, self.model, STANDING, self.seed, **self._options)
        logs = record_episodes(env, actor.policy)
        return measure_energy(logs, self.model, env.mdp.robot, robot_mass(env), travels=False)

    def stiff_landings(self) -> Landings:
        """Landings of stiff walks with all step lengths and foot heights, with equal numbers of episodes."""
        print("stiff walks: landings", flush=True)
        gaits = [SinusoidalGait(step=step, foot_height=height) for step, height in FAMILY]
        actor = Actor("stiff walks", StiffFamily(gaits), self.task.action_map())
        return self._watched(actor, len(FAMILY) * max(1, round(self.sizes.episodes / len(FAMILY))))[1]

    def _watched(self, actor: Actor, episodes: int) -> tuple[list[Rollout], Landings, Traces, float]:
        """Episodes on the first ground, sampled every millisecond: logs, landings, traces, mass [kg]."""
        env = actor.environment(self.task, self.model, episodes, self.seed, **self._options)
        watch = StepWatch(env)
        with watch.watching():
            logs = record_episodes(env, actor.policy)
        traces = watch.traces()
        return logs, find_landings(traces, np.array([log.rows * TICK for log in logs])), traces, robot_mass(env)

    def _back_drive(self, actor: Actor, logs: Sequence[Rollout]) -> BackDrive:
        """Back-drivability at states spread over a gait cycle, from the longest episodes."""
        assert self.task.cycle is not None
        longest, count = sorted(logs, key=lambda log: -log.rows), self.sizes.states
        rows = np.round((SKIPPED + self.task.cycle * np.arange(count) / count) / CONTROL_PERIOD).astype(int)
        gains = ["firmware_gain"] if actor.stiff else ["p_gain", "d_gain"]
        names = {"position_target": "command/position", **{name: f"command/{name}" for name in gains}}
        taken = [(log, min(row, log.rows - 1)) for log, row in zip(cycle(longest), rows, strict=False)]
        commands = {name: np.stack([log.array(key)[row] for log, row in taken]) for name, key in names.items()}
        position = np.stack([log.array("joint/position")[row] for log, row in taken])
        model = position_mode(self.model) if actor.stiff else self.model
        return back_drive(
            model, load_robot(self.task.robot), position, commands, num_threads=self._options["num_threads"]
        )


class StiffFamily(StiffWalk):
    """Stiff walks, one after the other on the robots of a batch."""

    def __init__(self, gaits: Sequence[SinusoidalGait]):
        super().__init__()
        self.gaits = gaits

    def commands(self, time: torch.Tensor) -> dict[str, torch.Tensor]:
        """Goals of the servos at times since each episode's beginning, ``[sim]`` in s."""
        targets = np.stack(
            [self.gaits[row % len(self.gaits)].targets(now[None])[0] for row, now in enumerate(time.numpy())]
        )
        return {**super().commands(time), "position_target": torch.from_numpy(targets)}
