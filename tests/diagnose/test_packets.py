"""Lost command packets, read off windows of simulated legs that lost some, or none."""

import numpy as np
import pytest
import torch
from scipy import special, stats

from op3.diagnose import Diagnosis, WindowResiduals, planned_suite, split_logs
from op3.diagnose.motion import PREROLL
from op3.diagnose.packets import ARRIVED, LOST, LossHypothesis, LostPackets, as_lossy, lost_packets, without_losses
from op3.robot import leg_suite
from op3.servo import Estimate
from op3.servo.effects import PacketDrop
from op3.sim import load_model

PROBABILITY, SEED = 0.04, 5

SETTLING = 25
"""Packets before the first row of a simulated log."""


def diagnosis_of(truth) -> Diagnosis:
    """Of windows of a leg on the stand that was simulated under a model, by the model `paper`."""
    runs = [run for run in leg_suite(3, 5.0) if run.motion.name.startswith(("multisine", "steps", "squats"))]
    split = split_logs(planned_suite(truth, runs))
    return Diagnosis(load_model("paper"), split, engine=WindowResiduals(split, fit_windows=20, select_windows=6))


def windows_of(diagnosis: Diagnosis) -> WindowResiduals:
    assert isinstance(diagnosis.engine, WindowResiduals)
    return diagnosis.engine


def test_the_packets_that_seem_lost_are_those_that_were():
    """Nearly all that are told were lost, most that were lost are told, and the share is within its interval."""
    effect = PacketDrop(seed=SEED)
    diagnosis = diagnosis_of(load_model("paper").with_effect(effect, {"drop_probability": PROBABILITY}))
    engine, base = windows_of(diagnosis), diagnosis.linearised()
    found = lost_packets(engine, base)
    assert found is not None
    low, high = found.interval()
    assert low < PROBABILITY < high
    chance = torch.rand(4096, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64).numpy()
    truth = np.stack(
        [chance[t - PREROLL + SETTLING : t + engine.ticks + 1 + SETTLING] < PROBABILITY for _, t in engine.windows]
    )
    told = found.packets == LOST
    assert set(np.unique(found.packets)) == {LOST, ARRIVED}
    assert told.sum() >= 0.5 * truth.sum()
    assert (told & truth).sum() >= 0.9 * told.sum()
    assert (engine.packets == ARRIVED).all()
    hypothesis = next(s.hypothesis for s in diagnosis.screen(base) if s.hypothesis.effect is PacketDrop)
    (refitted,) = diagnosis.refit_of(base, [s for s in diagnosis.screen(base) if s.hypothesis.effect is PacketDrop])
    assert isinstance(hypothesis, LossHypothesis)
    finding = diagnosis.finding_of(refitted, base, 1.0)
    assert finding.size == found.share
    assert finding.interval[0] < low < high < finding.interval[1]  # a law that is not quite the robot's, besides
    assert finding.gain > 0.2


@pytest.mark.parametrize("latency", [0.006, 0.009])
def test_a_leg_that_lost_none_tells_of_none(latency):
    """Also where all commands come later than the model knows, which looks like half a lost packet in every tick."""
    diagnosis = diagnosis_of(load_model("paper").with_values({"command_latency": latency}))
    base = diagnosis.linearised()
    assert lost_packets(windows_of(diagnosis), base) is None
    assert not any(s.hypothesis.effect is PacketDrop for s in diagnosis.screen(base))
    # what they would tell of losses can be asked all the same
    assert max(s.visibility for s in diagnosis.screen(base, True) if s.hypothesis.effect is PacketDrop) > 0.5


@pytest.mark.parametrize("latency", [0.008, 0.010])
def test_losses_are_looked_for_again_beside_a_leader(latency):
    """Where commands come later as well, no loss can be told by the first base; by what has found that, it can."""
    late = load_model("paper").with_values({"command_latency": latency})
    truth = late.with_effect(PacketDrop(seed=SEED), {"drop_probability": PROBABILITY})
    diagnosis = diagnosis_of(truth)
    engine = windows_of(diagnosis)
    leader = Diagnosis(late, diagnosis.split, engine=engine).linearised()
    diagnosis.base = base = diagnosis.linearised()  # by which the engine is prepared when this is asked
    assert lost_packets(engine, base) is None
    assert not diagnosis.loses_after_all(base)
    assert diagnosis.loses_after_all(leader)


