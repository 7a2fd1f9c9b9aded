"""The study engine: ask a population, evaluate it, store it, until the study has its trials.

A trial is written to the storage once, when it is finished. Nothing unfinished is ever stored, so a
killed process leaves nothing to repair: its population is asked again by whoever goes on. The sampler
works on a copy of the study in memory, which also spares it one storage access per parameter. What
the storage holds at any moment is a valid Optuna study for `optuna.visualization` and for other tools.

Independent of Hydra; `op3.identify.sweeper` connects the two.
"""

import copy
import logging
import math
import re
import secrets
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseGASampler
from optuna.storages import BaseStorage
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from op3.identify.progress import TrialProgress
from op3.identify.samplers import SamplerFactory, make_sampler_factory
from op3.identify.search_space import check_nominal, search_space_to_json
from op3.identify.storage import open_storage
from op3.identify.workers import Worker

log = logging.getLogger(__name__)

POLL_SECONDS = 0.2
FUTILE_POPULATIONS = 3
FINISHED = (TrialState.COMPLETE, TrialState.FAIL, TrialState.PRUNED)


class StudyError(RuntimeError):
    """A study that cannot go on; the message says why and how to mend it."""


@dataclass(frozen=True)
class Outcome:
    """What the evaluation of one trial gave.

    Attributes:
        values: the objectives, one per direction; None or a non-finite number means that it failed.
        attributes: anything else worth keeping with the trial, as JSON data; for example the losses
            before weighting.
        error: what went wrong, if the evaluation raised.
    """

    values: tuple[float, ...] | None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None


@dataclass(frozen=True)
class Given:
    """A trial whose parameters are not the sampler's to propose.

    Attributes:
        mark: user attribute by which the stored trial is known again.
        values: its parameters.
    """

    mark: Mapping[str, Any]
    values: Mapping[str, Any]


Evaluate = Callable[[list[dict[str, Any]]], Sequence[float | Sequence[float] | Outcome | None]]
"""Evaluates a population: parameters of each trial -> result of each trial, in the same order."""


def run_study(
    evaluate: Evaluate,
    search_space: Mapping[str, BaseDistribution],
    *,
    sampler: str | Mapping[str, Any] | SamplerFactory = "tpe",
    directions: Sequence[str] = ("minimize",),
    storage: str | Path | BaseStorage | None = None,
    study_name: str = "study",
    n_trials: int = 256,
    population: int = 64,
    nominal: Mapping[str, Any] | None = None,
    starts: Sequence[Mapping[str, Any]] = (),
    seed: int | None = None,
    progress: bool = True,
) -> optuna.Study:
    """Run a study, or go on with a stored one, until it has `n_trials` finished trials.

    The same seed gives the same trials on the same machine, also if the study is interrupted and
    resumed in between, as long as one worker runs it. Several workers may run the same call on the
    same storage at once, on one machine or many: they share the trials between them. A trial whose
    evaluation raises or is not finite is stored as failed, with its parameters, and the study goes on.

    Args:
        evaluate: evaluates a population. If it raises, the population is halved until the trial that
            raises is alone, so only this one fails.
        search_space: the parameters and their ranges, see `op3.identify.search_space`.
        sampler: how parameters are proposed, see `op3.identify.samplers`.
        directions: `minimize` or `maximize` for each objective.
        storage: see `op3.identify.storage`; None keeps the study in memory.
        study_name: name of the study in the storage.
        n_trials: finished trials, complete or failed, that the study shall have in all.
        population: trials asked and evaluated together.
        nominal: parameters of the first trial, the baseline; None starts without one.
        starts: parameters of the trials that follow it, before the sampler proposes any; each is
            evaluated once, also over interruptions and among workers. A resumed study needs the same.
        seed: seed of the study; None keeps the stored seed, or draws one for a new study.
        progress: show trials, best value, rate and time left.

    Returns:
        The stored study.

    Raises:
        StudyError: if the settings contradict each other or the stored study, if results do not match
            the population, or if no trial completes and `FUTILE_POPULATIONS` in a row raise.
        op3.identify.samplers.SamplerError: if the sampler is unknown or does not fit the study.
        op3.identify.storage.StorageError: if the storage cannot be used.
        op3.identify.search_space.SearchSpaceError: if nominal parameters or starts are outside the ranges.
    """
    if population < 1 or n_trials < 1:
        raise StudyError(f"population={population} and n_trials={n_trials} must both be at least 1.")
    baseline = None if nominal is None else check_nominal(search_space, nominal)
    given = [] if baseline is None else [Given({"nominal": True}, baseline)]
    given += [Given({"start": number}, check_nominal(search_space, values)) for number, values in enumerate(starts)]
    factory = make_sampler_factory(sampler, population=population, directions=len(directions), nominal=baseline)
    study = _open_study(storage, study_name, directions, search_space, seed)
    session = _Session(study, search_space, factory, given)
    session.pull()
    if session.finished >= n_trials:
        return study
    with TrialProgress(n_trials, session.finished, enabled=progress) as shown:
        _run(session, evaluate, n_trials, population, shown)
    return study


