"""The Hydra sweeper `hydra/sweeper: population`: a study evaluated in populations, one Hydra job each.

A command passes its work to `sweep_or_report`. Without `-m`, the study runs in this process, in Hydra's run folder.
With `-m`, the sweeper writes each population to a file and launches one job with `population=<file>`, in which
`sweep_or_report` evaluates the file and returns the results. Both ways request the same trials.

Comma sweeps on the command line (`seed=0,1,2 groups=motor,gear`) are an outer grid with one study and one folder per
cell. The search space comes only from `hydra.sweeper.params`, read in every cell, so a config group may add parameters.

Folders:

    <sweep folder>/optimization_results.yaml   best of every cell
    <sweep folder>/0/                          first cell, as a run folder without -m:
        study.journal, optimization_results.yaml, and what the report writes
        populations/0/, 1/, ...                one folder per population job, with its population.json
"""

import functools
import itertools
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import CompactHydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from op3.common.writing import write_text
from op3.identify.results import summarize, write_results
from op3.identify.search_space import StudyError
from op3.identify.storage import open_storage
from op3.identify.study import Evaluate, StudySettings, TrialOutcome, checked_outcomes, evaluate_population, run_study
from op3.identify.study_settings import read_settings

log = logging.getLogger(__name__)

POPULATION_FILE = "population.json"
STARTS_FILE = "starts.json"

Propose = Callable[[int], Sequence[Mapping[str, Any]]]
"""Proposes a given number of parameter sets by config key."""


def sweep_or_report(
    cfg: DictConfig,
    evaluate: Evaluate,
    report: Callable[[optuna.Study], Any] | None = None,
    propose: Propose | None = None,
    identity: Mapping[str, str] | None = None,
) -> Any:
    """Run an experiment's part of a study: evaluate a population, or run the study and report it.

    Args:
        cfg: the config that `@hydra.main` passes.
        evaluate: evaluates a population, see `op3.identify.study.Evaluate`.
        propose: proposes the first `hydra.sweeper.starts` trials, which are kept in `starts.json` so that a resumed
            study begins with the same trials.
        identity: everything else that the objectives depend on, see `op3.identify.study.run_study`.

    Returns:
        In a population job, the list of results, or the requested starts and identity; otherwise the value that
        `report` returns, or the study's summary.
    """
    path = OmegaConf.select(cfg, "population")
    if path is not None:
        if not Path(str(path)).is_file():
            with _one_sentence():
                raise StudyError(f"population={path}: only the sweeper sets this; omit population.")
        asked = json.loads(Path(path).read_text())
        if isinstance(asked, dict):
            return {"starts": _propose(propose, asked["starts"]), "identity": identity}
        return evaluate_population(evaluate, asked)
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    with _one_sentence():
        settings = read_settings(cfg, hydra_config.sweeper, folder)

        def evaluate_chunks(population: list[dict[str, Any]]) -> list[TrialOutcome]:
            chunks = settings.split(population)
            return [outcome for chunk in chunks for outcome in evaluate_population(evaluate, chunk)]

        starts = _kept_starts(folder, settings, lambda: _propose(propose, settings.starts))
        study = run_study(evaluate_chunks, settings, starts, identity)
    summary = summarize(study)
    write_results(folder, summary)
    return summary if report is None else report(study)


def _propose(propose: Propose | None, count: int) -> list[dict[str, Any]]:
    if count and propose is None:
        raise StudyError("hydra.sweeper.starts: this experiment proposes no starts; set it to 0.")
    return [dict(values) for values in propose(count)] if propose and count else []


def _kept_starts(
    folder: Path, settings: StudySettings, make: Callable[[], Sequence[Mapping[str, Any]]]
) -> Sequence[Mapping[str, Any]]:
    """The starts in a study's folder, created if they do not exist."""
    if settings.starts == 0:
        return ()
    path = folder / STARTS_FILE
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(list(make()), indent=1))
    return json.loads(path.read_text())


