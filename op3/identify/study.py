"""The study engine: request, evaluate and store populations until the study has its trials.

Only finished trials are stored, so a killed process leaves nothing to repair: the process that continues requests the
population again. The sampler works on a copy of the study in memory, which also avoids one storage access per
parameter. The storage is always a valid Optuna study for `optuna.visualization` and other tools.

Independent of Hydra; `op3.identify.sweeper` connects the two.
"""

import copy
import json
import logging
import math
import re
import secrets
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseGASampler
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from tqdm import tqdm

from op3.common.settings import Count, Some, Whole, settings
from op3.identify.samplers import SamplerFactory, make_sampler_factory
from op3.identify.search_space import SearchSpace, StudyError, check_nominal, search_space_to_json
from op3.identify.storage import open_storage

log = logging.getLogger(__name__)

FUTILE_POPULATIONS = 3
FINISHED = (TrialState.COMPLETE, TrialState.FAIL, TrialState.PRUNED)

LINE_SECONDS = 15.0
"""Minimum time between two progress lines if standard error is not a terminal [s]."""

_OPTIMIZER_STATE = re.compile(r"(sepcma|cmawm|cma):optimizer")
_SCRATCH = re.compile(r"tpe:relative_params")


@dataclass(frozen=True)
class TrialOutcome:
    """Result of the evaluation of one trial.

    Attributes:
        values: the objectives, one per direction; None or a non-finite number means that the trial failed.
        attributes: further JSON data stored with the trial.
        error: message of an exception in the evaluation.
    """

    values: tuple[float, ...] | None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None


Evaluate = Callable[[list[dict[str, Any]]], Sequence[float | Sequence[float] | TrialOutcome | None]]
"""Evaluates a population: parameters of each trial -> result of each trial, in the same order."""


def _refused(field: str, wanted: str, given: Any) -> StudyError:
    return StudyError(f"hydra.sweeper: {field} must be {wanted}, got {given!r}.")


