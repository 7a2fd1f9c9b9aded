"""Re-identification from the returns of episodes."""

from dataclasses import replace

import numpy as np
import optuna
import pytest
import torch
from optuna.distributions import FloatDistribution

from op3.envs import BatchedEnv, record_episodes
from op3.identify.level_set_sampler import IMAGE, MISFIT
from op3.identify.study import StudySettings, run_study
from op3.motions import squat
from op3.policy import PolicyBundle
from op3.replay import simulate_motion
from op3.rollout import LogError, Rollout
from op3.sim import load_model
from op3.tasks.task import find_task
from op3.transfer.failed_episodes import check_episode, that_count
from op3.transfer.reidentification import PLAUSIBLE, Reidentification
from tests.envs.holding import holding_bundle

TASK = find_task("balance_eval", duration=1.6)
NAMES = ("torque_constant", "coulomb_friction")
SETTINGS = {"task": TASK, "repeats": 4, "seed": 3}


@pytest.fixture(scope="module")
def recorded():
    """A robot with a weaker motor than the model's: what its re-identification is given."""
    model, policy = load_model("paper"), holding_bundle(p_gain=2.0)
    robot = model.with_values({"torque_constant": 0.0049})
    motion = squat()
    short = type(motion)(motion.time[:126], motion.position[:126], motion.joints, motion.name, robot="op3")
    excitation = [simulate_motion(robot, short)]
    env = BatchedEnv(TASK, robot, 4, 3, action_map=policy.manifest.action_map)
    env.reset = lambda *_, **__: env.begin({i: i for i in range(4)})  # the episodes that candidates play
    return model, excitation, record_episodes(env, policy), policy, NAMES


@pytest.fixture(scope="module")
def problem(recorded):
    """One second of the robot's squat, and four of its episodes."""
    return Reidentification(*recorded, **SETTINGS)


def trial(problem, constant: float | None = None, friction: float | None = None) -> dict[str, float]:
    """Parameters of a trial; the model's where None."""
    usual = [problem.model.value(name) for name in NAMES]
    values = [known if given is None else given for given, known in zip((constant, friction), usual, strict=True)]
    return {f"parameters.{name}": value for name, value in zip(NAMES, values, strict=True)}


def test_the_truth_is_closer_in_both_objectives(problem):
    """At the robot's parameters the same episodes are worth the same, and the excitation loss is far smaller."""
    start, truth = problem.evaluate([trial(problem, friction=0.09), trial(problem, 0.0049)])
    assert truth.values[0] < 0.05 * start.values[0]
    assert truth.values[1] < 1e-9 < start.values[1]


def test_trials_keep_what_proposals_are_learned_from(problem):
    """An image as long as the excitation's residual, and the misfit of the returns where episodes were played."""
    value, friction = (problem.model.value(name) for name in NAMES)
    near, far = problem.evaluate([trial(problem, friction=1.1 * friction), trial(problem, 0.5 * value)])
    assert np.square(near.attributes[IMAGE]).sum() == pytest.approx(near.values[0], rel=0.5)
    assert np.abs(near.attributes[MISFIT]).mean() == pytest.approx(near.values[1], rel=1e-4)
    assert far.values[0] > PLAUSIBLE * problem.start.excitation
    assert IMAGE in far.attributes
    assert MISFIT not in far.attributes


def test_a_race_spares_the_worse_half_and_changes_no_winner(problem):
    """Half of a population plays two of four episodes; the others get what they get where all play all."""
    population = [trial(problem, kt) for kt in (0.0049, 0.0050, 0.0052, 0.0056, 0.0060, 0.0064)]
    raced = problem.evaluate(population)
    problem.race = False
    try:
        whole = problem.evaluate(population)
    finally:
        problem.race = True
    played = [outcome.attributes["episodes"] for outcome in raced]
    assert sorted(played) == [2, 2, 2, 4, 4, 4]
    assert played[0] == 4  # the truth
    for one, other, episodes in zip(raced, whole, played, strict=True):
        assert ("returns" in one.attributes) == (episodes == 4)
        if episodes == 4:
            assert one.values == pytest.approx(other.values, rel=1e-9)


def test_joints_that_differ_go_along(recorded):
    """A diagnosis says how servos differ: candidates keep that, in the squat, in the episodes and in the model."""
    model, *given, names = recorded
    knee = "torque_constant@joint=l_knee"
    differing = model.with_values({knee: 1.1 * model.value("torque_constant")})
    problem = Reidentification(differing, *given, names, **SETTINGS)
    values = {name: model.value(name) for name in names}
    alike, there = problem._measure([values, {**values, "torque_constant": 0.0049}])
    assert alike == problem.start
    at = differing.moved(there.values)
    assert at.estimate(knee).value == pytest.approx(1.1 * 0.0049)
    direct = Reidentification(at, *given, names, **SETTINGS).start
    assert (there.excitation, there.distance) == pytest.approx((direct.excitation, direct.distance), rel=1e-9)


def test_processes_share_a_population(problem, recorded):
    """Two processes find what one does, in its order, and simulate as long."""
    population = [trial(problem, kt) for kt in (0.0049, 0.0064, 0.0052)]
    before = problem.simulated_seconds
    alone = problem.evaluate(population)
    spent = problem.simulated_seconds - before
    shared = Reidentification(*recorded, **SETTINGS, processes=2)
    before = shared.simulated_seconds
    for one, other in zip(shared.evaluate(population), alone, strict=True):
        assert one.values == pytest.approx(other.values, rel=1e-9)
        assert one.attributes == other.attributes
    assert shared.simulated_seconds - before == pytest.approx(spent)


