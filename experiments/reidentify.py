"""Re-identify a robot from a policy's failed transfer: match what its episodes were worth.

python experiments/reidentify.py policy=<bundle> model=<model.yaml> data=<squat log> episodes=<folder of logs>
python experiments/reidentify.py ... diagnose=true diagnosis=<folder of logs from the stand>
python experiments/reidentify.py -m policy=... model=... data=... episodes=... seed=0,1,2
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import optuna
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from stages import Stages
from support import goes_on, one_sentence, plain, run_folder

from op3.command_line import launch
from op3.identify.episodes import ended_by, that_count
from op3.identify.identification import PREFIX
from op3.identify.reidentification import Reidentification
from op3.identify.resolvers import register as register_interpolations
from op3.identify.search_space import parse_search_space
from op3.identify.sweeper import sweep_or_report
from op3.policy import PolicyBundle
from op3.report.reidentification_page import report_reidentification
from op3.rollout import read_logs
from op3.sim import load_model, save_model

register_interpolations()


def build(cfg: DictConfig) -> Reidentification:
    """The re-identification that the config describes."""
    space = parse_search_space(plain(HydraConfig.get().sweeper.params))
    model = load_model(cfg.model)
    known = model.parameters()
    names = [name for name in cfg.parameters if PREFIX + name in space]
    absent = [name for name in names if name not in known]
    if absent:
        raise ValueError(f"groups: {absent[0]!r} is no parameter of {cfg.model}; leave its group out")
    episodes, others = that_count(read_logs(plain(cfg.episodes)))
    if others:
        print(f"{len(others)} episodes do not count: they ended by {ended_by(others)}, not by a fall", flush=True)
    if not episodes:
        raise ValueError(
            f"episodes={plain(cfg.episodes)}: all ended by {ended_by(others)}, as no simulation of the policy does;"
            " diagnose the robot, mend the cause, and record others"
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
        # a launcher's jobs are side by side already
        processes=cfg.processes if cfg.population is None else 1,
    )


def diagnosed(cfg: DictConfig, folder: Path) -> str:
    """The model file with what a diagnosis finds missing, made once in the run's folder.

    Raises:
        ValueError: with -m, where jobs of their own would each diagnose.
    """
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise ValueError(
            "diagnose=true is for a single run: run diagnose.py once, and give its model.yaml as model= to all of these"
        )
    logs = plain(cfg.data if cfg.diagnosis is None else cfg.diagnosis)
    listed = logs if isinstance(logs, str) else f"[{','.join(logs)}]"
    where = [f"data={listed}", f"model={cfg.model}", f"seed={cfg.seed}", f"wandb={cfg.wandb}"]
    return str(Stages(folder).run("diagnose", "diagnose.py", *where) / "model.yaml")


@hydra.main(config_path="../conf", config_name="reidentify", version_base="1.3")
def main(cfg: DictConfig) -> Any:
    """Evaluate a population for the sweeper, or run the study and report it."""
    register_interpolations()  # a launcher's worker process has not run this file from the top
    with one_sentence(goes_on("trials"), cfg):
        torch.set_num_threads(1)
        started = time.monotonic()
        missing = [key for key in ("policy", "model", "data", "episodes") if OmegaConf.is_missing(cfg, key)]
        if missing:
            raise ValueError(f"{missing[0]} is missing: add {missing[0]}=<path>")
        folder = Path(HydraConfig.get().runtime.output_dir)
        if cfg.diagnose:
            cfg.model = diagnosed(cfg, folder)
        problem = build(cfg)

        def report(study: optuna.Study) -> dict[str, Any]:
            found = replace(problem.finish(study, cfg.finalists), start_name=cfg.start_name)
            save_model(found.model, folder / "model.yaml")
            return report_reidentification(
                found,
                study,
                run_folder(cfg, folder, model="model.yaml"),
                wall_seconds=time.monotonic() - started,
                simulated_seconds=problem.simulated_seconds,
            )

        def propose(count: int) -> list[dict[str, float]]:
            space = parse_search_space(plain(HydraConfig.get().sweeper.params))
            bounds = {name: (space[PREFIX + name].low, space[PREFIX + name].high) for name in problem.names}
            return problem.propose(count, bounds, seed=cfg.seed)

        return sweep_or_report(cfg, problem.evaluate, report, propose, {"objectives": problem.identity})


if __name__ == "__main__":
    launch(main, "reidentify", __doc__)
