"""Tiny policies for the tests."""

import numpy as np
import torch

from op3.policy import Manifest, PolicyBundle
from op3.policy.bundle import weight_shapes
from op3.tasks import find_task


def hold_policy(task: str = "balance", feedback: float = 0.0, seed: int = 0, robot: str = "op3") -> PolicyBundle:
    """Holds the stand pose with a P gain of 5 A/rad; with feedback, actions depend a little on every observation."""
    made = find_task(task, robot=robot)
    action_map = made.action_map()
    manifest = Manifest(task=task, layout=made.layout, history=made.history, action_map=action_map, hidden=(8,))
    generator = torch.Generator().manual_seed(seed)
    weights = {
        name: feedback * torch.randn(shape, generator=generator) for name, shape in weight_shapes(manifest).items()
    }
    weights["observation.mean"] = torch.zeros(manifest.observation_size)
    weights["observation.scale"] = torch.ones(manifest.observation_size)
    weights["layer_1.bias"] = torch.from_numpy(np.arctanh(action_map.stand(5.0))).float()
    return PolicyBundle(manifest, weights)