def _run(session: "_Session", evaluate: Evaluate, n_trials: int, population: int, shown: TrialProgress) -> None:
    worker = Worker(session.study)
    futile = 0
    worker.start()
    try:
        while True:
            session.pull()
            shown.update(session.finished, session.best_value())
            if session.finished >= n_trials:
                return
            others = worker.others()
            free = n_trials - session.finished - sum(record["trials"] for record in others)
            if free <= 0:
                # The last trials are with another worker: take them over if it dies.
                time.sleep(POLL_SECONDS)
                continue
            size = min(free, population)
            given = _takes_given(session, worker, size)
            trials = session.ask(size, given, worker.name, shared=bool(others))
            outcomes = evaluate_population(evaluate, [dict(trial.params) for trial in trials])
            session.tell(trials, outcomes)
            worker.claim(0, [])
            raised = all(outcome.error for outcome in outcomes)
            futile = futile + 1 if raised and not session.any_complete() else 0
            if futile >= FUTILE_POPULATIONS:
                raise StudyError(
                    f"No trial has completed and the last {futile} populations all raised; the last error "
                    f"is: {outcomes[-1].error} Mend it and start a new study (another study_name or storage)."
                )
    finally:
        worker.stop()


def _takes_given(session: "_Session", worker: Worker, size: int) -> list[int]:
    """Claim `size` trials, among them the given ones that are due and no other worker has; return their numbers.

    Claims are written before those of the others are read, so of two that claim in the same moment at
    least one sees the other and gives way. Where both see each other the first by name looks again.
    """
    given = session.due(worker.taken())[:size]
    worker.claim(size, given)
    if not given:
        return []
    rivals = worker.rivals(given)
    if rivals and worker.name < min(rivals):
        time.sleep(POLL_SECONDS)
        rivals = worker.rivals(given)
    # A rival that claims no more may have stored its trials meanwhile.
    session.pull()
    own = [] if rivals else [number for number in session.due(()) if number in given]
    if own != given:
        worker.claim(size, own)
    return own


def evaluate_population(evaluate: Evaluate, population: list[dict[str, Any]]) -> list[Outcome]:
    """Evaluate a population such that one trial that raises does not take the others with it.

    A population that raises is halved until the guilty trial is alone: about 2 log2(size) extra
    evaluations for each trial that raises.
    """
    try:
        results = evaluate([dict(parameters) for parameters in population])
    except (StudyError, ChildProcessError):
        raise  # of no trial's making
    except Exception as error:
        results, message = None, _describe_error(error)
        log.debug("A population of %d raised.", len(population), exc_info=True)
    else:
        message = ""
    if results is None and len(population) == 1:
        log.warning("The trial %s raised %s", population[0], message)
        return [Outcome(None, error=message)]
    if results is None:
        middle = len(population) // 2
        halves = (population[:middle], population[middle:])
        return [outcome for half in halves for outcome in evaluate_population(evaluate, half)]
    if len(results) != len(population):
        raise StudyError(
            f"evaluate returned {len(results)} results for a population of {len(population)}: "
            "return one result per trial, in order, None where it failed."
        )
    return [as_outcome(result) for result in results]