@settings("hydra.sweeper", _refused)
class StudySettings:
    """Definition and settings of a study.

    Attributes:
        search_space: the parameters and their ranges, see `op3.identify.search_space`.
        sampler: name of the sampler, see `op3.identify.samplers`.
        storage: see `op3.identify.storage`; None keeps the study in memory.
        n_trials: number of finished trials in the study, complete or failed; each other worker may add two populations.
        population: number of trials that one job evaluates together.
        parallel_populations: number of parallel jobs and of populations requested at once.
        nominal: parameters of the first trial, the baseline; None: no baseline.
        starts: number of trials after the baseline that the experiment proposes.
        seed: seed of the study; None keeps the stored seed, or draws one for a new study.
        worker: number of this process among those that share the study; worker 0 evaluates baseline and starts.
    """

    search_space: SearchSpace
    sampler: Any = "tpe"
    directions: Some[Literal["minimize", "maximize"]] = ("minimize",)
    storage: str | Path | None = None
    study_name: str = "study"
    n_trials: Count = 256
    population: Count = 64
    parallel_populations: Count = 1
    nominal: dict[str, Any] | None = None
    starts: Whole = 0
    seed: Whole | None = None
    worker: Whole = 0

    @property
    def asked(self) -> int:
        """Number of trials requested at once."""
        return self.population * self.parallel_populations

    def split(self, population: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
        """Divide requested trials into the populations of single jobs."""
        return [population[i : i + self.population] for i in range(0, len(population), self.population)]

    def samplers(self) -> SamplerFactory:
        """The sampler of each population; raises a StudyError if it cannot be used."""
        return make_sampler_factory(
            self.sampler, population=self.asked, directions=len(self.directions), nominal=self.nominal
        )


def run_study(
    evaluate: Evaluate,
    how: StudySettings,
    starts: Sequence[Mapping[str, Any]] = (),
    identity: Mapping[str, str] | None = None,
    *,
    progress: bool = True,
) -> optuna.Study:
    """Run a study, or continue a stored one, until it has the requested number of finished trials.

    The same seed gives the same trials on the same machine, even if the study is interrupted and resumed. Several
    processes may make the same call on the same storage, each with another worker number, to share the trials. A trial
    whose evaluation raises an exception or is not finite is stored as failed, and the study continues.

    Args:
        evaluate: evaluates a population; if it raises, the population is halved until the failing trial is isolated.
        starts: parameters of the trials between the baseline and the sampler's first proposal; a resumed study needs
            the same.
        identity: everything else that the values depend on, such as logs and model, as text or digest; a stored study
            with another identity raises an error. None disables the check.
        progress: show trials, best value, rate and time left.

    Raises:
        StudyError: if sampler, storage or settings cannot be used or contradict the stored study, if results do not
            match the population, if another process evaluates the same points, or if no trial completes and
            `FUTILE_POPULATIONS` in a row raise exceptions.
    """
    given = [] if how.nominal is None else [({"nominal": True}, check_nominal(how.search_space, how.nominal))]
    given += [({"start": number}, check_nominal(how.search_space, values)) for number, values in enumerate(starts)]
    session = _Session(how, _open_study(how, identity))
    if how.worker == 0:
        session.enqueue(given)
    futile, terminal = 0, sys.stderr.isatty()
    with tqdm(
        total=how.n_trials, initial=min(session.finished, how.n_trials), unit="trial", disable=not progress,
        dynamic_ncols=True, mininterval=0.1 if terminal else LINE_SECONDS,
    ) as shown:  # fmt: skip
        while session.finished < how.n_trials:
            trials = session.ask(min(how.n_trials - session.finished, how.asked))
            outcomes = evaluate_population(evaluate, [dict(trial.params) for trial in trials])
            session.tell(trials, outcomes)
            shown.set_postfix(session.best(), refresh=False)
            shown.update(session.finished - shown.n)
            raised = all(outcome.error for outcome in outcomes)
            futile = futile + 1 if raised and not session.complete() else 0
            if futile >= FUTILE_POPULATIONS:
                raise StudyError(
                    f"No trial has completed and the last {futile} populations raised errors; the last error "
                    f"is: {outcomes[-1].error} Fix the cause and start a new study (another study_name or storage)."
                )
    return session.study


def evaluate_population(evaluate: Evaluate, population: list[dict[str, Any]]) -> list[TrialOutcome]:
    """Evaluate a population so that only the trial that raises fails, with about 2 log2(size) further evaluations."""
    try:
        results = evaluate([dict(parameters) for parameters in population])
    except (StudyError, ChildProcessError):
        raise  # not caused by a trial
    except Exception as error:
        if len(population) > 1:
            middle = len(population) // 2
            halves = (population[:middle], population[middle:])
            return [outcome for half in halves for outcome in evaluate_population(evaluate, half)]
        frame = traceback.extract_tb(error.__traceback__)[-1]
        message = f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno} in {frame.name})"
        log.warning("The trial %s raised %s", population[0], message)
        return [TrialOutcome(None, error=message)]
    return checked_outcomes(results, len(population))


def checked_outcomes(results: Any, count: int) -> list[TrialOutcome]:
    """The outcomes of `count` trials; a result is one number or several, None after a failure, or a `TrialOutcome`.

    Raises:
        StudyError: if there are more or fewer results than trials, or if a result has another type.
    """
    if not isinstance(results, Sequence | np.ndarray) or len(results) != count:
        given = (
            f"{len(results)} results" if isinstance(results, Sequence | np.ndarray) else f"a {type(results).__name__}"
        )
        raise StudyError(
            f"The evaluation returned {given} for a population of {count}: return a list with one result per trial,"
            " in order, or None for a failed trial."
        )
    return [_as_outcome(result) for result in results]


