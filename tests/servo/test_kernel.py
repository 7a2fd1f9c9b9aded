"""The kernel: one compilation for all combinations, the same bits for one robot as for many, and new effects."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from op3.servo import Effect, RobotModel, Servos, Stage, catalogue, effect, rows
from op3.servo.effects import Coulomb, CurrentPD, Motor

JOINTS = ("l_knee", "r_knee", "head_pan")
ALL = [name for name in catalogue() if name not in ("position_servo", "minimum_duty")]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "extend.md"


def model(*names: str) -> RobotModel:
    """Effects by name, at the ends of their ranges that are not neutral."""
    effects = tuple(catalogue()[name]() for name in names)
    values = {p.name: p.high for effect in effects for p in effect.parameters if p.high != p.neutral}
    return RobotModel(effects).with_values(values)


def moved(made: RobotModel, num_sims: int, steps: int = 40) -> np.ndarray:
    """What the law hands to the physics while joints swing, ``[step, signal, sim, joint]``."""
    law = Servos(made.effects, JOINTS, num_sims, 0.001, 0.008)
    law.set(made.tensors(JOINTS))
    signals = law.signals
    signals.torque_enable, signals.bus_voltage, signals.p_gain, signals.d_gain = 1.0, 11.1, 3.0, 0.1
    law.reset()
    handed = []
    for step in range(steps):
        wave = torch.sin(torch.arange(3) + 0.1 * step + torch.arange(num_sims)[:, None])
        signals.position, signals.velocity, signals.load_torque = 0.3 * wave, torch.cos(40.0 * wave), 0.5 - wave
        if step % 8 == 0:
            signals.position_target = -wave
            law.tick()
        law.step()
        handed.append(np.stack([law.records[name] for name in ("applied_torque", "damping", "friction_bound")]))
    return np.stack(handed)


def test_one_robot_has_the_bits_of_many():
    """The first robot of many hands over the same numbers as one alone, with all effects on."""
    np.testing.assert_array_equal(moved(model(*ALL), 7)[:, :, :1], moved(model(*ALL), 1))


def test_combinations_are_not_compiled():
    """Any effects, forms and numbers of robots run what was compiled once."""
    moved(model("current_pd", "motor"), 1)
    before = len(rows.step_all.signatures)
    for names in (("motor", "coulomb"), ("motor", "lugre", "backlash", "cogging"), ("current_pd", "motor", "dte")):
        moved(model(*names), len(names))
    assert len(rows.step_all.signatures) == before


def test_what_is_not_in_the_catalogue_is_refused():
    """An effect without its decorator is named with the remedy."""

    class Loose(Effect):
        name, stage = "loose", Stage.GEAR
        equation = source = "-"

    with pytest.raises(ValueError, match="Loose is not in the catalogue"):
        Servos((Motor(), Loose()), JOINTS, 1, 0.001, 0.008)


def test_signals_are_the_memory_of_the_law():
    """What is assigned arrives without another copy; a misspelt signal is answered with those that there are."""
    law = Servos((CurrentPD(), Motor(), Coulomb()), JOINTS, 2, 0.001, 0.008)
    law.signals.position = torch.tensor([1.0, 2.0, 3.0])
    assert law.records["position"].tolist() == [[1.0, 2.0, 3.0]] * 2
    law.records["velocity"][1] = 4.0
    assert law.signals.velocity[1].tolist() == [4.0] * 3
    with pytest.raises(AttributeError, match=r"no signal 'speedd'.*velocity"):
        law.signals.speedd = 1.0


def test_the_example_of_the_docs_is_an_effect(tmp_path):
    """The class of docs/extend.md acts as its equation says, beside all others."""
    (text,) = (block for block in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL) if "Detent" in block)
    path = tmp_path / "detent.py"
    path.write_text(re.sub(r"^   ", "", text, flags=re.MULTILINE))
    spec = importlib.util.spec_from_file_location("detent", path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["detent"] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        plain, with_detent = model("motor"), model("motor").with_effect(module.Detent(), {"detent_amplitude": 0.02})
        more = moved(with_detent, 1, 1)[0, 0] - moved(plain, 1, 1)[0, 0]
        angle = 0.3 * torch.sin(torch.arange(3.0)).numpy()
        np.testing.assert_allclose(more[0], 0.02 * np.sin(24 * angle), atol=1e-7)
    finally:
        effect._CATALOGUE.pop("detent", None)
        del sys.modules["detent"]
