"""Every effect of the catalogue, off by its neutral value, changes nothing; on, it does; and no law blows up at 1 ms."""

import numpy as np
import pytest
import torch

from op3.servo import RobotModel, catalogue, secant_values
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
from op3.tasks import Setup

NEUTRAL = [name for name, e in catalogue().items() if any(p.neutral is not None for p in e.parameters)]
SCREENED = [name for name, e in catalogue().items() if e.secants]
VOLTAGE_DRIVEN = {"position_servo", "minimum_duty"}
BASE = (CurrentPD(), Latency(), Motor(), DirectionalEfficiency(), Coulomb(), Stribeck(), Viscous())
JOINTS = ("l_hip_pitch", "l_knee", "r_knee", "r_ank_roll")


@pytest.fixture(scope="module")
def floor() -> Setup:
    """The OP3 on the floor."""
    return Setup.of_mount("floor")


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


def robot(floor: Setup, model: RobotModel) -> BatchSimulation:
    return BatchSimulation(floor.mj_model, floor.scene.joint_names, model, 1, base_body=floor.base_body)


def motion(sim, start, ticks: int, every: int = 1) -> dict[str, torch.Tensor]:
    """Everything that sensors say while the knees bend; channels by name, ``[time, ...]``."""
    if isinstance(sim, PendulumSimulation):
        sim.reset(start, {"p_gain": 3.0, "d_gain": 0.1, "firmware_gain": 16.0})
    else:
        sim.reset(floor_qpos(start), {"position_target": start, "p_gain": 5.0, "d_gain": 0.1, "firmware_gain": 16.0})
    rows: dict[str, list] = {}
    for tick in range(ticks):
        wave = 0.15 * np.sin(0.15 * tick / every)
        sim.command(position_target=torch.as_tensor(start) + wave, temperature=40.0)
        sim.advance()
        for key, value in sim.measure().items():
            rows.setdefault("/".join(key), []).append(value)
    assert not sim.failed.any()
    return {key: torch.stack(value) for key, value in rows.items()}


def floor_qpos(start: torch.Tensor) -> np.ndarray:
    return Setup.of_mount("floor").scene.initial_qpos(start.numpy())


@pytest.mark.parametrize("name", NEUTRAL)
def test_neutral_values_change_no_bit_of_the_robot(floor, name):
    """A robot on the floor with the effect at its neutral values logs the same bits as without the effect."""
    start = torch.zeros(20, dtype=torch.float64)
    if name in VOLTAGE_DRIVEN and name == "position_servo":
        pytest.skip("who closes the loop is no addition to a model: there is nothing to compare with")
    plain = motion(robot(floor, without(name)), start, 40)
    with_effect = motion(robot(floor, neutral(name)), start, 40)
    for channel, values in plain.items():
        assert torch.equal(values, with_effect[channel]), channel
