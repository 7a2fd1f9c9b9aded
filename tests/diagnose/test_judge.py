"""The judge on rows whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from op3.diagnose.judge import CoefficientPriors, Judge, Rows, evidence
from op3.diagnose.judge_settings import Settings

KINDS = np.array([0, 1, 1, 1, 2, 3, 3, 3])
JOINTS, WINDOWS, CANDIDATES, LAWS = 4, 60, 12, 8
SLAB, SPIKE = 4.0, 0.2


def made(rng, sizes=(), wild=0.0, law=0.15, missing=None) -> Judge:
    """Rows with a base of two numbers, candidates (the first of all joints, the others of one each), and a law.

    Args:
        sizes: of candidates, by number; what each makes is one unit of torque, root mean square.
        wild: share of windows with ten times the noise.
        law: what joints do and nobody explains [units].
        missing: a column that is there and in no candidate.
    """
    shape = (WINDOWS, len(KINDS))
    torque = KINDS < 2
    columns = rng.standard_normal((JOINTS, 2 + CANDIDATES, *shape)) * torque
    for j in range(JOINTS):
        for k in range(1, CANDIDATES):
            if k % JOINTS != j:
                columns[j, 2 + k] = 0.0
    features = rng.standard_normal((JOINTS, *shape, LAWS)) / np.sqrt(LAWS) * torque[:, None]
    noise = 0.3 * rng.standard_normal((JOINTS, *shape))
    noise *= np.where(rng.random((JOINTS, WINDOWS, 1)) < wild, 10.0, 1.0)
    truth = np.zeros(2 + CANDIDATES)
    truth[:2] = rng.standard_normal(2)
    little = np.where(np.arange(CANDIDATES) < CANDIDATES, SPIKE * 0.3, 0.0) * rng.standard_normal(CANDIDATES)
    truth[2:] = little
    for k, size in dict(sizes).items():
        truth[2 + k] = size
    measured = np.einsum("jkwr,k->jwr", columns, truth) + noise
    measured += np.einsum("jwrf,jf->jwr", features, law * np.sqrt(LAWS) * rng.standard_normal((JOINTS, LAWS)))
    if missing is not None:
        measured = measured + missing * rng.standard_normal(measured.shape) * torque
    kept = [np.flatnonzero(np.abs(columns[j]).max((1, 2)) > 0) for j in range(JOINTS)]
    rows = Rows(
        tuple("abcd"),
        KINDS,
        measured,
        np.full(measured.shape, 0.01),
        features,
        tuple(kept),
        tuple(columns[j, at] for j, at in enumerate(kept)),
    )
    place = np.log(0.5 / np.where(np.arange(CANDIDATES) == 0, 1, CANDIDATES - 1))
    numbers = CoefficientPriors(
        np.zeros(2 + CANDIDATES),
        np.where(np.arange(2 + CANDIDATES) < 2, 3.0, SPIKE),
        tuple((2 + k,) for k in range(CANDIDATES)),
        *(np.full(CANDIDATES, value) for value in (SLAB, -8.0, 8.0)),
        place,
    )
    return Judge(rows, numbers, Settings(unmodelled=law))


def scores(judge: Judge) -> np.ndarray:
    return judge.scores(judge.fit(rounds=4))


def test_evidence_is_the_integral_it_says():
    """Against the trapezoidal rule, of a truncated prior."""
    grid = np.linspace(-1.0, 3.0, 40001)
    prior = stats.truncnorm((-1 - 0.3) / 0.8, (3 - 0.3) / 0.8, 0.3, 0.8).pdf(grid)
    expected = np.log(np.trapezoid(np.exp(1.7 * grid - 0.5 * 2.3 * grid**2) * prior, grid))
    found = evidence(np.array(1.7), np.array(2.3), 0.3, np.array(0.8), -1.0, 3.0)
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_large_effect_is_told_from_all_others():
    """One candidate of slab size leads by far, whether all joints have it or one."""
    for number in (0, 6):
        found = scores(made(np.random.default_rng(3), {number: 2.0}))
        assert found.argmax() == number
        assert found[number] > 20.0
        assert np.delete(found, number).max() < 6.0


def test_sound_rows_raise_no_alarm():
    """Of 40 sets of rows in which everything is there a little, none reaches the alarm."""
    best = [scores(made(np.random.default_rng(seed), wild=0.1)).max() for seed in range(40)]
    assert max(best) < Settings().alarm


def test_stated_odds_are_those_of_the_prior():
    """Sizes drawn from spike and slab alike: of the candidates to which the judge gives even odds half are slabs."""
    told, truth = [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 5])
        slab = rng.random(CANDIDATES) < 0.15
        sizes = {k: np.clip(rng.standard_normal() * SLAB, -8, 8) for k in np.flatnonzero(slab)}
        judge = made(rng, sizes)
        fit = judge.fit(np.flatnonzero(slab), rounds=4)
        for k in range(CANDIDATES):
            named = [i for i in np.flatnonzero(slab) if i != k]
            odds = judge.scores(judge.fit(named, fit.variances, rounds=0))[k] - judge.priors.log_prior[k]
            told.append(1 / (1 + np.exp(-np.clip(odds + np.log(0.15 / 0.85), -50, 50))))
            truth.append(slab[k])
    told, truth = np.array(told), np.array(truth)
    for low, high in ((0.0, 0.2), (0.8, 1.01)):
        mine = (told >= low) & (told < high)
        assert abs(told[mine].mean() - truth[mine].mean()) < 0.1


def test_what_no_candidate_explains_is_nobodys_finding():
    """Torque that goes with the features of a joint is its law, whose size grows, and names nothing."""
    judge = made(np.random.default_rng(2), law=1.0)
    fit = judge.fit(rounds=6)
    assert judge.scores(fit).max() < Settings().alarm
    assert fit.variances.unmodelled.min() > 0.5


def test_wild_windows_hide_nothing_and_name_nothing():
    """A tenth of the windows with ten times the noise: they are weighed down, and the effect is found as without."""
    judge = made(np.random.default_rng(7), {3: 2.0}, wild=0.1)
    fit = judge.fit(rounds=6)
    assert fit.variances.weight.min() < 0.1
    assert judge.scores(fit).argmax() == 3
    assert judge.fit([3], fit.variances).mean[-1] == pytest.approx(2.0, abs=0.4)


def test_what_a_base_explains_only_beyond_its_range_is_a_fault():
    """A candidate that does what a number of the base does is told from it where that would leave its range, and its
    score is then what a fit with it says."""
    free = made(np.random.default_rng(4))
    for values in free.rows.design:
        values[2] = values[0]
    most = np.full(2 + CANDIDATES, np.inf)
    most[0] = free.fit(rounds=4).mean[0] - 1.0
    bounded = Judge(free.rows, replace(free.priors, upper=most), free.settings)
    fit = bounded.fit(rounds=4)
    odds = bounded.scores(fit)
    assert odds.argmax() == 0
    assert odds[0] > scores(free)[0] + 6.0
    with_it, without = (bounded.fit(named, fit.variances, rounds=0).evidence for named in ([0], []))
    assert odds[0] == pytest.approx(with_it - without + bounded.priors.log_prior[0], abs=0.3)


def test_windows_on_the_edge_of_sticking_count_less():
    """Rows of large known variance move no number, however far off they are."""
    judge = made(np.random.default_rng(9), {2: 2.0})
    edge = np.random.default_rng(0).random((JOINTS, WINDOWS)) < 0.2
    judge.rows.residual[edge] += 30.0
    judge.rows.variance[edge] = 900.0
    again = Judge(judge.rows, judge.priors, judge.settings)
    fit = again.fit([2], rounds=4)
    assert again.scores(again.fit(rounds=4)).argmax() == 2
    assert fit.mean[-1] == pytest.approx(2.0, abs=0.4)


def test_twins_share_what_they_explain():
    """Two candidates with one column cannot both be told: their scores are the same, and only together decisive."""
    judge = made(np.random.default_rng(4), {1: 2.0})
    values = [value.copy() for value in judge.rows.design]
    rows = judge.rows
    for j, at in enumerate(rows.coefficients):
        if 3 in at and 7 in at:
            values[j][list(at).index(7)] = values[j][list(at).index(3)]
    twin = Judge(replace(rows, design=tuple(values)), judge.priors, judge.settings)
    found = scores(twin)
    assert found[1] == pytest.approx(found[5], abs=0.5)
    assert found[[1, 5]].min() > np.delete(found, [1, 5]).max()


def test_a_pair_is_told_from_its_halves():
    """What two joints have alike is more probable as one effect of both than as one of either."""
    judge = made(np.random.default_rng(11), {1: 1.5, 2: 1.5})
    n = judge.priors
    longer = {name: np.append(getattr(n, name), getattr(n, name)[1]) for name in ("slab", "low", "high", "log_prior")}
    found = scores(
        Judge(judge.rows, CoefficientPriors(n.mean, n.deviation, (*n.members, (3, 4)), **longer), judge.settings)
    )
    assert found.argmax() == CANDIDATES
