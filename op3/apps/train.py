"""Train a policy on a simulated robot.

op3 train task=balance|walk [model=<model.yaml>] [seed=0] [budget=demo|laptop|paper]
op3 train -m task=balance model=<a.yaml>,<b.yaml> seed=0,1,2
op3 train task=walk algorithm=sac|td3|ppo
op3 train resume=<folder of a run> [train.steps=<more>]
op3 train task=balance model=<model.yaml> warm_start=<bundle>
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count as counted
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import by_name, model_artifact, output_folder, provenance, reported, wandb_of
from op3.apps.fields import plain, whole
from op3.common.assets import named_configs
from op3.common.private import CLAIMED
from op3.common.settings import imported, mistake, nearest
from op3.envs import BatchedEnv, make_env
from op3.policy import ActionMap, Manifest, PolicyBundle, Training
from op3.policy.mirror import Mirror
from op3.report import RunFolder, RunLogger
from op3.report.training_page import report_training
from op3.report.video import film
from op3.robot import load_robot
from op3.sim import model_for
from op3.sim.model_file import model_hash
from op3.tasks.task import Task, find_task
from op3.train import Algorithm, Curriculum, TrainSettings, evaluate
from op3.train import train as run_training
from op3.train.checkpoint import load_checkpoint
from op3.train.training import CHECKPOINT, check_unused

KEPT = ("task", "algorithm", "train", "environments", "env", "environment", "initial_gain", "fixed_gain", "warm_start")
"""Settings stored in the manifest of a policy."""

FRAME_EVERY = 2
"""Policy steps between two frames of the video."""

INTERRUPTED = "The same command with resume=<folder of the run> continues from its last checkpoint."


@dataclass(frozen=True, kw_only=True)
class Trained(CommandResult):
    """A trained policy.

    Attributes:
        policy: folder of the policy bundle.
    """

    policy: Path


def train(
    task: str = "balance",
    model: str | Path | None = None,
    *,
    robot: str | Path | None = None,
    algorithm: str | None = None,
    budget: str | None = None,
    steps: int | None = None,
    environments: int | None = None,
    warm_start: str | Path | None = None,
    resume: str | Path | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
    overrides: Sequence[str] = (),
) -> Trained:
    """Train a policy on a simulated robot.

    Args:
        task: a name in ``conf/task``.
        model: path of a ``model.yaml`` or a name in ``assets/models``; None: the model of the robot file.
        robot: a name in ``assets/robots`` or the path of a robot file; None: the robot of the task.
        algorithm: a name in ``conf/algorithm``.
        budget: a name in ``conf/budget``.
        steps: total number of steps of all robots; None: set by recipe and budget.
        environments: number of robots simulated in parallel.
        warm_start: folder of a policy bundle to start with.
        resume: folder of an earlier run to continue.
        seed: seed of all random numbers.
        folder: folder of the run; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.
        overrides: Hydra overrides of further settings in ``conf/train.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    folder = resume or folder
    with configured("train", **locals()) as cfg:
        return main(cfg)


def earlier(cfg: DictConfig) -> PolicyBundle | None:
    """The policy that the training starts from, or None."""
    return None if cfg.warm_start is None else PolicyBundle.load(cfg.warm_start)


def chosen_task(cfg: DictConfig) -> Task:
    """The task with the requested robot and P gain."""
    if cfg.robot is not None:
        cfg.task.robot = cfg.robot
    task = instantiate(cfg.task)
    if cfg.fixed_gain is None:
        return task
    return task.changed({"actions.p_gain": {"low": cfg.fixed_gain, "high": cfg.fixed_gain}})


def actions(cfg: DictConfig, task: Task) -> ActionMap:
    """The action map, taken from the initial policy if there is one; with `fixed_gain` actions command angles only."""
    start = earlier(cfg)
    made = task.action_map() if start is None else start.manifest.action_map
    if cfg.fixed_gain is None:
        return made
    return replace(made, gain_low=cfg.fixed_gain, gain_high=cfg.fixed_gain)


def environment(cfg: DictConfig, task: Task, count: int, seed: int) -> BatchedEnv:
    """The simulated robots with the task that the config describes."""
    options = {"num_threads": cfg.threads, **plain(cfg.environment)}
    made = make_env(task, cfg.model or "own", count, seed, action_map=actions(cfg, task), **options)
    assert isinstance(made, BatchedEnv)
    return made


