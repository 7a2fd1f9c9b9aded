"""`hydra/sweeper=population` for every command: a study over its settings in which each trial is one run."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from op3.apps.command_result import CommandResult


def search(main: Callable[[DictConfig], CommandResult], cfg: DictConfig) -> Any:
    """Run a job of the study, or finish the study.

    Args:
        main: function of the command; the study optimises the `objective` of its result.
        cfg: config of the job.

    Returns:
        The best trial; in a job that evaluates a population, the results of its trials.

    Raises:
        ValueError: if the command returns no objective, or no run succeeded.
    """
    from op3.identify.study import TrialOutcome
    from op3.identify.sweeper import sweep_or_report

    folder = Path(HydraConfig.get().runtime.output_dir)

    def evaluate(population: list[dict[str, Any]]) -> list[TrialOutcome]:
        found = [_trial(main, cfg, values, folder / f"{number}") for number, values in enumerate(population)]
        return [TrialOutcome((value,)) for value in found]

    found = sweep_or_report(cfg, evaluate)
    if OmegaConf.select(cfg, "population") is not None:
        return found
    if found.get("best_value") is None:
        raise ValueError(f"none of the {found['n_trials']} runs returned a result; see the folders in {folder}")
    best = ", ".join(f"{name}={value:.4g}" for name, value in (found["best_params"] or {}).items())
    headline = f"The best of {found['n_trials']} runs gives {found['best_value']:.4g}: {best}."
    results = (folder / "optimization_results.yaml",)
    return CommandResult(folder, headline, found, found["best_value"], results)


def _trial(main: Callable[[DictConfig], CommandResult], cfg: DictConfig, values: dict[str, Any], folder: Path) -> float:
    """The objective of a run with these values; the run has a separate folder."""
    chosen = deepcopy(cfg)
    with open_dict(chosen):
        del chosen["population"]
    for name, value in values.items():
        OmegaConf.update(chosen, name, value)
    hydra = HydraConfig.instance().cfg
    assert hydra is not None
    runtime, before = hydra.hydra.runtime, hydra.hydra.runtime.output_dir
    folder.mkdir(parents=True, exist_ok=True)
    with read_write(runtime):
        runtime.output_dir = str(folder)
        try:
            result = main(chosen)
        finally:
            runtime.output_dir = before
    print(result, flush=True)
    if result.objective is None:
        raise ValueError("hydra/sweeper=population: this command's result has no number to optimise; omit the sweeper")
    return result.objective