class PopulationSweep:
    """Runs one study for each cell of the command line's grid, with settings from the cell's config."""

    def __init__(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig):
        self._config: DictConfig = config
        self._loader: ConfigLoader = hydra_context.config_loader
        self._launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def run(self, arguments: list[str]) -> list[Sequence[JobReturn]]:
        """Run all cells; return the job that reported each cell."""
        sweep_dir = Path(str(self._config.hydra.sweep.dir)).absolute()
        sweep_dir.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self._config, sweep_dir / "multirun.yaml")
        parser = OverridesParser.create(config_loader=self._loader)
        grid = expand_grid(parser.parse_overrides(arguments))
        # All cells are read before the first one runs, so that errors appear at once.
        cells = [self._cell(sweep_dir / str(i), overrides, grid) for i, overrides in enumerate(grid)]
        summaries: list[dict[str, Any]] = []
        returns: list[Sequence[JobReturn]] = []
        for number, (overrides, (folder, settings)) in enumerate(zip(grid, cells, strict=True)):
            log.info("Study %d of %d: %s", number + 1, len(grid), " ".join(overrides) or "(no overrides)")
            begun = self._begin(overrides, folder, settings)
            starts = _kept_starts(folder, settings, lambda b=begun: b["starts"])
            launch = functools.partial(self._launch, overrides=overrides, folder=folder, settings=settings)
            study = run_study(launch, settings, starts, begun["identity"])
            summaries.append({"folder": folder.name, "overrides": list(overrides), **summarize(study)})
            write_results(sweep_dir, _sweep_summary(summaries, len(grid)))
            returns.append(self._report(overrides, folder, settings, number))
        for jobs in returns:
            for job in jobs:
                _ = job.return_value  # raises the exception of the report
        return returns

    def _cell(self, folder: Path, overrides: list[str], grid: list[list[str]]) -> tuple[Path, StudySettings]:
        config = self._loader.load_sweep_config(self._config, overrides)
        common = set.intersection(*(set(cell) for cell in grid))
        name = ",".join(override for override in overrides if override not in common)
        settings = read_settings(config, config.hydra.sweeper, folder, name)
        settings.samplers()
        open_storage(settings.storage)
        return folder, settings

    def _launch(
        self,
        population: list[dict[str, Any]],
        overrides: list[str],
        folder: Path,
        settings: StudySettings,
    ) -> list[TrialOutcome]:
        """Evaluate the requested populations, one job each, all launched together."""
        chunks = settings.split(population)
        first, jobs = _write_jobs(chunks, overrides, folder)
        try:
            returns = self._launcher.launch(jobs, initial_job_idx=first)
        except Exception as error:
            # A job may die with its machine; then its trials fail and the study continues.
            log.exception("The launcher failed.")
            return [TrialOutcome(None, error=f"launcher: {type(error).__name__}: {error}") for _ in population]
        return [o for chunk, job in zip(chunks, returns, strict=True) for o in _job_outcomes(chunk, job)]

    def _begin(self, overrides: list[str], folder: Path, settings: StudySettings) -> dict[str, Any]:
        """Request the study's identity, and missing starts, from the experiment in a separate job."""
        wanted = 0 if (folder / STARTS_FILE).exists() else settings.starts
        first, jobs = _write_jobs([{"starts": wanted}], overrides, folder)
        job = self._launcher.launch(jobs, initial_job_idx=first)[0]
        if job.status != JobStatus.COMPLETED:
            if isinstance(error := job._return_value, StudyError):
                raise error
            raise StudyError(f"The study cannot begin because its first job raised {type(error).__name__}: {error}")
        return job.return_value

    def _report(self, overrides: list[str], folder: Path, settings: StudySettings, number: int) -> Sequence[JobReturn]:
        """Run the experiment once more in the cell's folder, where its study is finished."""
        place = _place_overrides(folder.parent, folder.name)
        finished = [
            f"hydra.sweeper.storage={_quoted(str(settings.storage))}",
            f"hydra.sweeper.study_name={_quoted(settings.study_name)}",
        ]
        job = [*overrides, *place, *finished, "++population=null"]
        return self._launcher.launch([job], initial_job_idx=number)


def expand_grid(overrides: Sequence[Override]) -> list[list[str]]:
    """Expand comma sweeps, choices and integer ranges to the overrides of every cell."""
    axes: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        if not override.is_sweep_override():
            axes[key] = [override.input_line or f"{key}={override.get_value_element_as_str()}"]
        elif override.is_discrete_sweep():
            axes[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            raise StudyError(
                f"{override.input_line}: the search space comes only from the config: "
                f'write `{key}: "{(override.input_line or "").partition("=")[2]}"` in hydra.sweeper.params.'
            )
    return [list(cell) for cell in itertools.product(*axes.values())]


def _reserve_folders(parent: Path, count: int) -> int:
    """Create `count` new folders with consecutive numbers that no other process uses; return the first number."""
    parent.mkdir(parents=True, exist_ok=True)
    while True:
        taken = [int(entry.name) for entry in parent.iterdir() if entry.name.isdigit()]
        first = max(taken, default=-1) + 1
        made: list[Path] = []
        try:
            for number in range(first, first + count):
                (parent / str(number)).mkdir()
                made.append(parent / str(number))
            return first
        except FileExistsError:
            for folder in made:
                folder.rmdir()


def _write_jobs(contents: Sequence[Any], overrides: list[str], folder: Path) -> tuple[int, list[list[str]]]:
    """Write the populations of jobs; return the number of the first job and the overrides of each job."""
    first = _reserve_folders(folder / "populations", len(contents))
    jobs = []
    for number, content in enumerate(contents, start=first):
        path = folder / "populations" / str(number) / POPULATION_FILE
        write_text(path, json.dumps(content, indent=1))
        place = _place_overrides(folder / "populations", "${hydra.job.num}")
        jobs.append([*overrides, *place, f"++population={_quoted(path)}"])
    return first, jobs


def _place_overrides(sweep_dir: Path, subdir: str) -> list[str]:
    return [f"hydra.sweep.dir={_quoted(sweep_dir)}", f"hydra.sweep.subdir={subdir}"]


def _quoted(text: str | Path) -> str:
    """Quote a text for Hydra's grammar; `$` would start an interpolation."""
    return QuotedString(str(text).replace("${", "\\${"), Quote.single).with_quotes()


def _job_outcomes(chunk: list[dict[str, Any]], job: JobReturn) -> list[TrialOutcome]:
    if job.status != JobStatus.COMPLETED:
        error = job._return_value
        if isinstance(error, StudyError):
            raise error
        return [TrialOutcome(None, error=f"job: {type(error).__name__}: {error}") for _ in chunk]
    return checked_outcomes(job.return_value, len(chunk))


def _sweep_summary(summaries: list[dict[str, Any]], cells: int) -> dict[str, Any]:
    if cells > 1:
        return {"name": "optuna", "studies": summaries}
    return {key: value for key, value in summaries[0].items() if key not in ("folder", "overrides")}


@contextmanager
def _one_sentence() -> Iterator[None]:
    """Let Hydra print a wrong setting as one sentence, without a stack trace."""
    try:
        yield
    except StudyError as error:
        raise CompactHydraException(str(error)) from error
