"""The study engine: the same trials from the same seed, nothing lost, failures recorded."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.distributions import FloatDistribution
from optuna.trial import TrialState

from op3.identify.results import summarize
from op3.identify.search_space import StudyError
from op3.identify.storage import open_storage
from op3.identify.study import StudySettings, TrialOutcome, run_study

SPACE = {"a.x": FloatDistribution(0, 1), "a.y": FloatDistribution(0.1, 10, log=True)}
REPOSITORY = Path(__file__).resolve().parents[2]


def bowl(population):
    """Return (x - 0.3)^2 + log10(y)^2 of each trial."""
    return [TrialOutcome(((p["a.x"] - 0.3) ** 2 + math.log10(p["a.y"]) ** 2,)) for p in population]


def points(study):
    """Return parameters and values of all trials, in order."""
    return [(trial.params, trial.values, trial.state) for trial in study.trials]


def quick_study(evaluate=bowl, space=SPACE, starts=(), identity=None, **settings):
    """Run a small study in memory."""
    settings = {"n_trials": 12, "population": 4, "seed": 0, "sampler": "random", **settings}
    return run_study(evaluate, StudySettings(space, **settings), starts, identity, progress=False)


@pytest.mark.parametrize("sampler", ["random", "tpe", "cmaes", "nsga2"])
def test_a_resumed_study_asks_what_an_uninterrupted_one_asks(sampler, tmp_path):
    """Stopped after three populations and continued from its file, the study has the same 40 trials."""
    whole = quick_study(sampler=sampler, n_trials=40, population=8, storage=tmp_path / "whole.journal")
    parts = tmp_path / "parts.journal"
    quick_study(sampler=sampler, n_trials=24, population=8, storage=parts)
    resumed = quick_study(sampler=sampler, n_trials=40, population=8, storage=parts)
    assert points(resumed) == points(whole)
    assert len({trial.params["a.x"] for trial in resumed.trials}) == 40


def test_a_study_without_a_seed_keeps_the_one_it_drew(tmp_path):
    """Resumed without a seed, a study goes on with its own."""
    path = tmp_path / "study.journal"
    first = quick_study(seed=None, n_trials=4, storage=path).user_attrs["seed"]
    assert quick_study(seed=None, n_trials=8, storage=path).user_attrs["seed"] == first
    with pytest.raises(StudyError, match="has other seed than this run: choose another folder"):
        quick_study(seed=first + 1, n_trials=12, storage=path)


def test_the_nominal_trial_is_the_first_and_comes_once(tmp_path):
    """The baseline is trial 0, marked, and a resumed study does not repeat it."""
    path, nominal = tmp_path / "study.journal", {"a.x": 0.25, "a.y": 2.0}
    quick_study(nominal=nominal, n_trials=4, storage=path)
    study = quick_study(nominal=nominal, n_trials=12, storage=path)
    assert study.trials[0].params == nominal
    assert [t.number for t in study.trials if t.user_attrs.get("nominal")] == [0]


def test_starts_have_children():
    """NSGA-II breeds from the starts: around a narrow valley that random points miss, its next points lie near them."""
    space = {f"x{i}": FloatDistribution(0, 1) for i in range(6)}
    rng = np.random.default_rng(0)
    starts = [{name: float(0.3 + 0.01 * rng.standard_normal()) for name in space} for _ in range(8)]

    def valley(population):
        return [TrialOutcome((sum((value - 0.3) ** 2 for value in p.values()),)) for p in population]

    sampler = {"name": "nsga2", "population_size": 10}
    study = quick_study(valley, space, sampler=sampler, starts=starts, n_trials=36, population=12)
    assert np.median([trial.value for trial in study.trials[24:]]) < 0.02


@pytest.mark.parametrize("bad", [math.nan, math.inf, None, (math.nan,), np.nan])
def test_a_trial_without_a_finite_value_fails_alone(bad):
    """One bad objective is one failed trial with its parameters; the study goes on to its end."""
    study = quick_study(lambda population: [bad, *bowl(population[1:])])
    states = [trial.state for trial in study.trials]
    assert states == ([TrialState.FAIL] + [TrialState.COMPLETE] * 3) * 3
    assert set(study.trials[0].params) == set(SPACE)
    if bad is not None:
        number = bad[0] if isinstance(bad, tuple) else bad
        assert study.trials[0].user_attrs["failed_values"] == [str(number)]


def test_an_exception_fails_only_the_trial_that_raises():
    """The population is halved until the guilty trial is alone; its error is kept."""

    def evaluate(population):
        if any(p["a.x"] > 0.8 for p in population):
            raise FloatingPointError("diverged")
        return bowl(population)

    study = quick_study(evaluate, n_trials=64, population=16)
    for trial in study.trials:
        raises = trial.params["a.x"] > 0.8
        assert trial.state == (TrialState.FAIL if raises else TrialState.COMPLETE)
        error = trial.user_attrs.get("error", "")
        assert error.startswith("FloatingPointError: diverged (test_study.py:") == raises
    assert 0 < summarize(study)["n_failed"] < 64


def test_a_study_in_which_everything_raises_stops_with_the_error():
    """A mistake in the experiment does not cost the whole budget."""

    def evaluate(population):
        raise KeyError("torque_constant")

    with pytest.raises(StudyError, match="torque_constant"):
        quick_study(evaluate, n_trials=1000)


def test_attributes_of_an_outcome_are_stored_as_plain_data(tmp_path):
    """Losses before weighting travel with the trial, numpy or not; what the user has set for Optuna's log stands."""
    path, verbosity = tmp_path / "study.journal", optuna.logging.get_verbosity()

    def evaluate(population):
        extra = {"loss": np.float64(2.0), "per_joint": np.array([1.0, 2.0]), "parts": {"q": 1}}
        return [TrialOutcome((1.0,), extra) for _ in population]

    quick_study(evaluate, storage=path)
    stored = optuna.load_study(study_name="study", storage=open_storage(path)).trials[5].user_attrs
    assert stored["loss"] == 2.0
    assert stored["per_joint"] == [1.0, 2.0]
    assert stored["parts"] == {"q": 1}
    assert optuna.logging.get_verbosity() == verbosity


