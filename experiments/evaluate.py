"""Judge a policy, or a baseline, under R_eval on a simulated robot.

python experiments/evaluate.py policy=<bundle> model=<model.yaml> task=balance_eval [episodes=10]
python experiments/evaluate.py -m policy=<bundle>,hold,random task=balance_eval,balance_weight
python experiments/evaluate.py -m policy=<bundle>,stiff task=walk,walk_bricks_a,walk_bricks_b,walk_bricks_c
"""

from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from support import one_sentence

from op3.envs import BatchedEnv, make_env, record_episodes
from op3.policy import ActionMap, PolicyBundle
from op3.report import run_provenance
from op3.report.evaluation import report_evaluation
from op3.report.video import film
from op3.sim import load_model
from op3.tasks.baselines import Hold, Random, StiffWalk, Zero, position_mode
from op3.tasks.behaviour import gains, gait_profile, mean_tilt
from op3.tasks.evaluation import evaluation_return

FRAME_EVERY = 3
"""Policy steps between two frames of the film."""


class Watched:
    """A policy, and the states of the first robot whenever it acts."""

    def __init__(self, policy: Any, env: BatchedEnv):
        self.policy, self.states = policy, []
        self._qpos = env.simulation.batch.bind("qpos")
        if hasattr(policy, "commands"):  # it commands the servos itself
            self.commands = policy.commands

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """The policy's action."""
        self.states.append(np.array(self._qpos[0]))
        return self.policy.act(observation)


def find_policy(cfg: DictConfig) -> tuple[Any, ActionMap]:
    """A bundle or a baseline, and what its actions mean."""
    action_map = ActionMap.around_stand()
    baselines = {
        "hold": lambda: Hold(cfg.hold_gain, action_map),
        "zero": lambda: Zero(action_map),
        "random": lambda: Random(cfg.seed, action_map),
        "stiff": StiffWalk,
    }
    if cfg.policy in baselines:
        return baselines[cfg.policy](), action_map
    if not Path(cfg.policy).exists():
        raise FileNotFoundError(f"policy={cfg.policy}: no such folder; give a bundle's, or {', '.join(baselines)}")
    bundle = PolicyBundle.load(cfg.policy)
    return bundle, bundle.manifest.action_map


def run(cfg: DictConfig) -> dict[str, Any]:
    """Play the episodes, and write numbers, page, logs and film."""
    torch.set_num_threads(1)
    if OmegaConf.is_missing(cfg, "policy"):
        raise ValueError("policy is missing: add policy=<folder of a bundle>, or hold, zero, random or stiff")
    if not isinstance(cfg.episodes, int) or cfg.episodes < 1:
        raise ValueError(f"episodes must be a whole number of at least 1, got {cfg.episodes!r}")
    folder, task = Path(HydraConfig.get().runtime.output_dir), instantiate(cfg.task)
    policy, action_map = find_policy(cfg)
    size = policy.manifest.observation_size if isinstance(policy, PolicyBundle) else task.observation_size
    if size != task.observation_size:
        raise ValueError(
            f"policy={cfg.policy} reads {size} numbers, task {task.name} gives {task.observation_size}; it was trained "
            f"for {policy.manifest.task}"
        )
    options = {"num_threads": cfg.threads, **OmegaConf.to_container(cfg.environment, resolve=True)}  # type: ignore[dict-item]
    stiff = isinstance(policy, StiffWalk)
    if stiff and task.cycle is None:
        raise ValueError(
            f"policy=stiff walks, but task {task.name} has no gait; give task=walk or one on uneven ground"
        )
    model = position_mode(load_model(cfg.model)) if stiff else cfg.model
    env = make_env(task, model, cfg.episodes, cfg.seed, action_map=action_map, **options)
    assert isinstance(env, BatchedEnv)
    watched = Watched(policy, env)
    logs = record_episodes(env, watched, cfg.episodes, recording=f"{task.name}-{cfg.seed}")
    returns = [evaluation_return(log) for log in logs]
    numbers: dict[str, Any] = {
        "evaluation.task": task.name,
        "evaluation.model": str(cfg.model),
        "evaluation.policy": str(cfg.policy),
        "evaluation.episodes": len(logs),
        "evaluation.upright": float(np.mean([not log.metadata.fallen for log in logs])),
        "evaluation.return_mean": float(np.mean(returns)),
        "evaluation.return_std": float(np.std(returns)),
        "evaluation.duration": float(np.mean([log.metadata.episode_duration for log in logs])),
        "evaluation.tilt": float(np.mean([mean_tilt(log) for log in logs])),
    }
    each = [] if stiff else [gains(log, task) for log in logs]  # in position mode a servo's gain is its own
    for name in each[0] if each else ():
        numbers[f"evaluation.{name}"] = float(np.mean([values[name] for values in each if name in values]))
    if task.cycle is not None:
        speeds = [log.metadata.travelled_distance / log.metadata.episode_duration for log in logs]  # type: ignore[operator]
        numbers["evaluation.speed"] = float(np.mean(speeds))
    numbers["evaluation.returns"] = returns
    files = {}
    if cfg.logs:
        for number, log in enumerate(logs):
            log.save(folder / "logs" / f"{number:03d}")
        files["logs/000/metadata.yaml"] = f"{len(logs)} episodes as rollouts, in logs/"
    if cfg.video:
        steps = round(logs[0].metadata.episode_duration / env.policy_period)  # type: ignore[operator]
        states = np.stack(watched.states[:steps:FRAME_EVERY])
        rate = 1 / (FRAME_EVERY * env.policy_period)
        if film(env.simulation.batch.model, states, folder / "episode.png", rate, follow=task.cycle is not None):
            files["episode.png"] = "the first episode, animated"
    long_enough = [log for log in logs if log.duration > 1.5 and not stiff]
    return report_evaluation(
        logs,
        folder,
        label=Path(cfg.policy).name,
        task=task.name,
        numbers=numbers,
        returns={Path(cfg.policy).name: returns},
        provenance=run_provenance(seed=cfg.seed),
        profile=gait_profile(long_enough, task, cfg.joint) if task.cycle is not None and long_enough else None,
        joint=cfg.joint,
        files=files,
    )


@hydra.main(config_path="../conf", config_name="evaluate", version_base="1.3")
def main(cfg: DictConfig) -> Any:
    """Evaluate and report; a sweep maximises the mean return."""
    with one_sentence():
        return run(cfg)["evaluation.return_mean"]


if __name__ == "__main__":
    main()
