"""Identification end to end: a model that made the log is found again."""

import optuna
import pytest

from op3.identify.identification import PREFIX, Identification
from op3.identify.search_space import parse_search_space
from op3.identify.study import StudySettings, run_study
from op3.motions import squat
from op3.replay import simulate_motion
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.sim import load_model
from tests.op3_table import CONTROLLED_JOINTS

TRUTH = {"torque_constant": 0.0072, "backward_efficiency": 0.7}
SPACE = parse_search_space(
    {PREFIX + "torque_constant": "interval(0.003, 0.009)", PREFIX + "backward_efficiency": "interval(0.6, 1.0)"}
)


def searched(identification: Identification, space=SPACE, trials: int = 12) -> optuna.Study:
    """A study of random trials."""
    how = StudySettings(space, "random", n_trials=trials, population=trials, seed=0)
    return run_study(identification.evaluate, how, progress=False)


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return load_model("paper")


@pytest.fixture(scope="module")
def logs(model) -> list[Rollout]:
    truth = model.with_values(TRUTH)
    return [simulate_motion(truth, squat(frequency=f, duration=1.0)) for f in (1.0, 0.8)]


@pytest.fixture(scope="module")
def identification(model, logs) -> Identification:
    return Identification(model, logs[:1], logs[1:], list(TRUTH), joints=CONTROLLED_JOINTS, label="with DTE")


@pytest.fixture(scope="module")
def study(identification) -> optuna.Study:
    return searched(identification)


def test_least_squares_finds_the_parameters_that_made_the_log(identification, study):
    """From the best of twelve random trials the truth is found within one percent, and its interval is narrow."""
    fit = identification.finish(study, starts=2, max_iterations=8)
    for name, value in TRUTH.items():
        estimate = fit.model.estimates[name]
        assert estimate.value == pytest.approx(value, rel=0.01)
        assert estimate.low <= estimate.value <= estimate.high
        assert estimate.high - estimate.low < 0.2 * value
    assert fit.fit.loss < 1e-5
    assert fit.heldout is not None
    assert fit.heldout.loss < 1e-4


def test_the_study_alone_gives_its_best_trial(identification, study):
    """Without refinement the model holds the best trial's values, and every trial's loss is kept."""
    fit = identification.finish(study)
    best = {key.removeprefix(PREFIX): value for key, value in study.best_params.items()}
    assert {name: fit.model.estimates[name].value for name in TRUTH} == best
    assert len(fit.trials) == 12
    assert fit.fit.loss == pytest.approx(study.best_value, rel=1e-6)
    assert fit.simulated_seconds >= 12


def test_unit_weights_are_the_papers_loss(identification, study):
    """With the default loss, the reported eq. (7) is what was minimised: the sum of its terms."""
    fit = identification.finish(study)
    assert fit.fit.paper_eq7 == pytest.approx(fit.fit.loss)
    assert sum(fit.fit.terms.values()) == pytest.approx(fit.fit.loss)


def test_parameters_of_effects_that_are_off_are_refused(model, logs):
    """A group without its effect is named, with what to do."""
    with pytest.raises(ValueError, match=r"backward_efficiency.*omit the group"):
        Identification(model.without("dte"), logs, [], list(TRUTH))


def test_rounds_of_the_surrogate_find_the_parameters_without_least_squares(model, logs):
    """Twelve trials and rounds of four squats come to the truth; what the trials simulated is not simulated again."""
    problem = Identification(model, logs[:1], [], list(TRUTH), joints=CONTROLLED_JOINTS)
    fit = problem.finish(searched(problem), rounds=3, batch=4)
    for name, value in TRUTH.items():
        assert fit.model.estimates[name].value == pytest.approx(value, rel=0.02)
    assert list(fit.refined) == sorted(fit.refined, reverse=True)
    # twelve trials, three rounds of four, the score, the blocks and the differences behind the intervals
    assert fit.simulated_seconds <= (12 + 3 * 4 + 2 + 5) * problem.problem.replay.seconds + 1e-6


def test_joints_that_differ_are_told_apart():
    """A parameter searched per joint finds the one knee that rubs more; the model that is kept is the one simulated."""
    names = [f"coulomb_friction@joint={joint}" for joint in ("l_knee", "r_knee")]
    model = load_model("paper")
    # with the feet on the ground the legs carry one another, and a log hardly tells left from right
    log = simulate_motion(model.with_values({names[0]: 0.2}), squat(frequency=1.0, duration=1.0), mount="stand")
    identification = Identification(model, [log], [], names, joints=CONTROLLED_JOINTS)
    space = parse_search_space({PREFIX + name: "interval(0.01, 0.25)" for name in names})
    fit = identification.finish(searched(identification, space), starts=1)
    left, right = (fit.model.estimate(name) for name in names)
    assert left.value == pytest.approx(0.2, abs=0.01)
    assert right.value == pytest.approx(model.value("coulomb_friction"), abs=0.01)
    assert left.low is not None
    assert left.low < left.value
    assert fit.model.value("coulomb_friction") == model.value("coulomb_friction")
    kept = Identification(fit.model, [log], [], ["torque_constant"], joints=CONTROLLED_JOINTS)
    again, unseen = kept.score({"torque_constant": model.value("torque_constant")})
    assert unseen is None
    assert again.loss == pytest.approx(fit.fit.loss, rel=1e-3)


def test_joints_that_differ_go_along_with_a_shared_value(model):
    """A search for one value keeps what a model knows of its joints, in what it simulates and in what it finds."""
    knee = "torque_constant@joint=l_knee"
    known = model.with_values({"torque_constant": 0.006, knee: 0.0066})
    log = simulate_motion(known.moved({"torque_constant": 0.007}), squat(frequency=1.0, duration=1.0))
    identification = Identification(known, [log], [], ["torque_constant"], joints=CONTROLLED_JOINTS)
    space = parse_search_space({PREFIX + "torque_constant": "interval(0.003, 0.009)"})
    found = identification.finish(searched(identification, space, 6), starts=1).model
    assert found.value("torque_constant") == pytest.approx(0.007, rel=1e-3)
    assert found.value("torque_constant") * 1.1 == pytest.approx(found.estimate(knee).value)


def test_the_whole_robot_has_no_value_per_joint(model, logs):
    """The trunk's mass is not a joint's."""
    with pytest.raises(ValueError, match="belongs to the whole robot"):
        Identification(model, logs, [], ["base_mass_offset@joint=l_knee"])
    with pytest.raises(ValueError, match="no joint 'servo'; it has head_pan"):
        Identification(model, logs, [], ["coulomb_friction@joint=servo"])
