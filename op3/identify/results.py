"""The results of a study as a YAML file in the format of hydra-optuna-sweeper."""

from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.trial import TrialState

from op3.common.writing import write_text

RESULTS_FILE = "optimization_results.yaml"


def summarize(study: optuna.Study) -> dict[str, Any]:
    """Summarise a study as plain data.

    Returns:
        `name`, `study_name`, `n_trials`, `n_failed`; with one objective `best_value`, `best_params`, `best_trial`, and
        `nominal_value`; with several objectives `solutions`, the Pareto front in the order of the trials, each with
        `trial`, `params` and `values`. Values are None if no trial completed.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    failed = study.get_trials(deepcopy=False, states=(TrialState.FAIL,))
    summary: dict[str, Any] = {
        "name": "optuna",
        "study_name": study.study_name,
        "n_trials": len(complete) + len(failed),
        "n_failed": len(failed),
    }
    if len(study.directions) > 1:
        front = sorted(study.best_trials, key=lambda trial: trial.number) if complete else []
        summary["solutions"] = [
            {"trial": trial.number, "params": dict(trial.params), "values": list(trial.values)} for trial in front
        ]
        return summary
    best = study.best_trial if complete else None
    nominal = next((trial for trial in complete if trial.user_attrs.get("nominal")), None)
    summary["best_value"] = None if best is None else best.value
    summary["best_params"] = None if best is None else dict(best.params)
    summary["best_trial"] = None if best is None else best.number
    summary["nominal_value"] = None if nominal is None else nominal.value
    return summary


def write_results(folder: Path, results: dict[str, Any]) -> None:
    """Write the results of studies into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / RESULTS_FILE, yaml.safe_dump(results, sort_keys=False, allow_unicode=True))
