"""Measure the return R_eval and the success rate of a policy or baseline in simulation.

op3 evaluate policy=<bundle> model=<model.yaml> task=balance_eval [episodes=10]
op3 evaluate policy=<bundle> task=balance_eval episodes=20 baseline=hold
op3 evaluate -m policy=<bundle>,hold,random task=balance_eval,balance_weight
op3 evaluate -m policy=<bundle>,stiff task=walk,walk_bricks_a,walk_bricks_b,walk_bricks_c
"""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, provenance, reported
from op3.apps.fields import plain, whole
from op3.apps.progress import ProgressLine
from op3.apps.support import run_folder
from op3.common.assets import here_or_shipped
from op3.common.sample_intervals import mean_interval, wilson_interval
from op3.compliance.robustness import Variation, make_card
from op3.envs import BatchedEnv
from op3.envs.actors import Watched, find_actor
from op3.envs.gait_validity import GaitValidity, judged_episodes
from op3.envs.tracking import Obedience, measure_obedience
from op3.policy.bundle import MANIFEST
from op3.report.evaluation_page import report_evaluation
from op3.report.video import film
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.sim import model_for
from op3.tasks.behaviour import gains, gait_profile, mean_tilt
from op3.tasks.evaluation import evaluation_return, succeeded
from op3.tasks.task import Task

FRAME_EVERY = 3
"""Policy steps between two frames of the video."""


INTERRUPTED = "Only results already in the folder are kept."


@dataclass(frozen=True, kw_only=True)
class Evaluated(CommandResult):
    """Result of an evaluation in simulation.

    Attributes:
        logs: logs of the episodes.
    """

    logs: list[Rollout]


def evaluate(
    policy: str | Path,
    task: str = "balance_eval",
    model: str | Path | None = None,
    *,
    robot: str | Path | None = None,
    episodes: int = 10,
    baseline: str | Path | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
    overrides: Sequence[str] = (),
) -> Evaluated:
    """Measure the return R_eval and the success rate of a policy or baseline in simulation.

    Args:
        policy: folder of a bundle, or ``hold``, ``zero``, ``random``, ``stiff``.
        task: a name in ``conf/task``.
        model: path of a ``model.yaml`` or a name in ``assets/models``; None: the model of the robot file.
        robot: a name in ``assets/robots`` or the path of a robot file; None: the robot of the task.
        episodes: number of episodes.
        baseline: policy to compare with on the same episodes.
        seed: seed of the episodes.
        folder: folder of the run; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.
        overrides: Hydra overrides of further settings in ``conf/evaluate.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("evaluate", **locals()) as cfg:
        return main(cfg)


class WithProgress(Watched):
    """A policy that prints the progress of its episodes, which have at most `steps` steps."""

    def __init__(self, policy: Any, env: BatchedEnv, steps: int):
        super().__init__(policy, env)
        self._say, self._steps = ProgressLine(), steps

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """The policy's action."""
        self._say("episodes", min(len(self.states) / self._steps, 1.0))
        return super().act(observation)


def play(
    cfg: DictConfig, task: Task, name: str, field: str = "policy"
) -> tuple[list[Rollout], Watched, BatchedEnv, GaitValidity]:
    """Logs of the episodes of a seed, the policy, the environment and the validity. Initial states are shared."""
    known = dict(seed=cfg.seed, hold_gain=cfg.hold_gain, gain_scale=cfg.gain_scale, field=field)
    actor = find_actor(name, task, **known)
    options = dict(num_threads=cfg.threads, randomisation=cfg.randomisation, gain_scale=cfg.gain_scale)
    env = actor.environment(task, cfg.model or "own", cfg.episodes, cfg.seed, **options)
    watched = WithProgress(actor.policy, env, task.steps)
    logs, validity = judged_episodes(env, watched, recording=f"{task.name}-{cfg.seed}")
    return logs, watched, env, validity


def passed(logs: Sequence[Rollout], task: Task, prefix: str = "") -> dict[str, Any]:
    """Share of successful episodes with Wilson's 95 % interval, and share of episodes without a fall."""
    successes = sum(succeeded(log, task) for log in logs)
    return {
        f"evaluation.{prefix}success": successes / len(logs),
        f"evaluation.{prefix}success_interval": list(wilson_interval(successes, len(logs))),
        f"evaluation.{prefix}upright": float(np.mean([not log.metadata.fallen for log in logs])),
    }


def card_folder(cfg: DictConfig) -> Path | None:
    """Folder of the bundle that gets a card; None if none is requested.

    Raises:
        ValueError: if the policy is not a bundle or its folder is not writable; checked before the episodes run.
    """
    if not cfg.card:
        return None
    folder = here_or_shipped(cfg.policy)
    if not (folder / MANIFEST).is_file():
        raise ValueError(
            f"card=true writes into a policy bundle, but policy={cfg.policy} is not one; give a bundle's folder"
        )
    if not os.access(folder, os.W_OK):
        raise ValueError(
            f"card=true: nothing can be written to {cfg.policy}; copy the bundle to a folder that you can write to"
        )
    return folder


def write_card(cfg: DictConfig, task: Task, folder: Path) -> None:
    """Measure the card's content, write the card into the bundle, and print it."""
    variations = {name: Variation(**values) for name, values in plain(cfg.variations).items()}
    facts = provenance(cfg)
    made = {name: facts[name] for name in ("command", "git_hash", "git_changes", "date", "seed") if name in facts}
    card = make_card(
        find_actor(cfg.policy, task),
        str(cfg.model or load_robot(task.robot).file.law or "own"),
        model_for(load_robot(task.robot), cfg.model),
        task,
        variations,
        made,
        robots=cfg.card_robots,
        seed=cfg.seed,
        num_threads=cfg.threads,
    )
    print(card.to_yaml())
    print(card.save(folder))


