"""Name the effects that a model does not include, from logs of a stand or of a servo bench.

op3 diagnose data=<folder of logs> model=<model.yaml or name in assets/models>
op3 diagnose data=<folder of logs> model=paper mode=loop      # repeats it from the returned model
op3 diagnose data=<folder of logs> model=paper mode=aliasing  # which effects these logs reveal
op3 diagnose data=<folder> model=paper policy=assets/policies/balance [actual=<logs of its episodes>]
op3 diagnose planned=leg_suite mode=aliasing   # which effects a suite would reveal
op3 diagnose "planned=[squat_fast,multisine_legs]" mode=aliasing
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from threadpoolctl import threadpool_limits

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, reported
from op3.apps.fields import plain, whole
from op3.apps.progress import ProgressLine
from op3.apps.support import library_motion, run_folder
from op3.diagnose import (
    Diagnosis,
    Settings,
    Verdict,
    aliasing,
    diagnosed_mount,
    on_other_mounts,
    split_logs,
    suited,
    with_chain,
)
from op3.diagnose.window_gaps import gap_table
from op3.identify.resolvers import chosen_model
from op3.motions import leg_suite
from op3.policy import PolicyBundle
from op3.replay.planned import planned_motions, planned_suite
from op3.report.diagnosis_page import report_diagnosis
from op3.robot import DEFAULT
from op3.rollout import Rollout, read_logs
from op3.servo import effect_class
from op3.sim import model_for, save_model


@dataclass(frozen=True, kw_only=True)
class Diagnosed(CommandResult):
    """Result of a diagnosis.

    Attributes:
        verdict: findings with sizes and probabilities, and the returned model; None with ``mode=aliasing``.
        content: the content of ``verdict.yaml`` or ``aliasing.yaml``.
    """

    verdict: Verdict | None
    content: dict[str, Any]


def diagnose(
    data: str | Path | Sequence[str | Path],
    model: str | Path | None = None,
    *,
    robot: str | Path | None = None,
    mode: str = "once",
    without: Sequence[str] = (),
    policy: str | Path | None = None,
    task: str | None = None,
    actual: str | Path | None = None,
    episodes: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
    overrides: Sequence[str] = (),
) -> Diagnosed:
    """Name the effects that a model does not include, from logs.

    Args:
        data: logs of one robot on a stand, or of a servo on a bench: a folder, a pattern or a list of them.
        model: path of a ``model.yaml`` or a name in ``assets/models``; None: the robot's own.
        robot: robot of the logs; None: as in the logs.
        mode: ``once``, ``loop`` (repeats from the returned model) or ``aliasing`` (which effects these logs reveal).
        without: effects of the catalogue that are not considered.
        policy: folder of a bundle whose return is predicted before and after the diagnosis.
        task: task of the policy, a name in ``conf/task``.
        actual: logs of the policy's episodes on the robot, for comparison.
        episodes: number of episodes under each model.
        seed: seed of all random numbers.
        folder: folder of the run; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.
        overrides: Hydra overrides of further settings in ``conf/diagnose.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("diagnose", **locals()) as cfg:
        return main(cfg)


def planned_logs(cfg: DictConfig) -> list[Rollout]:
    """Logs of the planned motions, simulated by the model."""
    model = with_chain(chosen_model(cfg))
    if cfg.planned == "leg_suite":
        return planned_suite(model, leg_suite(cfg.seed))
    names = [cfg.planned] if isinstance(cfg.planned, str) else plain(cfg.planned)
    return planned_motions(model, [library_motion(name, cfg.robot or DEFAULT) for name in names])


def attempts(cfg: DictConfig) -> tuple[PolicyBundle, list[Rollout]]:
    """The policy whose return is predicted, checked against the task, and its episodes on the robot."""
    policy = PolicyBundle.load(cfg.policy)
    instantiate(cfg.task).check_policy(policy.manifest, f"policy={cfg.policy}")
    actual = () if cfg.actual is None else read_logs(plain(cfg.actual))
    return policy, [episode for log in actual for episode in (log.episodes() if log.batched else [log])]


def returns(cfg: DictConfig, verdict: Verdict, policy: PolicyBundle, episodes: list[Rollout]) -> dict[str, Any]:
    """Predicted returns of a policy before and after the diagnosis, and its measured returns if it has episodes."""
    from op3.transfer.downstream import downstream  # imports TorchRL, which a diagnosis without a policy does not need

    options = {"task": instantiate(cfg.task), "episodes": cfg.episodes, "seed": cfg.seed, "progress": ProgressLine()}
    return {"policy": str(cfg.policy)} | downstream(policy, verdict.base, verdict.model, actual=episodes, **options)


def main(cfg: DictConfig, truth: Callable[[], str] | None = None) -> Diagnosed:
    """Diagnose, and write verdict, model and page.

    Args:
        truth: reveals what is hidden in a simulated robot, for the page; called after the verdict.
    """
    torch.set_num_threads(1)
    threadpool_limits(1)  # as in `Diagnosis.run`, for the work outside it
    began, folder = time.process_time(), output_folder()
    if cfg.mode not in ("once", "loop", "aliasing"):
        raise ValueError(f"mode must be once, loop or aliasing, got {cfg.mode!r}")
    if cfg.planned and not OmegaConf.is_missing(cfg, "data"):
        raise ValueError("planned= and data= cannot be combined: planned motions are simulated, data were recorded")
    whole(cfg, "episodes", 1)
    for name in cfg.without:
        effect_class(name)
    if cfg.planned and cfg.mode != "aliasing":
        raise ValueError(
            "planned motions contain no measurement to diagnose: add mode=aliasing, or give data= instead of planned="
        )
    attempted = None if cfg.policy is None else attempts(cfg)  # errors are raised before work that takes minutes
    data: Any = None if cfg.planned else plain(cfg.data)
    logs, others = diagnosed_mount(planned_logs(cfg) if cfg.planned else read_logs(data, cfg.robot))
    model = suited(model_for(logs[0].robot, cfg.model), logs)
    split = split_logs(logs, seed=cfg.seed)
    diagnosis = Diagnosis(
        model,
        split,
        seed=cfg.seed,
        without=tuple(cfg.without),
        settings=Settings(windows=cfg.windows),
        progress=ProgressLine(),
    )
    if cfg.mode == "aliasing":
        content = aliasing(diagnosis, planned=bool(cfg.planned))
        (folder / "aliasing.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
        return Diagnosed(folder, content["sentence"], files=(folder / "aliasing.yaml",), verdict=None, content=content)
    verdict = diagnosis.run(cfg.rounds if cfg.mode == "loop" else 1)
    content = verdict.plain()
    if truth is not None:
        content["hidden"] = truth()
    if others:
        content["mount"] = logs[0].metadata.mount
        content["other_mounts"] = on_other_mounts(verdict.base, verdict.model, others, cfg.seed)
    save_model(verdict.base, folder / "baseline.yaml")
    save_model(verdict.model, folder / "model.yaml")
    if attempted is not None:
        content["downstream"] = returns(cfg, verdict, *attempted)
    content["processor_seconds"] = round(time.process_time() - began, 1)
    if verdict.windows is not None:
        print(gap_table(verdict.windows))
    values = report_diagnosis(verdict, split, content, run_folder(cfg, model="model.yaml"))
    # written last: if a verdict exists, so do all other files
    (folder / "verdict.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return reported(Diagnosed, values, verdict=verdict, content=content)