def test_a_torn_last_record_is_cut_off(tmp_path):
    """Half a line at the end of the journal, as a power cut leaves it, costs nothing that was stored."""
    path = tmp_path / "study.journal"
    before = points(quick_study(storage=path, n_trials=8))
    with open(path, "ab") as file:
        file.write(b'{"op_code":4,"worker_id":"')
    after = points(quick_study(storage=path, n_trials=12))
    assert after[:8] == before
    assert after == points(quick_study(n_trials=12))


def test_an_interrupt_stores_what_is_finished_and_nothing_else(tmp_path):
    """Ctrl-C in the third population leaves two whole populations."""
    path, calls = tmp_path / "study.journal", []

    def evaluate(population):
        calls.append(len(population))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return bowl(population)

    with pytest.raises(KeyboardInterrupt):
        quick_study(evaluate, storage=path)
    study = optuna.load_study(study_name="study", storage=open_storage(path))
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 8
    assert points(quick_study(storage=path)) == points(quick_study())


WORKER = """
import sys, time
from pathlib import Path
from optuna.distributions import FloatDistribution
from op3.identify.study import StudySettings, TrialOutcome, run_study

storage, worker = sys.argv[1], int(sys.argv[2])

def evaluate(population):
    Path(f"{storage}.{worker}").touch()
    end = time.monotonic() + 60
    while not Path(f"{storage}.{1 - worker}").exists() and time.monotonic() < end:
        time.sleep(0.01)  # both have begun
    return [TrialOutcome((p["x"],)) for p in population]

how = StudySettings({"x": FloatDistribution(0, 1)}, storage=storage, n_trials=120, population=8,
                    nominal={"x": 0.5}, sampler="random", seed=1, worker=worker)
run_study(evaluate, how, progress=False)
"""


