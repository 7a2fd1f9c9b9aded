"""Success of a policy on robots with one variation each, and the card with the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from op3.common.sample_intervals import wilson_interval
from op3.common.settings import Named, Number, Positive, nearest, settings
from op3.compliance.energy import measure_energy, robot_mass
from op3.compliance.pushing import survive_pushes
from op3.envs.actors import Actor
from op3.envs.gait_validity import GaitValidity, judged_episodes
from op3.envs.record import record_episodes
from op3.envs.tracking import AXES, measure_obedience
from op3.policy import PolicyBundle
from op3.policy.card import Card
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.servo import Parameter, RobotModel, catalogue
from op3.tasks.evaluation import succeeded
from op3.tasks.pushes import DIRECTIONS
from op3.tasks.task import Task, find_task

ENOUGH = 0.9
"""Share of robots that must walk, or stand, for the card's verdict."""

BUS_VOLTAGE = "bus_voltage"
"""Name of the supply voltage in variations."""

PUSH_RUNGS, LARGEST_PUSH = 10, 3.0
"""Step and end of the sequence of pushes [N s]."""


@settings("variation")
class Variation:
    """A variation of the robot or the task that a policy was trained on.

    Attributes:
        text: description of the variation.
        add: increments of the model's parameters or of `bus_voltage`, by name. A missing effect is added to the model
            with neutral values.
        scale: factors on these parameters.
        gain_scale: factor on every commanded gain.
        task: changed values of the task, by dotted path.
    """

    text: str = ""
    add: Named[Number] = dataclasses.field(default_factory=dict)
    scale: Named[Positive] = dataclasses.field(default_factory=dict)
    gain_scale: Positive = 1.0
    task: Named[Any] = dataclasses.field(default_factory=dict)

    def model(self, model: RobotModel) -> RobotModel:
        """The robot's model with the variation.

        Raises:
            ValueError: if there is no such parameter, or its value is impossible.
        """
        for name in {**self.add, **self.scale}:
            if name == BUS_VOLTAGE:
                model = replace(model, bus_voltage=self._changed(name, model.bus_voltage))
            else:
                model = _with_parameter(model, name)
                model = model.moved({name: self._changed(name, model.value(name))})
        return model

    def _changed(self, name: str, value: float) -> float:
        return value * self.scale.get(name, 1.0) + self.add.get(name, 0.0)


def _with_parameter(model: RobotModel, name: str) -> RobotModel:
    """The model with this parameter; if its effect is off, it is added at neutral values."""
    if name in model.parameters():
        return model
    for effect in catalogue().values():
        if any(parameter.name == name for parameter in effect.parameters):
            return model.with_effect(effect(), {p.name: _neutral(p) for p in effect.parameters})
    known = sorted({p.name for effect in catalogue().values() for p in effect.parameters} | {BUS_VOLTAGE})
    raise ValueError(f"a variation changes {name!r}, but no effect has such a parameter{nearest(name, known)}")


def _neutral(parameter: Parameter) -> float:
    return parameter.nominal if parameter.neutral is None else parameter.neutral


