"""Every effect of the catalogue changes nothing at neutral values; at its secants it acts, and is stable at 1 ms."""

import numpy as np
import pytest
import torch

from op3.replay import Setup
from op3.servo import RobotModel, catalogue, parameter
from op3.servo.effects import (
    Coulomb,
    CurrentPD,
    DirectionalEfficiency,
    Latency,
    Motor,
    PositionServo,
    Stribeck,
    Viscous,
)
from op3.sim import BatchSimulation, PendulumSimulation
from tests.secants import secant_values

NEUTRAL = [n for n, e in catalogue().items() if e.secants and n != "position_servo"]
"""All but the motor and what closes its loop, without which there is no servo to compare with."""
SCREENED = [name for name, e in catalogue().items() if e.secants]
VOLTAGE_DRIVEN = {"position_servo", "minimum_duty"}
BASE = (CurrentPD(), Latency(), Motor(), DirectionalEfficiency(), Coulomb(), Stribeck(), Viscous())


FLOOR = Setup.of_mount("floor", robot="op3")


def without(name: str) -> RobotModel:
    """The full law but for one effect; driven by voltage for effects of such servos."""
    effects = BASE
    if name in VOLTAGE_DRIVEN:
        effects = (PositionServo(), Motor(drive="voltage"), *BASE[3:])
    return RobotModel(tuple(e for e in effects if e.name != name)).with_values({"armature": 0.005})


def neutral(name: str) -> RobotModel:
    """The same with the effect at its neutral values."""
    effect = catalogue()[name]()
    values = {p.name: p.neutral for p in effect.parameters if p.neutral is not None}
    return without(name).with_effect(effect, values)


def robot(model: RobotModel) -> BatchSimulation:
    return BatchSimulation(FLOOR.mj_model, FLOOR.scene.joint_names, model, 1, base_body=FLOOR.base_body)


def motion(sim, start, ticks: int, every: int = 1) -> dict[str, torch.Tensor]:
    """Everything that sensors say while the knees bend; channels by name, ``[time, ...]``."""
    if isinstance(sim, PendulumSimulation):
        sim.reset(start, {"p_gain": 3.0, "d_gain": 0.1, "firmware_gain": 16.0})
    else:
        sim.reset(
            FLOOR.scene.initial_qpos(start.numpy()),
            {"position_target": start, "p_gain": 5.0, "d_gain": 0.1, "firmware_gain": 16.0},
        )
    rows: dict[str, list] = {}
    for tick in range(ticks):
        wave = 0.15 * np.sin(0.15 * tick / every)
        sim.command(position_target=torch.as_tensor(start) + wave, temperature=40.0)
        sim.advance()
        for key, value in sim.measure().items():
            rows.setdefault("/".join(key), []).append(value)
    assert not sim.failed.any()
    return {key: torch.stack(value) for key, value in rows.items()}


@pytest.mark.parametrize("name", NEUTRAL)
def test_neutral_values_change_no_bit_of_the_robot(name):
    """A robot on the floor with the effect at its neutral values logs the same bits as without the effect."""
    start = torch.zeros(20, dtype=torch.float64)
    plain = motion(robot(without(name)), start, 40)
    with_effect = motion(robot(neutral(name)), start, 40)
    for channel, values in plain.items():
        assert torch.equal(values, with_effect[channel]), channel


@pytest.mark.parametrize("name", SCREENED)
def test_every_secant_acts_and_is_stable_on_the_robot(name):
    """At each secant, three times as far where physics allows, the OP3 moves its legs for 0.5 s without a failure, and
    at least one of the secants shows in the logs.
    """
    start = torch.zeros(20, dtype=torch.float64)
    effect = catalogue()[name]()
    base = without(name).with_effect(effect, _start(effect))
    plain = motion(robot(base), start, 60)
    shown = False
    for secant in effect.secants:
        far = {key: value if parameter(key).neutral is None else 3 * value for key, value in secant.items()}
        known = base.parameters()
        values = {k: v for k, v in secant_values(far, {k: base.value(k) for k in known}).items() if k in known}
        logged = motion(robot(base.with_values(values)), start, 60)
        shown |= any(not torch.equal(plain[key], value) for key, value in logged.items())
        assert all(torch.isfinite(value).all() for value in logged.values())
        assert logged["joint/velocity"].abs().max() < 30
    assert shown


def _start(effect) -> dict[str, float]:
    """Neutral where there is such a value, else a value within the range."""
    return {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
