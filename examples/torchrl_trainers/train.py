"""TorchRL's own trainers on a task of op3.

python examples/torchrl_trainers/train.py --config-name sac|ppo [environment.task=walk] [total_frames=10000]

The trainers, losses, networks, buffers and collectors are TorchRL's, made from its Hydra configs; of op3 there is only
the environment. Its sizes, which those configs want as numbers, come from its specs.
"""

import functools

import hydra
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torchrl.trainers.algorithms.configs import *  # noqa: F403 (registers the configs)


@functools.cache
def _sizes(environment: str) -> dict[str, int]:
    """Numbers in an observation and in an action of an environment."""
    made = instantiate(OmegaConf.create(environment))
    return {"observation": made.observation_spec["observation"].shape[-1], "action": made.action_spec.shape[-1]}


def size(kind: str, factor: int = 1, other: str | None = None, *, _root_: DictConfig) -> int:
    """``${size:observation}``, ``${size:action,2}``, ``${size:observation,1,action}``: their sum."""
    sizes = _sizes(OmegaConf.to_yaml(_root_.environment, resolve=True))
    return factor * sizes[kind] + (sizes[other] if other else 0)


OmegaConf.register_new_resolver("size", size, replace=True)


@hydra.main(config_path=".", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Train."""
    torch.manual_seed(cfg.trainer.seed)
    instantiate(cfg.trainer).train()


if __name__ == "__main__":
    main()