def _as_outcome(result: Any) -> TrialOutcome:
    if result is None or isinstance(result, TrialOutcome):
        return result or TrialOutcome(None)
    try:
        return TrialOutcome(tuple(float(value) for value in np.atleast_1d(result)))
    except (TypeError, ValueError) as error:
        raise StudyError(
            f"The evaluation returned {result!r} for a trial: return a number, a tuple of numbers, None or a"
            " TrialOutcome."
        ) from error


class _Session:
    """A process's view of a study: the stored study, and the copy in memory for the sampler."""

    def __init__(self, how: StudySettings, study: optuna.Study) -> None:
        self.study = study
        self._factory, self._worker = how.samplers(), how.worker
        self._search_space: dict[str, BaseDistribution] = {**how.search_space}
        self._name = f"{how.worker}:{secrets.token_hex(4)}"
        self._pulled: set[int] = set()
        with _quiet_optuna():
            self._mirror = optuna.create_study(directions=study.directions, sampler=self._factory(0))
        self._pull()

    @property
    def finished(self) -> int:
        """Number of finished trials in the study that this process knows."""
        return len(self._mirror.get_trials(deepcopy=False, states=FINISHED))

    def complete(self) -> list[FrozenTrial]:
        """Number of trials that have a value."""
        return self._mirror.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))

    def best(self) -> dict[str, str]:
        """Best value so far; empty without a value or with several objectives."""
        single = len(self.study.directions) == 1 and self.complete()
        return {"best": f"{self._mirror.best_value:.6g}"} if single else {}

    def enqueue(self, given: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> None:
        """Request these trials first, given as mark and parameters, except those already in the study."""
        known = [trial.user_attrs for trial in self._mirror.get_trials(deepcopy=False, states=FINISHED)]
        for mark, values in given:
            if not any(attributes.get(key) == number for attributes in known for key, number in mark.items()):
                self._mirror.enqueue_trial(values, user_attrs=mark)

    def ask(self, size: int) -> list[Trial]:
        """Request a population."""
        # workers that know the same trials must not propose the same points
        entropy = [self.study.user_attrs["seed"], self.finished, *([self._worker] if self._worker else ())]
        self._mirror.sampler = self._factory(int(np.random.SeedSequence(entropy).generate_state(1)[0] >> 1))
        trials = [self._mirror.ask(self._search_space) for _ in range(size)]
        frozen = self._mirror.get_trials(deepcopy=False)
        for trial in trials:
            trial.set_user_attr("worker", self._name)
            sampler = self._mirror.sampler
            if isinstance(sampler, BaseGASampler) and not {"nominal", "start"}.isdisjoint(trial.user_attrs):
                # Optuna excludes enqueued trials from generations, so they would have no children
                sampler.get_trial_generation(self._mirror, frozen[trial.number])
        return trials

    def tell(self, trials: Sequence[Trial], outcomes: Sequence[TrialOutcome]) -> None:
        """Finish a population in memory and in the storage, and read trials that other workers finished meanwhile."""
        for trial, outcome in zip(trials, outcomes, strict=True):
            values = self._judge(trial, outcome)
            self._mirror.tell(trial, values, TrialState.FAIL if values is None else TrialState.COMPLETE)
        frozen = self._mirror.get_trials(deepcopy=False)
        told = [frozen[trial.number] for trial in trials]
        if any(other.params == one.params for other in self._pull() for one in told):
            raise StudyError(
                f"Another process requests the same points as worker {self._worker}: give each process that shares the"
                " study a different number, hydra.sweeper.worker=1 and so on."
            )
        state_holder = next((t for t in reversed(told) if t.state == TrialState.COMPLETE), None)
        for trial in told:
            self.study.add_trial(_to_store(trial, keep_state=trial is state_holder))

    def _pull(self) -> list[FrozenTrial]:
        """Read and return the trials that other workers or earlier runs have finished."""
        stored = self.study.get_trials(deepcopy=False, states=FINISHED)
        new = [t for t in stored if t.number not in self._pulled and t.user_attrs.get("worker") != self._name]
        self._pulled.update(trial.number for trial in stored)
        for trial in new:
            self._mirror.add_trial(trial)
        return new

    def _judge(self, trial: Trial, outcome: TrialOutcome) -> Sequence[float] | None:
        """Record the attributes of a trial; return its values if it has succeeded."""
        for key, value in outcome.attributes.items():
            trial.set_user_attr(key, _plain(key, value))
        if outcome.error is not None:
            trial.set_user_attr("error", outcome.error)
        if outcome.values is not None and len(outcome.values) != len(self.study.directions):
            raise StudyError(
                f"The evaluation returned {len(outcome.values)} values for a trial, but the study has "
                f"{len(self.study.directions)} directions: return one value per direction of hydra.sweeper.direction."
            )
        if outcome.values is None or all(math.isfinite(value) for value in outcome.values):
            return outcome.values
        trial.set_user_attr("failed_values", [str(value) for value in outcome.values])
        return None


def _open_study(how: StudySettings, identity: Mapping[str, str] | None) -> optuna.Study:
    name, directions = how.study_name, [StudyDirection[direction.upper()] for direction in how.directions]
    storage = open_storage(how.storage)
    with _quiet_optuna():
        try:  # to create a study writes to the storage even if the study exists, and this run may be refused
            study = optuna.load_study(storage=storage, study_name=name)
        except KeyError:
            study = optuna.create_study(storage=storage, study_name=name, directions=directions, load_if_exists=True)
    space, attributes = search_space_to_json(how.search_space), study.user_attrs
    if study.directions != directions or attributes.get("search_space", space) != space:
        raise StudyError(
            f"The stored study {name!r} has other objectives, parameters or ranges than this run: choose another folder"
            " (hydra.run.dir), storage or study_name, or repeat the original command."
        )
    known = attributes.get("identity", {})
    differs = [part for part in {**(identity or {}), **known} if identity and known.get(part) != identity.get(part)]
    if how.seed is not None and attributes.get("seed", how.seed) != how.seed:
        differs.append("seed")
    if differs and study.get_trials(deepcopy=False):
        raise StudyError(
            f"The stored study {name!r} has other {', '.join(differs)} than this run: choose another folder"
            " (hydra.run.dir), storage or study_name, or repeat the original command."
        )
    seed = attributes.get("seed", secrets.randbits(31)) if how.seed is None else how.seed
    for key, value in {"identity": identity and dict(identity), "search_space": space, "seed": seed}.items():
        if value is not None and attributes.get(key) != value:
            study.set_user_attr(key, value)
    return study


def _to_store(trial: FrozenTrial, keep_state: bool) -> FrozenTrial:
    """Delete attributes that samplers only need while a trial runs.

    CMA-ES writes its whole state, 10 kB, to every trial of a population, but only reads the last complete one.
    """
    stored = copy.copy(trial)
    stored.system_attrs = {
        key: value
        for key, value in trial.system_attrs.items()
        if not _SCRATCH.match(key) and (keep_state or not _OPTIMIZER_STATE.match(key))
    }
    return stored


def _plain(key: str, value: Any) -> Any:
    """Turn numpy and torch data into JSON data."""

    def unpack(what: Any) -> Any:
        if not hasattr(what, "tolist"):
            raise StudyError(
                f"The attribute {key!r} of a TrialOutcome has type {type(what).__name__}: use numbers, texts, lists or"
                " dicts."
            )
        return what.tolist()

    return json.loads(json.dumps(value, default=unpack))


@contextmanager
def _quiet_optuna() -> Iterator[None]:
    """Suppress Optuna's message about each study that it opens, without changing the user's log level."""
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(max(level, optuna.logging.WARNING))
    try:
        yield
    finally:
        optuna.logging.set_verbosity(level)
