"""Terms, observations and episodes on another device: torch's meta device, whose tensors have no values to ask for."""

import dataclasses

import numpy as np
import pytest
import torch

from op3.envs import make_env
from op3.tasks import find_task, task_names
from op3.tasks.mdp import Mdp
from op3.tasks.snapshot import to_device

ROBOTS = [(name, None) for name in task_names()] + [("stand", "quadruped"), ("walk", "quadruped")]


@pytest.mark.parametrize(("name", "robot"), ROBOTS)
def test_a_step_stays_on_its_device(name, robot):
    """An operation on tensors of two devices, and a value that Python asks for, would be an error."""
    task = find_task(name) if robot is None else find_task(name, robot=robot)
    collision = [term for term in task.terms("terminations") if term == "commanded_collision"]
    task = task.changed({f"terminations.{term}": None for term in collision})  # asks MuJoCo, on the processor
    env = make_env(task, "own", num_envs=2, num_threads=1)
    env.rollout(2)
    measured, statistics = env.snapshot(), env._whole_step.result()
    with torch.device("meta") as device:
        mdp = Mdp(task, env.scene, env.model, env.action_map, 2)
        mdp.attach(env.mdp._world)
        mdp.begin(np.arange(2), np.arange(2))
        mdp.begun(to_device(measured, device))
        action, failed = torch.zeros(2, env.action_map.size), torch.zeros(2, dtype=torch.bool)
        outcome = mdp.finish(action, to_device(measured, device), to_device(statistics, device), failed)
    for field in dataclasses.fields(outcome):
        value = getattr(outcome, field.name)
        for tensor in value.values() if isinstance(value, dict) else [value]:
            assert tensor.device.type == "meta", field.name