def robots(cfg: DictConfig, task: Task) -> EnvBase:
    """The robots of the training."""
    options = {**plain(cfg.environment), "action_map": actions(cfg, task), "backend": cfg.env}
    if cfg.env == "composer" and cfg.environments != 1:
        raise ValueError(f"env=composer simulates one robot: set environments=1, got {cfg.environments}")
    if cfg.env == "batched":
        options["num_threads"] = cfg.threads
    if task.cycle is not None:  # a walking policy starts at a random gait phase
        task = task.changed({"gait.first_phase": None})
    return make_env(task, cfg.model or "own", cfg.environments, cfg.seed, **options)


def describe(cfg: DictConfig, task: Task, algorithm: Algorithm, facts: Mapping[str, Any]) -> Manifest:
    """The manifest of the policy to be trained."""
    training = Training(
        model=str(cfg.model or load_robot(task.robot).file.law or "own"),
        model_hash=model_hash(model_for(load_robot(task.robot), cfg.model)),
        git_hash=facts["git_hash"],
        seed=cfg.seed,
        command=facts["command"],
        date=facts["date"],
        settings={name: plain(cfg[name]) for name in KEPT},
    )
    return Manifest(
        task=task.name,
        layout=task.layout,
        history=task.history,
        action_map=actions(cfg, task),
        hidden=algorithm.settings.hidden,
        observations=task.terms("observations"),
        cycle=task.cycle,
        training=training,
    )


def learner(cfg: DictConfig, task: Task, robots: EnvBase) -> Algorithm:
    """The algorithm with an untrained policy, which holds the stand pose."""
    try:
        device = torch.device(cfg.device)
    except (RuntimeError, TypeError):
        raise ValueError(f"device={cfg.device}: give cpu or cuda") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: torch finds no GPU; leave device=cpu")
    action_map, start = actions(cfg, task), earlier(cfg)
    settings = plain(cfg.algorithm)
    if start is not None:
        settings |= {"hidden": list(start.manifest.hidden), "activation": start.manifest.activation}
    kind = imported(target := settings.pop("_target_"), "algorithm._target_")
    if not (isinstance(kind, type) and issubclass(kind, Algorithm)):
        raise ValueError(f"algorithm._target_: {target} is not a class derived from op3.train.Algorithm")
    mirror, stand = mirror_of(cfg, task, action_map), torch.as_tensor(action_map.stand(cfg.initial_gain))
    try:
        algorithm = kind(robots, seed=cfg.seed, initial_action=stand, mirror=mirror, device=device, **settings)
    except (ValueError, MemoryError):
        raise
    except Exception as error:
        raise ValueError(f"algorithm._target_={target}: {mistake(error, __file__)}") from error
    if cfg.resume is None and start is not None:
        algorithm.start_from(start)
    return algorithm


def mirror_of(cfg: DictConfig, task: Task, action_map: ActionMap) -> Mirror | None:
    """Mirroring of samples in the robot's plane of symmetry; None if it is off or some term has no mirror image."""
    if not cfg.algorithm.get("mirrored") or not load_robot(action_map.robot).partners:
        return None
    try:
        return task.mirror(action_map)
    except ValueError as error:
        print(f"Samples are not mirrored: {error}.")
        return None


def as_begun(cfg: DictConfig) -> tuple[DictConfig, dict[str, str]]:
    """Settings of the run to resume, with the new overrides, and its config groups."""
    folder, hydra_config = Path(cfg.resume), HydraConfig.get()
    if not (folder / CHECKPOINT).is_file():
        raise ValueError(
            f"resume={cfg.resume}: there is no {CHECKPOINT}; give the folder of a training, or omit resume"
        )
    begun = load_checkpoint(folder / CHECKPOINT)["config"]
    choices = begun.pop("choices")
    before = OmegaConf.create({**begun, "resume": cfg.resume})
    for name, value in by_name(hydra_config.overrides.task).items():
        if name in choices and name != "wandb":
            if value != choices[name]:
                raise ValueError(f"{name}={value}: the run in {folder} has {name}={choices[name]}; omit this override")
        else:
            OmegaConf.update(before, name.lstrip("+"), OmegaConf.select(cfg, name.lstrip("+")), force_add=True)
    given = [word for word in hydra_config.overrides.hydra if word != os.environ.get(CLAIMED)]
    asked = by_name(given).get("hydra.run.dir", "").strip("'")
    if asked and Path(asked).resolve() != folder.resolve():
        raise ValueError(
            f"hydra.run.dir={asked}: resume={cfg.resume} continues in its own folder; remove hydra.run.dir"
        )
    return before, choices


