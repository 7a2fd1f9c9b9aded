"""Search the numbers of a walk without learning, which can demonstrate walking to a learner.

python experiments/find_gait.py [task=walk] [start=<numbers>.yaml] [generations=40] [noise=0.02]
"""

from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from support import one_sentence, plain, positive, whole

from op3.envs import BatchedEnv, make_env
from op3.envs.gait_search import Generation, search
from op3.policy import ActionMap
from op3.tasks import Stride


def run(cfg: DictConfig) -> Path:
    """Search, and keep the middle of every generation."""
    torch.set_num_threads(1)
    path, task = Path(HydraConfig.get().runtime.output_dir) / "walk.yaml", instantiate(cfg.task)
    if task.cycle is None:
        raise ValueError(f"task={task.name}: has no gait; search a walk on a walking task")
    if not task.desired_velocity[0] > 0:
        raise ValueError(f"task.desired_velocity must be forwards for a search, got {task.desired_velocity}")
    for name, least in (("generations", 1), ("candidates", 4), ("seed", 0), ("threads", 0)):
        whole(cfg, name, least)
    for name in ("noise", "speed_weight"):
        if not cfg[name] >= 0:
            raise ValueError(f"{name} must be at least 0, got {cfg[name]}")
    positive(cfg, "spread", "multiples of the scales")
    start = Stride() if cfg.start is None else Stride.load(cfg.start)
    options = {"num_threads": cfg.threads, **plain(cfg.environment)}
    action_map = ActionMap.around_stand(cfg.span)
    env = make_env(task, cfg.model, cfg.candidates, cfg.seed, action_map=action_map, **options)
    assert isinstance(env, BatchedEnv)
    number = 0

    def say(generation: Generation) -> None:
        nonlocal number
        number += 1
        generation.mean.save(path)
        print(
            f"generation {number}  score {np.mean(generation.score):.1f}, best {np.max(generation.score):.1f}  "
            f"upright {generation.upright:.2f}  {generation.speed:.3f} m/s",
            flush=True,
        )

    search(
        env,
        start,
        cfg.generations,
        noise=cfg.noise,
        speed_weight=cfg.speed_weight,
        spread=cfg.spread,
        seed=cfg.seed,
        say=say,
    )
    print(path)
    return path


@hydra.main(config_path="../conf", config_name="find_gait", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Search and say where the numbers are."""
    with one_sentence("Nothing is kept but what the folder holds."):
        run(cfg)


if __name__ == "__main__":
    main()
