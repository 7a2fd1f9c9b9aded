"""Lost command packets, read off windows of simulated legs that lost some, or none."""

import numpy as np
import pytest
import torch
from scipy import stats

from op3.diagnose import WindowResiduals, planned_suite, split_logs
from op3.diagnose.motion import PREROLL
from op3.diagnose.packets import ARRIVED, LOST, LostPackets, lost_packets, without_losses
from op3.robot import leg_suite
from op3.servo.effects import PacketDrop
from op3.sim import load_model

PROBABILITY, SEED = 0.04, 5

SETTLING = 25
"""Packets before the first row of a simulated log."""


def windows_of(truth) -> WindowResiduals:
    """Windows of a leg on the stand under a model, prepared by the same model without losses."""
    runs = [run for run in leg_suite(3, 5.0) if run.motion.name.startswith(("multisine", "steps", "squats"))]
    engine = WindowResiduals(split_logs(planned_suite(truth, runs)), fit_windows=20, select_windows=6)
    engine.prepare(load_model("paper"))
    return engine


def asked(engine: WindowResiduals) -> LostPackets | None:
    model = load_model("paper").with_effect(PacketDrop(), {"drop_probability": 0.0})
    values = model.tensors(engine.joints)
    values["drop_probability"] = torch.full_like(values["drop_probability"], 0.5)
    return lost_packets(engine, model, values)


def test_the_packets_that_seem_lost_are_those_that_were():
    """Nearly all that are told were lost, all that tell much are told, and the share is within its interval."""
    effect = PacketDrop(seed=SEED)
    engine = windows_of(load_model("paper").with_effect(effect, {"drop_probability": PROBABILITY}))
    found = asked(engine)
    assert found is not None
    low, high = found.interval()
    assert low < PROBABILITY < high
    chance = torch.rand(4096, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64).numpy()
    truth = np.stack(
        [chance[t - PREROLL + SETTLING : t + engine.ticks + 1 + SETTLING] < PROBABILITY for _, t in engine.windows]
    )
    told = found.packets == LOST
    assert set(np.unique(found.packets)) == {LOST, ARRIVED}
    assert told.sum() >= 8
    assert (told & truth).sum() >= 0.9 * told.sum()
    engine.packets = found.packets
    lossy = load_model("paper").with_effect(effect, {"drop_probability": 0.01})
    residual = [np.square(engine.residuals(model)[0]).sum() for model in (load_model("paper"), lossy)]
    assert residual[1] < 0.7 * residual[0]
    # a run that is compared with a log tick by tick draws none of its own
    assert without_losses(lossy).value("drop_probability") == 0.0


@pytest.mark.parametrize("latency", [0.006, 0.009])
def test_a_leg_that_lost_none_tells_of_none(latency):
    """Also where all commands come later than the model knows, which looks like half a lost packet in every tick."""
    engine = windows_of(load_model("paper").with_values({"command_latency": latency}))
    assert asked(engine) is None


@pytest.mark.parametrize(("lost", "telling"), [(3, 100), (0, 50), (20, 20)])
def test_the_interval_of_a_count_is_exact(lost, telling):
    """As SciPy's exact interval of a proportion."""
    low, high = LostPackets(np.zeros((1, 1)), telling, lost).interval()
    expected = stats.binomtest(lost, telling).proportion_ci(0.9, method="exact")
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-9)