def _describe_error(error: Exception) -> str:
    """Name an error and the line that raised it, in one line that fits a trial's record."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno} in {frame.name})"


def as_outcome(result: Any) -> Outcome:
    """Read one result of an evaluation: a number, several numbers, None, or an `Outcome`."""
    if result is None or isinstance(result, Outcome):
        return result or Outcome(None)
    try:
        if isinstance(result, Sequence) or np.ndim(result) == 1:
            return Outcome(tuple(float(value) for value in result))
        return Outcome((float(result),))
    except (TypeError, ValueError) as error:
        raise StudyError(
            f"evaluate returned {result!r} for a trial: return a number, a tuple of numbers, None or an Outcome."
        ) from error


class _Session:
    """One process's view of a study: the stored one, and the copy in memory that the sampler sees."""

    def __init__(
        self,
        study: optuna.Study,
        search_space: Mapping[str, BaseDistribution],
        factory: SamplerFactory,
        given: Sequence[Given],
    ) -> None:
        self.study = study
        self._search_space = dict(search_space)
        self._factory = factory
        self._given = list(given)
        self._open = set(range(len(self._given)))
        self._seed: int = study.user_attrs["seed"]
        self._own_name: str | None = None
        self._pulled: set[int] = set()
        with _quiet_optuna():
            self._mirror = optuna.create_study(directions=study.directions, sampler=factory(0))

    @property
    def finished(self) -> int:
        """Finished trials in the study, as far as this process knows."""
        return len(self._trials())

    def pull(self) -> None:
        """Take over the trials that other workers, or earlier runs, have finished."""
        for trial in self.study.get_trials(deepcopy=False, states=FINISHED):
            if trial.number in self._pulled:
                continue
            self._pulled.add(trial.number)
            if self._own_name is None or trial.user_attrs.get("worker") != self._own_name:
                self._mirror.add_trial(trial)

    def any_complete(self) -> bool:
        """Say whether any trial has a value."""
        return any(trial.state == TrialState.COMPLETE for trial in self._trials())

    def best_value(self) -> float | None:
        """Best value so far; None without one, or with several objectives."""
        if len(self.study.directions) > 1 or not self.any_complete():
            return None
        return self._mirror.best_value

    def due(self, claimed: Collection[int]) -> list[int]:
        """Numbers of the given trials that are neither finished nor claimed by another worker."""
        if self._open:
            found = [t.user_attrs for t in self._trials()]
            done = {key: {attributes.get(key) for attributes in found} for key in ("nominal", "start")}
            self._open = {
                number
                for number in self._open
                if not any(value in done[key] for key, value in self._given[number].mark.items())
            }
        return sorted(self._open - set(claimed))

    def ask(self, size: int, given: Sequence[int], worker: str, shared: bool) -> list[Trial]:
        """Ask for a population; given trials, by number, come first."""
        self._own_name = worker
        # Two workers that have seen the same trials must not propose the same points.
        entropy = [self._seed, self.finished, *(worker.encode() if shared else b"")]
        self._mirror.sampler = self._factory(int(np.random.SeedSequence(entropy).generate_state(1)[0] >> 1))
        for number in given:
            one = self._given[number]
            self._mirror.enqueue_trial(dict(one.values), user_attrs=dict(one.mark))
        trials = [self._mirror.ask(self._search_space) for _ in range(size)]
        for trial in trials:
            trial.set_user_attr("worker", worker)
        sampler = self._mirror.sampler
        if isinstance(sampler, BaseGASampler):
            # Optuna leaves trials with given parameters out of every generation, so that they would have no children.
            frozen = self._mirror.get_trials(deepcopy=False)
            for trial in trials[: len(given)]:
                sampler.get_trial_generation(self._mirror, frozen[trial.number])
        return trials

    def tell(self, trials: Sequence[Trial], outcomes: Sequence[Outcome]) -> None:
        """Finish a population, in memory and in the storage."""
        for trial, outcome in zip(trials, outcomes, strict=True):
            values = self._judge(trial, outcome)
            state = TrialState.FAIL if values is None else TrialState.COMPLETE
            self._mirror.tell(trial, values, state)
        frozen = self._mirror.get_trials(deepcopy=False)
        told = [frozen[trial.number] for trial in trials]
        state_holder = next((t for t in reversed(told) if t.state == TrialState.COMPLETE), None)
        for trial in told:
            self.study.add_trial(_to_store(trial, keep_state=trial is state_holder))

    def _judge(self, trial: Trial, outcome: Outcome) -> list[float] | None:
        """Record what is to be known about a trial; return its values if it has succeeded."""
        for key, value in outcome.attributes.items():
            trial.set_user_attr(key, _plain(key, value))
        if outcome.error is not None:
            trial.set_user_attr("error", outcome.error)
        if outcome.values is None:
            return None
        values = [float(value) for value in outcome.values]
        if len(values) != len(self.study.directions):
            raise StudyError(
                f"evaluate returned {len(values)} values for a trial, the study has "
                f"{len(self.study.directions)} directions: make the two agree."
            )
        if all(math.isfinite(value) for value in values):
            return values
        trial.set_user_attr("failed_values", [str(value) for value in values])
        return None

    def _trials(self) -> list[FrozenTrial]:
        return self._mirror.get_trials(deepcopy=False, states=FINISHED)


