"""Prediction of logs not seen: errors, their intervals, and models with conditional values."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import stats

from op3.common.sample_intervals import bootstrap_interval
from op3.identify.loss import TrajectoryLoss, position_error
from op3.identify.prediction_score import predict_logs, score_predictions
from op3.motions import squat
from op3.replay import Replay, simulate_motion
from op3.rollout import Metadata, Rollout
from op3.servo import Estimate
from op3.sim import load_model
from tests.op3_table import CONTROLLED_JOINTS


def bench_log(mass: float = 0.3, length: float = 0.1, gain: float = 8.0, motion: str = "sine") -> Rollout:
    """A quarter of a second of a servo on a pendulum."""
    time = 0.005 * np.arange(50)
    position = 0.3 * np.sin(6 * time)[:, None]
    arrays = {
        "time": time,
        "command/position": position,
        "command/firmware_gain": np.full((50, 1), gain),
        "joint/position": position,
        "joint/voltage": np.full((50, 1), 6.0),
    }
    metadata = Metadata(("servo",), "rig", "pendulum", 200.0, mass=mass, length=length, motion=motion)
    return Rollout.from_arrays(arrays, metadata)


@pytest.fixture(scope="module")
def logs() -> list[Rollout]:
    """Half a second of two squats by a model of another friction."""
    truth = load_model("paper").with_values({"coulomb_friction": 0.2})
    return [simulate_motion(truth, squat(frequency=f, duration=0.5)) for f in (1.0, 0.8)]


def test_a_model_predicts_its_own_log(logs):
    """The model that made the logs leaves nothing but numerical noise, another one more."""
    own = load_model("paper").with_values({"coulomb_friction": 0.2})
    exact = predict_logs(own, logs, joints=CONTROLLED_JOINTS)
    other = predict_logs(load_model("paper"), logs, joints=CONTROLLED_JOINTS)
    assert exact.error_mrad.value < 0.05 < other.error_mrad.value
    assert exact.paper_eq7.value < 1e-4 < other.paper_eq7.value


def test_errors_are_those_of_the_loss(logs):
    """Position error and eq. (7) are those that identification reports for the same replay."""
    model = load_model("paper")
    score = predict_logs(model, logs, joints=CONTROLLED_JOINTS)
    predictions = Replay(logs).run(model)
    assert score.error_mrad.value == pytest.approx(1e3 * float(position_error(predictions, CONTROLLED_JOINTS).mean()))
    assert score.paper_eq7.value == pytest.approx(float(TrajectoryLoss(CONTROLLED_JOINTS)(predictions)))
    assert score.error_mrad.low < score.error_mrad.value < score.error_mrad.high
    # the rms of a channel is that over its joints
    knees = [e.value**2 for e in score.joints["joint/position"].values()]
    assert score.channels["joint/position"].value == pytest.approx(np.sqrt(np.mean(knees)))


def test_conditions_that_the_model_does_not_know_get_the_shared_value():
    """A log of a length that was never fitted is predicted with the shared offset, a known length with its own."""
    shared, special = 0.05, 0.2
    model = load_model("sts3032").with_values(
        {"encoder_offset": Estimate(shared), "encoder_offset@length=0.1": special}
    )
    same = load_model("sts3032").with_values({"encoder_offset": special})
    other = load_model("sts3032").with_values({"encoder_offset": shared})
    known, unknown = bench_log(length=0.1), bench_log(length=0.13, mass=0.7, gain=24.0)

    def error(one, log) -> float:
        return predict_logs(one, [log]).error_mrad.value

    assert error(model, known) == error(same, known) != error(other, known)
    assert error(model, unknown) == error(other, unknown) != error(same, unknown)


def test_logs_that_were_fitted_are_known(logs):
    """A model file that names a log's fingerprint says so, whatever the log is called."""
    model = dataclasses.replace(load_model("paper"), provenance={"fitted_logs": [logs[0].fingerprint()]})
    renamed = Rollout(logs[0].data, logs[0].metadata.replace(recording="other"))
    assert [entry.seen for entry in predict_logs(model, [renamed, logs[1]]).logs] == [True, False]


def test_a_diverged_log_is_named_and_left_out(logs):
    """A log whose simulation failed has no error, and the mean is that of the other log."""
    model = load_model("paper")
    first, second = Replay(logs).run(model)
    failed = dataclasses.replace(first, failed=torch.tensor([True]))
    score = score_predictions(model, [failed, second], joints=CONTROLLED_JOINTS)
    assert score.logs[0].error_mrad is None
    assert score.error_mrad.value == pytest.approx(score.logs[1].error_mrad)
    assert score_predictions(model, [failed]).error_mrad is None


def test_bootstrap_intervals_cover():
    """Of 300 samples of eight normal values, 90 % intervals hold the mean about as often as Student's do."""
    rng = np.random.default_rng(0)
    samples = rng.normal(1.0, 1.0, (300, 8))
    inside = [low <= 1.0 <= high for low, high in (bootstrap_interval(s) for s in samples)]
    half = stats.t.ppf(0.95, 7) / np.sqrt(8)
    student = np.abs(samples.mean(1) - 1.0) <= half * samples.std(1, ddof=1)
    assert np.mean(inside) == pytest.approx(np.mean(student), abs=0.05)
    assert np.mean(inside) > 0.84