def test_losses_in_a_row_are_found_one_by_one():
    """Three packets lost in a row hold the command for three periods; half are told, and next to nothing else."""
    diagnosis = diagnosis_of(load_model("paper"))
    engine = windows_of(diagnosis)
    diagnosis.linearised()
    truth = np.zeros(engine.packets.shape, dtype=bool)
    for row in range(0, len(truth), 2):
        truth[row, PREROLL + 6 : PREROLL + 9] = True
    engine.packets = np.where(truth, LOST, ARRIVED)
    lossy = load_model("paper").with_effect(PacketDrop(), {"drop_probability": 0.05})
    engine.measured = engine.measured + engine.errors(lossy)[0]
    engine.packets = np.full(truth.shape, ARRIVED)
    engine.prepare(load_model("paper"))
    found = lost_packets(engine, diagnosis.linearised())
    assert found is not None
    told = found.packets == LOST
    assert (told & truth).sum() >= 0.5 * truth.sum()
    assert (told & truth).sum() >= 0.85 * told.sum()
    assert 1.5 < found.together < 4.5


def test_a_lossy_model_keeps_its_count():
    """Runs that are compared tick by tick are without losses; what comes of them has those of the finding again."""
    paper = load_model("paper")
    lossy = paper.with_effect(PacketDrop(), {"drop_probability": Estimate(0.02, 0.01, 0.03)})
    assert without_losses(lossy).value("drop_probability") == 0.0
    assert without_losses(paper) is paper
    for model in (paper, without_losses(lossy), lossy):
        assert as_lossy(model, lossy).estimate("drop_probability") == Estimate(0.02, 0.01, 0.03)
    assert as_lossy(paper, paper) is paper


@pytest.mark.parametrize(("lost", "telling"), [(3, 100), (0, 50), (20, 20)])
def test_the_interval_of_a_count_is_exact(lost, telling):
    """As SciPy's exact interval of a proportion."""
    low, high = LostPackets(np.zeros((1, 1)), telling, lost).interval()
    expected = stats.binomtest(lost, telling).proportion_ci(0.9, method="exact")
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_losses_in_rows_count_for_fewer():
    """Twice as many that come in pairs tell less than their number would; one by one it is exact."""
    alone, paired = LostPackets(np.zeros((1, 1)), 400, 20), LostPackets(np.zeros((1, 1)), 400, 20, 2.0)
    (low, high), (lower, higher) = alone.interval(), paired.interval()
    assert lower < low < alone.share == paired.share < high < higher
    lost, arrived = 20 / 3, 380 / 3
    exact = special.betaincinv([lost, lost + 1], [arrived + 1, arrived], [0.05, 0.95])
    assert (lower, higher) == pytest.approx(tuple(exact), abs=1e-9)


def test_the_interval_covers_shares_of_packets_that_are_lost_in_rows():
    """Rows of a geometric length of two on average: nine in ten intervals hold the share; of single ones fewer do."""
    rng = np.random.default_rng(4)
    share, stays, packets = 0.04, 0.5, 1500
    begins = share * (1 - stays) / (1 - share)
    held = {1.0: 0, 2.0: 0}
    for _ in range(300):
        draws, lost, count = rng.random(packets), False, 0
        for draw in draws:
            lost = bool(draw < (stays if lost else begins))
            count += lost
        for together in held:
            low, high = LostPackets(np.zeros((1, 1)), packets, count, together).interval()
            held[together] += low <= share <= high
    assert held[2.0] >= 0.86 * 300
    assert held[1.0] < 0.8 * 300


def test_packets_asked_together_are_as_asked_alone():
    """Variants of what arrived, simulated at once, leave the residuals of each told to the engine by itself."""
    diagnosis = diagnosis_of(load_model("paper"))
    engine = windows_of(diagnosis)
    diagnosis.linearised()
    model = load_model("paper").with_effect(PacketDrop(), {"drop_probability": 0.5})
    variants = np.full((3, *engine.packets.shape), ARRIVED)
    variants[1, ::2, PREROLL + 4], variants[2, 1, PREROLL + 7 :] = LOST, LOST
    together = engine.residuals_with(variants, model)
    for packets, found in zip(variants, together, strict=True):
        engine.packets = packets
        np.testing.assert_allclose(found, engine.residuals(model)[0], rtol=0, atol=1e-3)
    assert np.abs(together[1] - together[0]).max() > 0.1
