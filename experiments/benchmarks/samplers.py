"""Which sampler finds the lowest loss in so many trials: TPE against CMA-ES, over seeds, on one log.

python experiments/benchmarks/samplers.py data=<log> [trials=2000] [seeds=[0,1,2]] [samplers=[tpe,cmaes,random]]

Every study is resumable: the same command in the same folder goes on.
"""

import time
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps.fields import check_given, plain
from op3.apps.job import one_sentence
from op3.apps.support import focus_joints
from op3.identify.identification import PREFIX, Identification
from op3.identify.search_space import parse_search_space
from op3.identify.study import run_study
from op3.report import Page, run_provenance, write_result
from op3.report.figures import history_figure
from op3.rollout import read_logs
from op3.sim import load_model


def one_study(cfg: DictConfig, sampler: str, seed: int, folder: Path) -> dict[str, Any]:
    """Run one study and return its losses."""
    started = time.monotonic()
    model = load_model(cfg.model)
    known = {name: model.parameters()[name] for name in cfg.parameters}
    logs = read_logs(plain(cfg.data))
    problem = Identification(model, logs, [], list(known), joints=focus_joints(None, logs))
    study = run_study(
        problem.evaluate,
        parse_search_space({PREFIX + name: f"interval({p.low}, {p.high})" for name, p in known.items()}),
        sampler=sampler,
        storage=str(folder / f"{sampler}-{seed}.journal"),
        n_trials=cfg.trials,
        population=cfg.population,
        nominal={PREFIX + name: p.nominal for name, p in known.items()},
        seed=seed,
        progress=False,
    )
    losses = [np.nan if trial.value is None else float(trial.value) for trial in study.trials]
    best = np.fmin.accumulate(losses)
    return {
        "sampler": sampler,
        "seed": seed,
        "best": float(best[-1]),
        "best_at_quarter": float(best[max(0, len(best) // 4 - 1)]),
        "trials": len(losses),
        "simulated_seconds": len(losses) * problem.problem.replay.seconds,
        "wall_seconds": time.monotonic() - started,
        "losses": losses,
    }


@hydra.main(config_path="../../conf/benchmark", config_name="samplers", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run all studies, write page and result."""
    with one_sentence():
        torch.set_num_threads(1)
        check_given(cfg, "data", "a log")
        folder = Path(HydraConfig.get().runtime.output_dir)
        runs = []
        for sampler in cfg.samplers:
            for seed in cfg.seeds:
                runs.append(one_study(cfg, sampler, seed, folder))
                print(f"{sampler}, seed {seed}: {runs[-1]['best']:.6g} in {runs[-1]['wall_seconds']:.0f} s", flush=True)
        report(cfg, runs, folder)


def report(cfg: DictConfig, runs: list[dict[str, Any]], folder: Path) -> None:
    """Write page and result."""
    values: dict[str, Any] = {"trials": cfg.trials, "seeds": len(cfg.seeds)}
    rows = []
    for sampler in cfg.samplers:
        mine = [run for run in runs if run["sampler"] == sampler]
        best = [run["best"] for run in mine]
        values[f"{sampler}.best_mean"] = float(np.mean(best))
        values[f"{sampler}.best_each"] = best
        values[f"{sampler}.quarter_mean"] = float(np.mean([run["best_at_quarter"] for run in mine]))
        values[f"{sampler}.wall_seconds_mean"] = float(np.mean([run["wall_seconds"] for run in mine]))
        rows.append([sampler, *(values[f"{sampler}.{k}"] for k in ("best_mean", "quarter_mean", "wall_seconds_mean"))])
    values["simulated_seconds"] = float(sum(run["simulated_seconds"] for run in runs))
    provenance = run_provenance(data=plain(cfg.data))
    result = write_result(folder / "result.yaml", {**values, "provenance": provenance})
    best_of = min(rows, key=lambda row: row[1])
    page = Page("Samplers", f"After {cfg.trials} trials {best_of[0]} has the lowest mean loss, {best_of[1]:.3g}.")
    page.table(["sampler", "best loss", "after a quarter of the trials", "time [s]"], rows, caption="Means over seeds.")
    trials = {f"{run['sampler']}, seed {run['seed']}": run["losses"] for run in runs}
    page.figure(history_figure(trials), "Best so far of every study.")
    page.provenance(provenance)
    print(page.write(folder / "index.html"), result, sep="\n", flush=True)


if __name__ == "__main__":
    main()