def main(cfg: DictConfig) -> Trained:
    """Train, evaluate the best policy, and write page, numbers and video; a sweep maximises the return."""
    torch.set_num_threads(1)
    choices = {name: str(value) for name, value in HydraConfig.get().runtime.choices.items()}
    if cfg.resume is not None:
        cfg, choices = as_begun(cfg)
    for name, least in (("episodes", 1), ("seed", 0), ("final_seed", 0)):
        whole(cfg, f"evaluation.{name}", least)
    folder = Path(cfg.resume or output_folder())
    if cfg.resume is None:
        check_unused(folder)
    recipe, recipes = choices["recipe"], named_configs("recipe")
    if recipe not in ("null", choices["task"], *recipes):  # Hydra ignores a missing optional config
        raise ValueError(f"recipe={recipe}: there is no {recipe!r} in the group recipe{nearest(recipe, recipes)}")
    task, facts = chosen_task(cfg), provenance(cfg)
    settings, curriculum = TrainSettings(**plain(cfg.train)), Curriculum(task.schedules)
    training = robots(cfg, task)
    algorithm = learner(cfg, task, training)
    manifest = describe(cfg, task, algorithm, facts)
    judge_task = task if cfg.evaluation.task is None else find_task(cfg.evaluation.task)
    judge = environment(cfg, judge_task, cfg.evaluation.episodes, cfg.evaluation.seed)

    def judged(policy: Any, seed: int = cfg.evaluation.seed) -> dict[str, float]:
        return evaluate(judge, policy, seed, judge_task.steps)

    with RunLogger(folder, config=plain(cfg), wandb=wandb_of(cfg)) as logger:
        progress = run_training(
            algorithm,
            training,
            judged,
            settings,
            manifest,
            folder,
            curriculum=curriculum,
            log=lambda measures, step: logger.log(measures, step),
            say=lambda line: print(line, flush=True),
            config={**plain(cfg), "resume": None, "choices": choices},
            resume=cfg.resume is not None,
        )
        training.close(raise_if_closed=False)
        if progress.stopped:
            print(f"Stopped after {progress.steps:,} steps. To continue: op3 train resume={folder}")
            raise SystemExit(143)
        policy = PolicyBundle.load(folder / "policy")
        # episodes differ from those that selected the policy
        final, states = episode(judge, policy, cfg.evaluation.final_seed, judge_task.steps)
        files = {"policy/manifest.yaml": "the policy bundle", "checkpoint.pt": "from which resume= continues"}
        rate, video = 1.0 / (FRAME_EVERY * judge.policy_period), folder / "episode.mp4"
        if cfg.evaluation.video and film(judge.scene, states, video, rate, follow=judge_task.cycle is not None):
            files["episode.mp4"] = "a video of one episode of the kept policy"
            logger.film("episode", video)
        numbers: dict[str, Any] = {f"evaluation.{name}": value for name, value in final.items()}
        numbers |= {
            "evaluation.task": judge_task.name,
            "evaluation.episodes": cfg.evaluation.episodes,
            "policy.steps": policy.manifest.training.steps,
            "policy.updates": policy.manifest.training.updates,
            "steps": progress.steps,
            "updates": algorithm.updates,
            "wall_seconds": progress.seconds,
        }
        logger.summary({name: value for name, value in numbers.items() if isinstance(value, int | float)})
        begun = [] if cfg.warm_start is None else [("policy", cfg.warm_start)]
        logger.lineage([*begun, *model_artifact(cfg)], [("policy", folder / "policy")])
    values = report_training(
        progress.history,
        RunFolder(folder, facts),
        title=f"Training: {task.name} on {manifest.training.model}, seed {cfg.seed}",
        numbers=numbers,
        settings={f"{part}.{k}": v for part in ("algorithm", "train") for k, v in plain(cfg[part]).items()},
        files=files,
    )
    return reported(Trained, values, "evaluation.return", folder=folder, policy=folder / "policy")


def episode(judge: BatchedEnv, policy: PolicyBundle, seed: int, steps: int) -> tuple[dict[str, float], np.ndarray]:
    """An evaluation, and the states [frame, nq] of the first robot's episode."""
    positions, states, step = judge.simulation.batch.bind("qpos"), [], counted()

    def watch(_: torch.Tensor, running: torch.Tensor) -> None:
        if next(step) % FRAME_EVERY == 0 and bool(running[0]):
            states.append(np.array(positions[0]))

    return evaluate(judge, policy.act, seed, steps, watch), np.stack(states)