def _open_study(
    storage: str | Path | BaseStorage | None,
    name: str,
    directions: Sequence[str],
    search_space: Mapping[str, BaseDistribution],
    seed: int | None,
) -> optuna.Study:
    try:
        wanted = [StudyDirection[direction.upper()] for direction in directions]
    except KeyError as error:
        raise StudyError(f"The directions {list(directions)} are unclear: each is minimize or maximize.") from error
    opened = open_storage(storage)
    with _quiet_optuna():
        study = optuna.create_study(storage=opened, study_name=name, directions=wanted, load_if_exists=True)
    if study.directions != wanted:
        stored = [direction.name.lower() for direction in study.directions]
        raise StudyError(
            f"The stored study {name!r} has the directions {stored}, not {list(directions)}: "
            "give the new one another study_name or storage."
        )
    space, attributes = search_space_to_json(search_space), study.user_attrs
    if attributes.get("search_space", space) != space:
        raise StudyError(
            f"The stored study {name!r} searches other parameters or ranges than the ones given: "
            "give the new one another study_name or storage, or restore the ranges."
        )
    if "search_space" not in attributes:
        study.set_user_attr("search_space", space)
    if seed is None:
        seed = attributes.get("seed", secrets.randbits(31))
    if attributes.get("seed") != seed:
        study.set_user_attr("seed", seed)
    return study


_OPTIMIZER_STATE = re.compile(r"(sepcma|cmawm|cma):optimizer")
_SCRATCH = re.compile(r"(tpe|gp):relative_params")


def _to_store(trial: FrozenTrial, keep_state: bool) -> FrozenTrial:
    """Drop what samplers only need while a trial runs.

    CMA-ES writes its whole state to every trial of a population, 10 kB each, and reads it back from
    the last complete one alone.
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
    if isinstance(value, Mapping):
        return {str(name): _plain(key, item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(key, item) for item in value]
    if hasattr(value, "tolist"):
        value = value.tolist()
    if value is None or isinstance(value, str | bool | int | float | list):
        return value
    raise StudyError(f"The attribute {key!r} holds a {type(value).__name__}: give numbers, texts, lists or dicts.")


class _quiet_optuna:
    """Keep Optuna from announcing each study it opens, without changing what the user has set."""

    def __enter__(self) -> None:
        self._level = optuna.logging.get_verbosity()
        optuna.logging.set_verbosity(max(self._level, optuna.logging.WARNING))

    def __exit__(self, *_: object) -> None:
        optuna.logging.set_verbosity(self._level)
