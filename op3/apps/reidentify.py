"""Re-identify a robot from a failed transfer by matching the returns of its episodes.

op3 reidentify policy=<bundle> model=<model.yaml> data=<squat log> episodes=<folder of logs>
op3 reidentify ... diagnose=true diagnosis=<folder of logs from the stand>
op3 reidentify -m policy=... model=... data=... episodes=... seed=0,1,2
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import optuna
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, reported
from op3.apps.diagnose import diagnose
from op3.apps.fields import plain
from op3.apps.job import goes_on
from op3.apps.stages import Stages
from op3.apps.support import run_folder
from op3.identify.identification import PREFIX
from op3.identify.search_space import parse_search_space
from op3.identify.sweeper import sweep_or_report
from op3.policy import PolicyBundle
from op3.report.reidentification_page import report_reidentification
from op3.rollout import read_logs
from op3.sim import load_model, save_model
from op3.transfer.failed_episodes import ended_by, that_count
from op3.transfer.reidentification import Reidentification

INTERRUPTED = goes_on("trials")


@dataclass(frozen=True, kw_only=True)
class ReidentifiedModel(CommandResult):
    """A model that was re-identified from a failed transfer.

    Attributes:
        model: path of its ``model.yaml``.
    """

    model: Path


def reidentify(
    policy: str | Path,
    model: str | Path,
    data: str | Path | Sequence[str | Path],
    episodes: str | Path | Sequence[str | Path],
    *,
    task: str | None = None,
    groups: Sequence[str] | None = None,
    diagnosed: bool = False,
    start_name: str | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
    overrides: Sequence[str] = (),
) -> ReidentifiedModel:
    """Re-identify a robot from a policy's failed transfer: match the returns of its episodes.

    Args:
        policy: folder of the policy's bundle.
        model: ``model.yaml`` that the policy was trained on.
        data: log of the excitation that the model was identified from.
        episodes: logs of the policy's episodes on the robot.
        task: task of the policy, a name in ``conf/task``.
        groups: parameter groups to search; None: the groups of the config.
        diagnosed: whether to diagnose the robot first.
        start_name: name of the initial model on the page.
        seed: seed of all random numbers.
        folder: folder of the run, where an interrupted run continues; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.
        overrides: Hydra overrides of further settings in ``conf/reidentify.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("reidentify", **locals()) as cfg:
        return main(cfg)


def build(cfg: DictConfig) -> Reidentification:
    """The re-identification that the config describes."""
    space = parse_search_space(plain(HydraConfig.get().sweeper.params))
    model = load_model(cfg.model)
    known = model.parameters()
    names = [name for name in cfg.parameters if PREFIX + name in space]
    absent = [name for name in names if name not in known]
    if absent:
        raise ValueError(f"groups: {absent[0]!r} is not a parameter of {cfg.model}; leave its group out")
    episodes, others = that_count(read_logs(plain(cfg.episodes)))
    if others:
        print(
            f"{len(others)} episodes are ignored: they ended because of {ended_by(others)}, not by a fall", flush=True
        )
    if not episodes:
        raise ValueError(
            f"episodes={plain(cfg.episodes)}: all ended because of {ended_by(others)}, which no simulation of the"
            " policy can reproduce; diagnose the robot, fix the cause, and record new episodes"
        )
    return Reidentification(
        model,
        read_logs(plain(cfg.data)),
        episodes,
        PolicyBundle.load(cfg.policy),
        names,
        task=None if cfg.get("task") is None else instantiate(cfg.task),
        repeats=cfg.repeats,
        race=cfg.race,
        seed=cfg.seed,
        # a launcher already runs its jobs in parallel
        processes=cfg.processes if cfg.population is None else 1,
    )


def diagnosed_model(cfg: DictConfig, folder: Path) -> str:
    """The model file with the effects that a diagnosis names, written once into the run's folder.

    Raises:
        ValueError: with -m, because every job would repeat the diagnosis.
    """
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise ValueError(
            "diagnose=true needs a single run: run op3 diagnose once, and give its model.yaml as model= to all runs"
        )
    logs = plain(cfg.data if cfg.diagnosis is None else cfg.diagnosis)
    made = Stages(folder).run("diagnose", diagnose, data=logs, model=cfg.model, seed=cfg.seed, wandb=cfg.wandb.mode)
    return str(made / "model.yaml")


def main(cfg: DictConfig) -> Any:
    """Evaluate a population for the sweeper, or run the study and report it."""
    torch.set_num_threads(1)
    started, folder = time.monotonic(), output_folder()
    if cfg.diagnose:
        cfg.model = diagnosed_model(cfg, folder)
    problem = build(cfg)

    def report(study: optuna.Study) -> ReidentifiedModel:
        found = replace(problem.finish(study, cfg.finalists), start_name=cfg.start_name)
        save_model(found.model, folder / "model.yaml")
        values = report_reidentification(
            found,
            study,
            run_folder(cfg, model="model.yaml"),
            wall_seconds=time.monotonic() - started,
            simulated_seconds=problem.simulated_seconds,
        )
        return reported(ReidentifiedModel, values, model=folder / "model.yaml")

    def propose(count: int) -> list[dict[str, float]]:
        space = parse_search_space(plain(HydraConfig.get().sweeper.params))
        bounds = {name: (space[PREFIX + name].low, space[PREFIX + name].high) for name in problem.names}
        return problem.propose(count, bounds, seed=cfg.seed)

    return sweep_or_report(cfg, problem.evaluate, report, propose, {"objectives": problem.identity})
