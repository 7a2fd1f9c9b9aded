"""Policies for evaluation: a policy bundle given by folder, or a fixed policy given by name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from op3.envs.batched import BatchedEnv
from op3.envs.factory import make_env
from op3.policy import ActionMap, PolicyBundle
from op3.robot import load_robot
from op3.servo import RobotModel
from op3.sim import model_for
from op3.tasks.baselines import POSITION_GAIN, Hold, Random, StiffWalk, Zero, position_mode
from op3.tasks.task import Task


@dataclass(frozen=True, eq=False)
class Actor:
    """A policy to evaluate.

    Attributes:
        label: short name.
        policy: object with ``act(observation)``, or with ``commands(time)`` if it commands the servos directly.
        action_map: map from actions to commands.
    """

    label: str
    policy: Any
    action_map: ActionMap

    @property
    def stiff(self) -> bool:
        """Whether it uses the servos' position mode, without P gains from the robot's computer."""
        return hasattr(self.policy, "commands")

    def environment(self, task: Task, model: str | RobotModel, num_envs: int, seed: int, **options: Any) -> BatchedEnv:
        """An environment for the policy; further arguments are those of `op3.envs.make_env`."""
        if self.stiff:
            if isinstance(model, str):
                model = model_for(load_robot(task.robot), None if model == "own" else model)
            model = position_mode(model)
        made = make_env(task, model, num_envs, seed, action_map=self.action_map, **options)
        assert isinstance(made, BatchedEnv)
        made.commander = self.policy if self.stiff else None
        return made

    def step(self, env: BatchedEnv, state: TensorDictBase) -> TensorDictBase:
        """One policy step of all robots of an environment.

        Args:
            env: environment from `environment`.
            state: result of `reset`, `begin` or the previous step.

        Returns:
            The state after it, without the reward.
        """
        state["action"] = self.policy.act(state["observation"]).to(torch.float32).clamp(-1.0, 1.0)
        return env.step(state)["next"].exclude("reward")


class FixedGain:
    """A policy's target angles with one P gain for all its joints.

    Args:
        policy: object with a method ``act``.
        p_gain: P gain [A/rad].
    """

    def __init__(self, policy: Any, action_map: ActionMap, p_gain: float):
        self._policy, self._joints = policy, len(action_map.joints)
        low, high = action_map.gain_low, action_map.gain_high
        if low is None or high is None:
            raise ValueError(
                f"the servos of {action_map.robot} close their own position loop and accept no fixed P gain"
            )
        if not low <= p_gain <= high:
            raise ValueError(f"a fixed gain must be between {low} and {high} A/rad, got {p_gain}")
        self._share = 2 * (p_gain - low) / (high - low) - 1

    def act(self, observation: Tensor) -> Tensor:
        """The policy's action with its gains replaced, ``[..., action]``."""
        action = self._policy.act(observation).clone()
        action[..., self._joints :] = self._share
        return action


def find_actor(
    name: str, task: Task, *, seed: int = 0, hold_gain: float = 6.0, gain_scale: float = 1.0, field: str = "policy"
) -> Actor:
    """A bundle or a baseline, checked against the task.

    Args:
        name: folder of a bundle, or hold, zero, random or stiff.
        hold_gain: P gain of the policy `hold` [A/rad].
        gain_scale: factor on the gain of the stiff walk's position loop; the environment scales all other gains.
        field: config field that contains the name, for messages.

    Raises:
        ValueError: if there is no such bundle, or it does not fit the task.
    """
    action_map = task.action_map()
    baselines: dict[str, Callable[[], Any]] = {
        "hold": lambda: Hold(action_map, hold_gain),
        "zero": lambda: Zero(action_map),
        "random": lambda: Random(action_map, seed),
        "stiff": lambda: StiffWalk(firmware_gain=gain_scale * POSITION_GAIN),
    }
    if name in baselines:
        if name == "stiff" and task.cycle is None:
            raise ValueError(f"{field}=stiff walks, but task {task.name} has no gait; give a walking task such as walk")
        return Actor(name, baselines[name](), action_map)
    bundle = PolicyBundle.load(name)
    task.check_policy(bundle.manifest, f"{field}={name}")
    return Actor(Path(name).name, bundle, bundle.manifest.action_map)


class Watched:
    """A policy that records the state of the first robot at every action.

    Args:
        policy: object with a method ``act`` and optionally ``commands``.
    """

    def __init__(self, policy: Any, env: BatchedEnv):
        self.policy, self.states = policy, []
        self._qpos = env.simulation.batch.bind("qpos")
        if hasattr(policy, "commands"):
            self.commands = policy.commands

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """The policy's action."""
        self.states.append(self._qpos[0].copy())
        return self.policy.act(observation)
