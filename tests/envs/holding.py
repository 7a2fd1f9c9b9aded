"""A policy without learning as a bundle: it holds the stand pose."""

import torch

from op3.policy import ActionMap, Manifest, PolicyBundle
from op3.policy.bundle import weight_shapes
from op3.robot import load_robot
from op3.tasks.task import find_task


def holding_bundle(task: str = "balance", p_gain: float = 4.0) -> PolicyBundle:
    attempted, action_map = find_task(task), ActionMap.around_stand(load_robot("op3"))
    manifest = Manifest(attempted.name, attempted.layout, attempted.history, action_map, (4,))
    weights = {name: torch.zeros(shape) for name, shape in weight_shapes(manifest).items()}
    weights["observation.scale"] += 1.0
    weights["layer_1.bias"] = torch.atanh(torch.from_numpy(action_map.stand(p_gain)).clamp(-0.999, 0.999)).float()
    return PolicyBundle(manifest, weights)