def test_a_study_moves_towards_the_robot(problem):
    """A small NSGA-II study finds a model that is closer to the robot's returns and excitation than the start."""
    space = {
        "parameters.torque_constant": FloatDistribution(0.0046, 0.0084),
        "parameters.coulomb_friction": FloatDistribution(0.034, 0.226),
    }
    directions = ("minimize", "minimize")
    how = StudySettings(space, "nsga2", directions, n_trials=24, population=8, nominal=trial(problem), seed=0)
    found = problem.finish(run_study(problem.evaluate, how, progress=False))
    assert found.chosen.distance < found.start.distance
    assert found.chosen.excitation <= 1.25 * found.start.excitation
    assert found.model.value("torque_constant") == found.chosen.values["torque_constant"]
    assert len(found.front) >= 1
    assert all(len(one.returns) == 4 for one in found.front)
    assert torch.isfinite(torch.tensor([c.distance for c in found.front])).all()


def studied(problem, trials) -> optuna.Study:
    """A study that ended with these torque constants, excitation losses as shares of the start's, and returns."""
    space = {f"parameters.{name}": FloatDistribution(0.0, 1.0) for name in NAMES}
    study = optuna.create_study(directions=["minimize", "minimize"])
    for constant, share, returns in trials:
        params = {"parameters.torque_constant": constant, "parameters.coulomb_friction": 0.1}
        values = [share * problem.start.excitation, problem._distance(returns)]
        attributes = {"episodes": len(returns), "returns": list(returns)}
        study.add_trial(
            optuna.trial.create_trial(params=params, distributions=space, values=values, user_attrs=attributes)
        )
    return study


def replays(problem, monkeypatch, truly) -> list[list[float]]:
    """Let candidates play what `truly` says of their torque constant; collects who plays."""
    played = []

    def replay(candidates, times):
        played.append([one.values["torque_constant"] for one in candidates])
        found = [tuple(truly(one.values["torque_constant"])) for one in candidates]
        return [
            replace(one, returns=own, distance=problem._distance(own))
            for one, own in zip(candidates, found, strict=True)
        ]

    monkeypatch.setattr(problem, "_replay", replay)
    return played


def test_luck_with_the_episodes_of_the_search_does_not_count(problem, monkeypatch):
    """The closest of the search is no better when it plays again; its clone does not play, nor does what may not be."""
    actual = np.array(problem.actual)
    far = actual - 20.0
    monkeypatch.setattr(problem, "start", replace(problem.start, returns=tuple(far), distance=20.0))
    good = {0.3: actual + 5.0, 0.4: actual + 1.0}
    played = replays(problem, monkeypatch, lambda constant: good.get(constant, far))
    lucky, clone, fair, dear = (0.2, 1.1, actual), (0.2001, 1.1, actual), (0.3, 1.2, actual + 6.0), (0.4, 1.3, actual)
    found = problem.finish(studied(problem, [lucky, clone, fair, dear]))
    start = problem.start.values["torque_constant"]
    assert played[0] == [start, 0.2, 0.3]
    assert found.chosen.values["torque_constant"] == 0.3
    assert found.accepted
    assert not found.at_chance
    assert {one.values["torque_constant"] for one in found.front} == {0.2, 0.2001}


def test_a_start_that_is_as_close_as_chance_stays(problem, monkeypatch):
    """Where the same episodes are worth the same, another candidate's fewer differences are no reason to leave."""
    actual = np.array(problem.actual)
    monkeypatch.setattr(problem, "start", replace(problem.start, returns=tuple(actual[::-1]), distance=0.0))
    replays(problem, monkeypatch, lambda constant: actual)
    found = problem.finish(studied(problem, [(0.3, 1.1, actual)]))
    assert found.at_chance
    assert not found.accepted
    assert found.chosen is problem.start
    assert found.model.value("torque_constant") == problem.model.value("torque_constant")


def test_episodes_that_end_otherwise_than_a_simulation_can_are_told_apart(recorded):
    """An episode cut short by the battery is no fall; one of another task, length or policy is refused."""
    log, policy = recorded[2][0], recorded[3]

    def ended(**changes):
        metadata = log.metadata.replace(**{**changes, "extra": {**log.metadata.extra, **changes.get("extra", {})}})
        return Rollout(log.data, metadata)

    logs = [ended(extra={"exit": end}) for end in ("ok", "voltage", "fall", "bus_loss")]
    assert that_count(logs) == ([logs[0], logs[2]], [logs[1], logs[3]])
    check_episode(log, TASK, policy)
    with pytest.raises(LogError, match=r"of the task walk.*give task=walk"):
        check_episode(ended(extra={"task": "walk"}), TASK, policy)
    with pytest.raises(LogError, match=r"without a fall.*record episodes of 10 s"):
        check_episode(ended(fallen=False), find_task("balance_eval"), policy)
    trained = replace(policy.manifest.training, model_hash="0123")
    other = PolicyBundle(replace(policy.manifest, training=trained), policy.weights)
    with pytest.raises(LogError, match="give the bundle that produced the episode"):
        check_episode(ended(model_hash="4567", extra={"exit": "ok"}), TASK, other)
