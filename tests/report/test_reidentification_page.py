"""Pages and numbers of re-identifications."""

import optuna
import pytest
from optuna.distributions import FloatDistribution

from op3.report import RunFolder, read_result
from op3.report.comparison_page import read_runs, write_comparison
from op3.report.reidentification_page import report_reidentification
from op3.sim import load_model
from op3.transfer.reidentified import ParetoPoint, Reidentified

NAME = "torque_constant"
SPACE = {f"parameters.{NAME}": FloatDistribution(0.003, 0.009)}


def candidate(value, excitation, distance, returns=(200.0, 210.0)):
    return ParetoPoint({NAME: value}, excitation, distance, returns)


def report(folder, value=0.006, fresh=20.0, distance=10.0):
    """A run in which the distance fell from 50 to `distance`, over fresh episodes from 40 to `fresh`."""
    start, chosen = candidate(0.0045, 1.0, 50.0, (250.0, 255.0)), candidate(value, 1.1, distance)
    model = load_model("paper")
    found = Reidentified(
        model.with_values({NAME: value}), start, chosen, [start, chosen], [199.0, 201.0],
        candidate(0.0045, 1.0, 40.0), candidate(value, 1.1, fresh), noise=5.0,
    )  # fmt: skip
    study = optuna.create_study(directions=["minimize", "minimize"])
    for one, attributes in (
        (start, {"returns": [1.0], "episodes": 2}),
        (chosen, {"returns": [1.0], "episodes": 2}),
        (candidate(0.008, 9.0, 200.0), {"skipped": "implausible excitation loss", "episodes": 0}),
    ):
        values = [one.excitation, one.distance]
        params = {f"parameters.{NAME}": one.values[NAME]}
        study.add_trial(
            optuna.trial.create_trial(params=params, distributions=SPACE, values=values, user_attrs=attributes)
        )
    return report_reidentification(
        found, study, RunFolder(folder, {"seed": 0}), wall_seconds=1.0, simulated_seconds=2.0
    )


def test_the_numbers_hold_both_objectives_fresh_episodes_and_places_in_table_i(tmp_path):
    """0.006 lies in the middle of [0.003, 0.009], 0.0045 at a quarter; the page has front, rule and distributions."""
    report(tmp_path)
    numbers = read_result(tmp_path / "result.yaml")
    assert numbers["distance.ratio"] == 0.2
    assert numbers["fresh.ratio"] == 0.5
    assert numbers["fresh.noise"] == 5.0
    assert numbers["excitation.ratio"] == pytest.approx(1.1)
    assert numbers[f"normalised.excitation_only.{NAME}"] == pytest.approx(0.25)
    assert numbers[f"normalised.reidentified.{NAME}"] == pytest.approx(0.5)
    assert (numbers["trials"], numbers["trials_played"], numbers["trials_skipped"]) == (3, 2, 1)
    assert numbers["front.distance"] == [50.0, 10.0]
    text = (tmp_path / "index.html").read_text()
    assert (
        "lowers the distance between simulated and actual returns from 50 to 10, and from 40 to 20 over fresh episodes"
        in text
    )
    assert "Candidates qualify if their excitation loss is at most 1.25 times" in text
    assert "chance alone would leave 5" in text
    for label in ("excitation only", "re-identified", "actual", "Pareto front", "ranges of Table I"):
        assert label in text


def test_a_gain_that_fresh_episodes_do_not_confirm_is_not_called_one(tmp_path):
    """From 50 to 10 over the episodes searched with, but from 40 to 45 over others: the first sentence says so."""
    report(tmp_path, fresh=45.0)
    text = (tmp_path / "index.html").read_text()
    assert "No lasting gain" in text
    assert "from 40 to 45 over fresh ones" in text
    assert "Re-identification lowers" not in text


def test_what_was_accepted_is_not_told_as_refused(tmp_path):
    """Closer over the episodes that decided, not over those searched with, from 50 to 60: the model has changed."""
    report(tmp_path, distance=60.0)
    text = (tmp_path / "index.html").read_text()
    assert "No candidate came closer" not in text
    assert "the distance changed from 50 to 60 over the latter, and from 40 to 20 over fresh ones" in text


def test_seeds_are_summed_up_by_mean_and_deviation(tmp_path):
    """Places 0.5 and 0.6 of the range: mean 0.55, standard deviation 0.1 / sqrt(2); the distance is a fifth in both."""
    report(tmp_path / "0", 0.006)
    report(tmp_path / "1", 0.0066)
    page, numbers = write_comparison(read_runs(tmp_path), tmp_path)
    (found,) = read_result(numbers)["variants"]
    assert found[f"normalised.reidentified.{NAME}"]["value"] == pytest.approx(0.55)
    assert found[f"normalised.reidentified.{NAME}"]["deviation"] == pytest.approx(0.1 / 2**0.5)
    assert found["distance.ratio"]["value"] == pytest.approx(0.2)
    assert "normalised by Table I: mean and deviation over seeds" in page.read_text()
