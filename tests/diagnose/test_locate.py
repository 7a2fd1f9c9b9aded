"""Where torque is missing, and what a black box finds, on residuals that are made of a known torque."""

from dataclasses import replace

import numpy as np
import pytest

from op3.diagnose import Diagnosis, WindowResiduals, planned_suite, split_logs
from op3.diagnose.ceiling import ceiling
from op3.diagnose.fitting import Fit
from op3.diagnose.locate import Response, locate, remaining, residual_torque
from op3.diagnose.motion import PREROLL
from op3.robot import LEG_JOINTS, leg_suite
from op3.sim import load_model

KNEE = LEG_JOINTS.index("r_knee")


@pytest.fixture(scope="module")
def planned() -> tuple[WindowResiduals, Fit]:
    """Windows of eight runs that the model itself would give, and the model there."""
    model = load_model("paper")
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:8]
    split = split_logs(planned_suite(model, runs))
    engine = WindowResiduals(split, fit_windows=40, select_windows=16)
    return engine, Diagnosis(model, split, engine=engine).linearised()


def of_ticks(engine: WindowResiduals, values: np.ndarray) -> np.ndarray:
    rows = PREROLL + engine.ticks + 1
    return values.reshape(len(engine.windows), rows, -1)[:, PREROLL : PREROLL + engine.ticks]


def lacking(engine: WindowResiduals, base: Fit, torque: np.ndarray) -> np.ndarray:
    """Residual of a model that lacks a torque ``[window, tick]`` in the knee, and noise."""
    noise = 0.3 * np.random.default_rng(5).normal(size=base.residual.shape)
    return (noise - Response(engine, base.parameters)(torque[..., None], KNEE)[..., 0]).astype(np.float32)


def test_planned_logs_carry_what_a_recording_has(planned):
    """Logs of a planned suite have the leg's joints and all channels that windows compare."""
    engine, _ = planned
    assert engine.joints == LEG_JOINTS
    assert len(engine.channels) == 3


def test_missing_torque_is_measured(planned):
    """A constant torque of 0.1 N m that the knee's model lacks is found there, within a third, and nowhere else."""
    engine, base = planned
    ticks = (len(engine.windows), engine.ticks)
    found = residual_torque(engine, base.parameters, lacking(engine, base, np.full(ticks, 0.1)))
    moving = np.abs(of_ticks(engine, engine.motion.velocity)[..., KNEE]).min(1) > 0.1
    assert moving.sum() > 5
    mean = found[moving].mean((0, 1))
    assert mean[KNEE] == pytest.approx(0.1, rel=0.35)
    assert np.abs(np.delete(mean, KNEE)).max() < 0.05


def test_missing_friction_is_located(planned):
    """Friction that the model lacks in the knee puts the knee's cells first, with the torque against the motion."""
    engine, base = planned
    torque = -0.15 * np.sign(of_ticks(engine, engine.motion.velocity)[..., KNEE])
    cells = locate(engine, replace(base, residual=lacking(engine, base, torque)))
    assert cells[0].joint == "r_knee"
    assert cells[0].chance < 0.05
    assert max(cell.torque for cell in cells if cell.joint == "r_knee") < -0.05


def test_black_box_finds_a_spring_and_nothing_in_noise(planned):
    """A torque that depends on the knee's angle is explained on unseen runs; noise is not."""
    engine, base = planned
    q = of_ticks(engine, engine.motion.position)[..., KNEE]
    found = ceiling(engine, base, lacking(engine, base, 1.5 * np.tanh(4 * (q - q.mean()))))
    assert found.gain > 0.2
    assert int(found.by_joint.argmax()) == KNEE
    assert ceiling(engine, base, lacking(engine, base, 0.0 * q)).gain < 0.02


def test_remaining_gap_is_in_units_of_the_sensor(planned):
    """Whitening is undone: twice the residual is twice the remaining gap."""
    engine, base = planned
    np.testing.assert_allclose(remaining(engine, 2 * base.residual), 2 * remaining(engine, base.residual), rtol=1e-5)
