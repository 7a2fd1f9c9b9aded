"""Sensors: whole counts, delay, noise, and robots that begin anew."""

import math

import pytest
import torch

from op3.tasks.sensing import SensorBank
from op3.tasks.task import Sensor, Sensors


def readings(value: float, sims: int = 2) -> dict[str, torch.Tensor]:
    return {name: torch.full((sims, 3), value, dtype=torch.float64) for name in vars(Sensors())}


def test_default_units():
    """4096 counts per turn, 0.229 rpm, 0.1 degrees and 2000/32800 degrees per second."""
    bank = SensorBank(Sensors(), torch.Generator())
    bank.reset(readings(0.1234))
    read = bank.read()
    units = (2 * math.pi / 4096, 0.02398, math.radians(0.1), math.radians(2000 / 32800))
    for name, unit in zip(vars(Sensors()), units, strict=True):
        counts = read[name] / unit
        assert (read[name] - 0.1234).abs().max() <= 0.5001 * unit
        torch.testing.assert_close(counts, counts.round(), atol=2e-3, rtol=0)


def test_delay():
    """A reading that is two ticks late shows what was true two ticks ago; the others are of now."""
    bank = SensorBank(Sensors(joint_position=Sensor(delay=0.016)), torch.Generator())
    bank.reset(readings(0.0))
    seen = []
    for value in (1.0, 2.0, 3.0):
        bank.push(readings(value))
        seen.append((bank.read()["joint_position"][0, 0].item(), bank.read()["orientation"][0, 0].item()))
    assert [late for late, _ in seen] == [0.0, 0.0, 1.0]
    assert [now for _, now in seen] == pytest.approx([1.0, 2.0, 3.0], abs=1e-3)


def test_noise():
    """Noise has the standard deviation asked for and comes from the generator alone."""
    sensors = Sensors(angular_velocity=Sensor(noise=0.5))
    drawn = []
    for _ in range(2):
        bank = SensorBank(sensors, torch.Generator().manual_seed(3))
        bank.reset(readings(1.0, 5000))
        drawn.append(bank.read()["angular_velocity"])
    assert torch.equal(*drawn)
    assert drawn[0].std().item() == pytest.approx(0.5, rel=0.05)


def test_rows_begin_anew():
    """A robot that begins anew has always been as it is; the other keeps its past."""
    bank = SensorBank(Sensors(joint_position=Sensor(delay=0.008)), torch.Generator())
    bank.reset(readings(1.0))
    bank.push(readings(2.0))
    bank.reset(readings(7.0), torch.tensor([False, True]))
    assert bank.read()["joint_position"][:, 0].tolist() == [1.0, 7.0]


def test_impossible_sensors():
    """A delay between two ticks is refused with its numbers."""
    with pytest.raises(ValueError, match=r"multiple of 0.008 s, got unit 0.0, noise 0.0, delay 0.01 s"):
        Sensor(delay=0.01)