def plain_obedience(obeyed: Obedience) -> dict[str, Any]:
    """Errors with which a walk tracks its commands, as plain values."""
    values = dataclasses.asdict(obeyed)
    values["speeds"] = [list(row) for row in obeyed.speeds]
    return values | {"errors": list(obeyed.errors)}


def beside(cfg: DictConfig, task: Task, returns: list[float]) -> tuple[dict[str, Any], list[float]]:
    """Results and returns of the baseline on the same episodes, and the margins over it."""
    logs, *_ = play(cfg, task, cfg.baseline, "baseline")
    others = [evaluation_return(log, task) for log in logs]
    margins = [ours - theirs for ours, theirs in zip(returns, others, strict=True)]
    numbers = {
        "evaluation.baseline": str(cfg.baseline),
        **passed(logs, task, "baseline_"),
        "evaluation.baseline_return_mean": float(np.mean(others)),
        "evaluation.baseline_returns": others,
        "evaluation.margin": float(np.mean(margins)),
    }
    if len(margins) > 1:
        numbers["evaluation.margin_interval"] = list(mean_interval(margins))
    return numbers, others


def main(cfg: DictConfig) -> Evaluated:
    """Run the episodes, and write numbers, page, logs and video; a sweep maximises the mean return."""
    torch.set_num_threads(1)
    if OmegaConf.is_missing(cfg, "policy"):
        raise ValueError("policy is missing: add policy=<folder of a bundle>, or policy=hold, zero, random or stiff")
    whole(cfg, "episodes", 1)
    if cfg.robot is not None:
        cfg.task.robot = cfg.robot
    folder, task = output_folder(), instantiate(cfg.task)
    robot = load_robot(task.robot)
    if len(robot.legs) == 2 and cfg.joint not in robot.controlled:
        raise ValueError(f"joint={cfg.joint}: choose {', '.join(robot.controlled)}")
    if cfg.baseline is not None:  # checked before the episodes run
        find_actor(cfg.baseline, task, field="baseline")
    bundle = card_folder(cfg)
    logs, watched, env, validity = play(cfg, task, cfg.policy)
    print(f"motion: {validity}")
    obeyed = None
    if "velocity" in task.commands:
        actor = find_actor(cfg.policy, task)
        obeyed = measure_obedience(actor, cfg.model or "own", task, cfg.episodes, cfg.seed, num_threads=cfg.threads)
        print(obeyed)
        for asked, achieved, spread in obeyed.speeds:
            print(f"  {asked:.2f} m/s commanded: {achieved:.3f} m/s achieved (standard deviation {spread:.3f})")
    stiff = hasattr(watched, "commands")
    returns = [evaluation_return(log, task) for log in logs]
    numbers: dict[str, Any] = {
        "evaluation.task": task.name,
        "evaluation.model": str(cfg.model or robot.file.law or "own"),
        "evaluation.policy": str(cfg.policy),
        "evaluation.episodes": len(logs),
        **passed(logs, task),
        "evaluation.return_mean": float(np.mean(returns)),
        "evaluation.return_std": float(np.std(returns)),
        "evaluation.duration": float(np.mean([log.metadata.episode_duration for log in logs])),  # type: ignore
        "evaluation.tilt": float(np.mean([mean_tilt(log) for log in logs])),
    }
    numbers |= {f"evaluation.validity.{name}": value for name, value in dataclasses.asdict(validity).items()}
    if obeyed is not None:
        numbers |= {f"evaluation.commands.{name}": value for name, value in plain_obedience(obeyed).items()}
    takes_gains = not stiff and env.action_map.gain_low is not None
    each = [] if not takes_gains else [gains(log, task) for log in logs]
    for name in each[0] if each else ():
        numbers[f"evaluation.{name}"] = float(np.mean([values[name] for values in each if name in values]))
    if task.cycle is not None:
        speeds = [log.metadata.travelled_distance / log.metadata.episode_duration for log in logs]  # type: ignore[operator]
        numbers["evaluation.speed"] = float(np.mean(speeds))
    label = Path(cfg.policy).name
    shown = {label: returns}
    if len(returns) > 1:
        numbers["evaluation.return_interval"] = list(mean_interval(returns))
    if cfg.baseline is not None:
        more, others = beside(cfg, task, returns)
        numbers |= more
        shown[f"{cfg.baseline} (baseline)"] = others
    numbers["evaluation.returns"] = returns
    files = {}
    if cfg.logs:
        for number, log in enumerate(logs):
            log.save(folder / "logs" / f"{number:03d}")
        files["logs/000/metadata.yaml"] = f"logs of {len(logs)} episodes, in logs/"
    if cfg.video:
        steps = round(logs[0].metadata.episode_duration / env.policy_period)  # type: ignore[operator]
        states = np.stack(watched.states[:steps:FRAME_EVERY])
        rate = 1 / (FRAME_EVERY * env.policy_period)
        if film(env.scene, states, folder / "episode.mp4", rate, follow=task.cycle is not None):
            files["episode.mp4"] = "a video of the first episode"
    if bundle is not None:
        write_card(cfg, task, bundle)
    # a gait profile needs P gains and two legs
    long_enough = [log for log in logs if log.duration > 1.5 and takes_gains and len(robot.legs) == 2]
    values = report_evaluation(
        logs,
        run_folder(cfg, **({"log": "logs"} if cfg.logs else {})),
        label=label,
        task=task.name,
        numbers=numbers,
        returns=shown,
        profile=gait_profile(long_enough, task, cfg.joint) if task.cycle is not None and long_enough else None,
        joint=cfg.joint,
        files=files,
    )
    return reported(Evaluated, values, "evaluation.return_mean", logs=logs)