@dataclass(frozen=True)
class Passed:
    """Results of robots with one variation on one ground, with one episode each.

    Attributes:
        episodes: number of episodes.
        upright: number of episodes without a fall.
        successes: number of these that also met the task's success criterion.
        speed: mean forward speed [m/s]; NaN for a task without a gait.
    """

    episodes: int
    upright: int
    successes: int
    speed: float

    @classmethod
    def of(cls, logs: Sequence[Rollout], task: Task) -> Passed:
        """Count the episodes."""
        facts = [vars(log.metadata) for log in logs if task.cycle is not None]
        speeds = [fact["travelled_distance"] / fact["episode_duration"] for fact in facts]
        upright = sum(not log.metadata.fallen for log in logs)
        successes = sum(succeeded(log, task) for log in logs)
        return cls(len(logs), upright, successes, float(np.mean(speeds)) if speeds else np.nan)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of successes."""
        return wilson_interval(self.successes, self.episodes)

    @property
    def plain(self) -> dict[str, Any]:
        """The results as plain data."""
        low, high = (round(end, 3) for end in self.interval)
        speed = {} if np.isnan(self.speed) else {"speed": round(self.speed, 4)}
        return {"success": round(self.successes / self.episodes, 3), "low": low, "high": high, **speed}


def verdict(nominal: Passed, task: Task) -> Literal["WALKS", "STANDS", "FALLS"]:
    """Verdict on a policy: the behaviour of a share `ENOUGH` of the robots without a variation."""
    if task.cycle is not None and nominal.successes >= ENOUGH * nominal.episodes:
        return "WALKS"
    return "STANDS" if nominal.upright >= ENOUGH * nominal.episodes else "FALLS"


def make_card(
    actor: Actor,
    model_name: str,
    model: RobotModel,
    task: Task,
    variations: Mapping[str, Variation],
    made: Mapping[str, Any],
    *,
    robots: int = 50,
    seed: int = 0,
    report: Callable[[str], None] = print,
    **options: Any,
) -> Card:
    """Measure the content of a card.

    Args:
        model_name: name of the model, for the card.
        variations: variations by name; the nominal robot is added as the first.
        made: command, commit and date for the card.
        robots: number of robots in each variation, and in each direction of pushes.
        seed: seed of the episodes, the same for all variations.
        **options: further arguments of `op3.envs.make_env`.
    """
    bundle = actor.policy
    assert isinstance(bundle, PolicyBundle)
    varied = {name: (one.model(model), find_task(task, one.task), one) for name, one in variations.items()}
    report(f"card: {robots} nominal robots")
    env = actor.environment(task, model, robots, seed, **options)
    logs, validity = judged_episodes(env, bundle)
    mass, nominal = robot_mass(env), Passed.of(logs, task)
    found = {"nominal": nominal.plain}
    for name, (other, attempted, variation) in varied.items():
        report(f"card: {name}, {variation.text}" if variation.text else f"card: {name}")
        env = actor.environment(attempted, other, robots, seed, **{**options, "gain_scale": variation.gain_scale})
        text = {"text": variation.text} if variation.text else {}
        found[name] = {**text, **Passed.of(record_episodes(env, actor.policy), attempted).plain}
    report("card: pushes")
    per_rung = -(-robots // PUSH_RUNGS)
    ladder = {"most": LARGEST_PUSH, "rungs": PUSH_RUNGS, "episodes": per_rung}
    survival = survive_pushes(actor, model, task, seed=seed, **ladder, **options)
    directions = {f"{360 * i // DIRECTIONS} deg": _rounded(row) for i, row in enumerate(survival.largest)}
    return Card(
        verdict=verdict(nominal, task),
        policy=bundle.fingerprint,
        task=task.name,
        model=model_name,
        robots=robots,
        self_contact=round(validity.self_contact, 5),
        penetration=round(validity.penetration, 6),
        validity=_plain_validity(validity),
        robustness=found,
        pushes={"robots": survival.survived.size, "mean": _rounded(survival.mean_largest), **directions},
        commands=_commands(actor, model, task, robots, seed, report, **options),
        cost=_cost(logs, model, mass, task),
        made=dict(made),
    )


def _plain_validity(validity: GaitValidity) -> dict[str, float | None]:
    values = dataclasses.asdict(validity)
    del values["self_contact"], values["penetration"]
    return {name: None if value is None else round(value, 5) for name, value in values.items()}


def _commands(
    actor: Actor, model: RobotModel, task: Task, robots: int, seed: int, report: Callable[[str], None], **options: Any
) -> dict[str, Any]:
    if "velocity" not in task.commands:
        return {}
    obeyed = measure_obedience(actor, model, task, robots, seed, report=report, **options)
    return {
        "rms_error": dict(zip(AXES, _rounded(obeyed.errors), strict=True)),
        "upright": obeyed.upright,
        "speeds": {f"{asked:g} m/s": _rounded((achieved, spread)) for asked, achieved, spread in obeyed.speeds},
        "stopped": obeyed.stopped,
        "stand_drift": round(obeyed.stand_drift, 4),
        "yaw_drift": round(obeyed.yaw_drift, 4),
    }


def _cost(logs: list[Rollout], model: RobotModel, mass: float, task: Task) -> dict[str, Any]:
    energy = measure_energy(logs, model, load_robot(task.robot), mass, travels=task.cycle is not None)
    current = float(np.mean([np.abs(log.array("joint/current")).mean() for log in logs]))
    transport = (
        {} if energy.cost_of_transport is None else {"cost_of_transport": round(float(energy.cost_of_transport[0]), 3)}
    )
    return {"current": round(current, 4), "power": round(float(energy.power[0]), 3), **transport}


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 3) for value in values]
