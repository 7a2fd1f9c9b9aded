"""What decides names: predictions of runs that were left out."""

import numpy as np
import pytest
from scipy import stats

from op3.diagnose import WindowResiduals
from op3.diagnose.base import gauss_newton
from op3.diagnose.coordinates import base_coordinates, with_chain
from op3.diagnose.held_out import DRAWS, Gain, HeldOut, log_density
from op3.diagnose.reduction import Reduction
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.sim import load_model
from tests.op3_table import LEG_JOINTS


def test_a_gain_is_counted_in_standard_errors_over_runs():
    """Gains of 1, 2 and 3: 2 with an error of 1 / sqrt(3), Student's t of 3.46 with two degrees of freedom, of which a
    tail of 3.7 % is left, as of a normal behind 1.79."""
    better, other = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 3.0]]), np.zeros((3, 2))
    gain = Gain.of(better, other)
    assert (gain.mean, gain.error, gain.runs) == (pytest.approx(2.0), pytest.approx(3**-0.5), 3)
    assert gain.z == pytest.approx(1.786, abs=0.01)
    assert Gain.of(other, better).z == pytest.approx(-gain.z)
    assert Gain.of(better, better).z == 0.0


def test_a_density_integrates_the_unexplained_law_out():
    """With noise that has no tails it is that of a normal whose covariance is noise and law."""
    rng = np.random.default_rng(0)
    features, kinds = rng.standard_normal((4, 3, 5)), np.array([0, 1, 1])
    known, noise, law = np.full((4, 3), 0.2), np.array([0.5, 0.3]), 0.7
    flat = features.reshape(12, 5)
    covariance = np.diag((known + noise[kinds] ** 2).ravel()) + law**2 * flat @ flat.T
    found, expected = [], []
    for left in rng.standard_normal((2, 4, 3)):
        found.append(log_density(left, known, features, kinds, noise, law, 1e9))
        expected.append(stats.multivariate_normal(cov=covariance).logpdf(left.ravel()))
    assert found[0] - found[1] == pytest.approx(expected[0] - expected[1], rel=1e-4)


def test_a_reading_that_is_not_there_says_nothing():
    """Rows without a known variance change no density."""
    left, features, kinds = np.array([[0.3, 5.0]]), np.zeros((1, 2, 1)), np.array([0, 2])
    known = np.array([[0.2, np.inf]])
    densities = [log_density(left * [1, k], known, features, kinds, np.full(4, 0.1), 1.0, 4.0) for k in (1, 2)]
    assert densities[0] == pytest.approx(densities[1])


@pytest.fixture(scope="module")
def reduction() -> Reduction:
    """Windows of five runs of a leg with more friction than the paper's model."""
    truth = with_chain(load_model("paper")).with_values({"coulomb_friction": 0.2})
    return Reduction(WindowResiduals(planned_suite(truth, leg_suite(3, 2.5)[:5]), windows=15))


def test_the_numbers_that_made_the_logs_predict_runs_that_were_left_out(reduction):
    """Better than others, beyond chance; runs are left out one by one, each with all of its windows."""
    held = HeldOut(reduction)
    assert not held.in_time
    assert held.runs.max() == 4
    coordinates = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS, reduction.moving)
    at = [(entry.parameter, entry.joints) for entry in coordinates.entries].index(("coulomb_friction", None))
    wrong = np.where(np.arange(len(coordinates.start)) == at, 0.3, coordinates.start)
    right = np.where(np.arange(len(coordinates.start)) == at, 0.2, coordinates.start)
    bases = [gauss_newton(reduction, coordinates, point, steps=0) for point in (right, wrong)]
    rows = reduction.rows(bases[0].linear, ())
    gain = Gain.of(*(held.density(base, rows) for base in bases))
    assert gain.z > 2.0


def test_of_few_runs_blocks_of_time_are_left_out(reduction):
    """Fewer than five runs are no sample."""
    engine = WindowResiduals([log.log for log in reduction.engine.smooth_logs][:2], windows=12)
    held = HeldOut(Reduction(engine))
    assert held.in_time
    assert len(np.unique(held.runs)) == 8


def test_predictions_are_averaged_over_numbers_drawn_from_their_posterior(reduction, monkeypatch):
    """Densities, not their logarithms: of four sets of numbers the unlikely ones cost at most log 4. The sets other
    than the mean lie as far from it as their posterior says: the mean square of whitened steps is their number."""
    coordinates = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS, reduction.moving)
    base = gauss_newton(reduction, coordinates, coordinates.start, steps=0)
    rows, held, at, drawn = reduction.rows(base.linear, ()), HeldOut(reduction), reduction.rows_at, []
    monkeypatch.setattr(reduction, "rows_at", lambda of, own, points: drawn.append(points) or at(of, own, points))
    densities = iter(np.tile([-1.0, -90.0, -90.0, -90.0], 10_000).tolist())
    monkeypatch.setattr("op3.diagnose.held_out.log_density", lambda *args: next(densities))
    assert held.density(base, rows) == pytest.approx(-1.0 - np.log(4))
    points = drawn[0].reshape(-1, DRAWS + 1, len(base.point))
    free = (points[:, 0] > coordinates.low + 1e-3) & (points[:, 0] < coordinates.high - 1e-3)
    steps = (points[:, 1:] - points[:, :1]) / base.deviations
    assert 0.3 < np.square(steps[np.repeat(free[:, None], DRAWS, 1)]).mean() < 3.0
