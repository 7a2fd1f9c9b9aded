"""Episodes as logs: sensor readings at 125 Hz, and the policy's observations, actions and rewards."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from op3.common.settings import CONTROL_PERIOD
from op3.envs.batched import BatchedEnv
from op3.rollout import Metadata, Rollout
from op3.sim import model_hash
from op3.tasks.snapshot import Snapshot
from op3.tasks.task import TICKS

Policy = Callable[[Tensor], Tensor]
"""Maps observations ``[robot, observation]`` to actions ``[robot, action]``."""


class _Tape:
    """Channels of all robots by tick; policy channels are filled in at the end of each policy step."""

    def __init__(self, env: BatchedEnv):
        self._env = env
        self.ticks: list[dict[Any, Tensor]] = []
        self.tips: list[Tensor] = []

    def on_tick(self, tick: int) -> None:
        """Log the current sensor readings, and the commands that follow them."""
        env, signals = self._env, self._env.simulation.signals
        snapshot: Snapshot = env.snapshot()
        if snapshot.tip is not None:
            self.tips.append(snapshot.tip)
        readings = snapshot.readings
        row = {
            ("joint", "position"): readings["joint_position"],
            ("joint", "velocity"): readings["joint_velocity"],
            ("joint", "current"): snapshot.current,
            ("imu", "orientation"): readings["orientation"],
            ("imu", "angular_velocity"): readings["angular_velocity"],
            ("imu", "linear_acceleration"): snapshot.specific_force,
            ("command", "position"): signals.position_target,
            ("command", "p_gain"): signals.p_gain,
            ("command", "d_gain"): signals.d_gain,
        }
        if env.commander is not None or all(servo.loop == "firmware" for servo in env.mdp.robot.servos):
            del row["command", "p_gain"], row["command", "d_gain"]
            row["command", "firmware_gain"] = signals.firmware_gain
        self.ticks.append({key: value.clone() for key, value in row.items()})

    def fill(self, observation: Tensor, action: Tensor, reward: Tensor) -> None:
        """Add observation, action and reward of the policy to the ticks of the last step."""
        if self._env.commander is not None:  # its commands converted to actions with the highest gain
            made = self._env.action_map
            legs = self._env.mdp.robot.indices(made.joints)
            target = self.ticks[-TICKS]["command", "position"][:, legs]
            action = made.action(target, torch.full_like(target, made.gain_high or 0.0))
        for row in self.ticks[-TICKS:]:
            row["policy", "observation"] = observation.double()
            row["policy", "action"] = action.double()
            row["policy", "reward"] = reward.double()


def record_episodes(
    env: BatchedEnv, policy: Policy | Any, episodes: int | None = None, recording: str | None = None
) -> list[Rollout]:
    """Record episodes with all robots in parallel until the requested number is reached.

    Args:
        policy: a function from observations to actions, or an object with such a method ``act``, like a policy bundle.
            With a method ``commands`` of time it commands the servos directly, like `op3.tasks.StiffWalk`.
        episodes: number of episodes; None: one per robot.
        recording: name of the recordings, to which the episode number is appended.

    Returns:
        Logs at 125 Hz with the schema of `op3.rollout`; the metadata hold task, seed of the episode, travelled
        distance (walking), duration and whether the robot fell.
    """
    wanted = env.num_envs if episodes is None else episodes
    logs: list[Rollout] = []
    act: Policy = getattr(policy, "act", policy)
    env.commander = policy if hasattr(policy, "commands") else None
    while len(logs) < wanted:
        logs += _record_once(env, act, recording, len(logs))[: wanted - len(logs)]
    return logs


def _record_once(env: BatchedEnv, act: Policy, recording: str | None, first: int) -> list[Rollout]:
    tape = _Tape(env)
    state: TensorDictBase = env.reset()
    start = env.snapshot().tip
    length = torch.zeros(env.num_envs, dtype=torch.int64)
    fallen = torch.zeros(env.num_envs, dtype=torch.bool)
    running = torch.ones(env.num_envs, dtype=torch.bool)
    success = torch.zeros(env.num_envs, dtype=torch.bool)
    env.on_tick = tape.on_tick
    try:
        while running.any():
            observation = state["observation"]
            state["action"] = act(observation).to(torch.float32).clamp(-1.0, 1.0)
            after = env.step(state)["next"]
            tape.fill(observation, state["action"], after["reward"])
            length += running * TICKS
            fallen |= running & after["terminated"][:, 0]
            success = torch.where(running, after["measure", "success"][:, 0] > 0, success)
            running &= ~after["done"][:, 0]
            state = after.exclude("reward")
    finally:
        env.on_tick = None
    tips = torch.stack([*tape.tips, _last_tip(env)]) if start is not None else None
    travelled = None if tips is None or start is None else tips - start
    return [
        _log(env, tape, i, int(length[i]), fallen[i], success[i], travelled, recording and f"{recording}/{first + i}")
        for i in range(env.num_envs)
    ]


def _last_tip(env: BatchedEnv) -> Tensor:
    tip = env.snapshot().tip
    assert tip is not None
    return tip


def _log(
    env: BatchedEnv,
    tape: _Tape,
    robot: int,
    rows: int,
    fallen: Tensor,
    success: Tensor,
    travelled: Tensor | None,
    recording: str | None,
) -> Rollout:
    arrays: dict[Any, Tensor] = {
        key: torch.stack([row[key][robot] for row in tape.ticks[:rows]]) for key in tape.ticks[0]
    }
    arrays["time"] = torch.arange(rows, dtype=torch.float64)[:, None] * CONTROL_PERIOD
    arrays["done"] = torch.arange(rows)[:, None] == rows - 1
    drawn = {name: float(values[robot]) for name, values in env.parameters_drawn.items()}
    extra: Mapping[str, Any] = {"task": env.task.name, "success": bool(success)}
    extra = {**extra, **({"parameters": drawn} if drawn else {})}
    metadata = Metadata(
        joints=env.mdp.robot.joints,
        robot="simulated",
        robot_file=env.mdp.robot.reference,
        mount=env.scene.mount,
        rate=1.0 / CONTROL_PERIOD,
        policy_rate=1.0 / env.policy_period,
        battery=env.model.bus_voltage,
        motion=env.task.name,
        recording=recording,
        model_hash=model_hash(env.model),
        seed=int(env.episode_seeds[robot]),
        # largest forward position of a foot's inner tip
        travelled_distance=None if travelled is None else float(travelled[: rows + 1, robot].max()),
        episode_duration=rows * CONTROL_PERIOD,
        fallen=bool(fallen),
        extra=dict(extra),
    )
    return Rollout.from_arrays(arrays, metadata)