def start_worker(storage, worker):
    """Start a process that works on a study with another one."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen([sys.executable, "-c", WORKER, storage, str(worker)], env=environment)


def load(storage):
    """Open the study of the workers."""
    return optuna.load_study(study_name="study", storage=open_storage(storage))


def test_two_workers_share_a_study(tmp_path):
    """Two processes on one journal reach n_trials together: no point twice, both at work."""
    storage = tmp_path / "study.journal"
    workers = [start_worker(storage, number) for number in range(2)]
    assert [worker.wait() for worker in workers] == [0, 0]
    trials = load(storage).trials
    assert 120 <= len(trials) <= 136  # either may have begun two populations that the other did not know of
    assert len({trial.params["x"] for trial in trials}) == len(trials)
    assert sum(trial.user_attrs.get("nominal", False) for trial in trials) == 1
    assert len({trial.user_attrs["worker"] for trial in trials}) == 2


def test_two_workers_of_one_number_are_told(tmp_path):
    """Both would ask the same points: the second says so, and stores none of them."""
    path = tmp_path / "study.journal"

    def meanwhile(population):
        quick_study(storage=path, n_trials=4)
        return bowl(population)

    with pytest.raises(StudyError, match=r"hydra\.sweeper\.worker=1"):
        quick_study(meanwhile, storage=path)
    assert points(load(path)) == points(quick_study(n_trials=4))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"sampler": "simplex"}, "simplex.*unknown.*tpe"),
        ({"sampler": {"name": "tpe", "temperature": 3}}, "temperature"),
        ({"sampler": "cmaes", "directions": ("minimize", "minimize")}, "one objective"),
        ({"directions": ("downwards",)}, "'minimize' or 'maximize'"),
        ({"population": 0}, "at least 1"),
        ({"evaluate": lambda population: [0.0]}, "1 results for a population of 4"),
        ({"evaluate": lambda population: None}, "a NoneType for a population of 4"),
        ({"evaluate": lambda population: [(0.0, 1.0)] * len(population)}, "2 values"),
        ({"evaluate": lambda population: ["good"] * len(population)}, "'good'"),
        ({"evaluate": lambda population: [TrialOutcome((0.0,), {"f": print})] * 4}, "'f'"),
    ],
)
def test_wrong_settings_get_a_sentence(settings, reason):
    """Each mistake is refused with its reason."""
    with pytest.raises(StudyError, match=reason):
        quick_study(**settings)


@pytest.mark.parametrize(
    "change",
    [
        {"space": {**SPACE, "a.x": FloatDistribution(0, 2)}},
        {"space": {"a.x": FloatDistribution(0, 1)}},
        {"directions": ("maximize",)},
    ],
)
def test_another_study_is_not_mixed_into_a_stored_one(change, tmp_path):
    """Other ranges, parameters or directions need another name."""
    path = tmp_path / "study.journal"
    quick_study(storage=path, n_trials=4)
    with pytest.raises(StudyError, match=r"choose another folder \(hydra.run.dir\), storage or study_name"):
        quick_study(storage=path, **change)


def test_unusable_storages_get_a_sentence(tmp_path):
    """A file in the place of the folder, a foreign file, an unknown form, an unknown database."""
    blocker = tmp_path / "file"
    blocker.write_text("in the way")
    with pytest.raises(StudyError, match="cannot be written"):
        open_storage(blocker / "study.journal")
    with pytest.raises(StudyError, match=r"\.journal"):
        open_storage(tmp_path / "study.txt")
    with pytest.raises(StudyError, match="cannot be opened"):
        open_storage(f"sqlite:///{tmp_path}/missing/study.db")
    foreign = tmp_path / "app.log"
    foreign.write_text("started\nstopped\nhalf a li")
    with pytest.raises(StudyError, match="not an Optuna journal"):
        open_storage(foreign)
    assert foreign.read_text().endswith("half a li")


@pytest.mark.parametrize("part", ["logs", "model"])
def test_a_study_of_other_data_is_refused_before_its_trials_answer(part, tmp_path):
    """A finished study answers only for the logs and the model that its trials were evaluated on, if it names them."""
    path, identity = tmp_path / "study.journal", {"logs": "a", "model": "m"}
    first = quick_study(storage=path, identity=identity)
    quick_study(storage=path, identity=None)
    stored = path.read_bytes()
    with pytest.raises(StudyError, match=f"has other {part} than this run"):
        quick_study(storage=path, identity={**identity, part: "other"})
    assert path.read_bytes() == stored
    assert points(quick_study(storage=path, identity=identity)) == points(first)
    quick_study(storage=tmp_path / "unnamed.journal")
    with pytest.raises(StudyError, match="has other logs, model than this run"):
        quick_study(storage=tmp_path / "unnamed.journal", identity=identity)
