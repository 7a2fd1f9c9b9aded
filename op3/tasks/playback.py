"""Composer tasks that play a motion: the squat on the floor or in the stand, and the pendulum on the bench."""

from typing import Any

import dm_env
import numpy as np
import torch
from dm_control import composer
from dm_env import specs

from op3.robot import Motion, build_bench, build_scene
from op3.robot.scenes import Scene
from op3.rollout import Metadata, Rollout
from op3.servo import RobotModel
from op3.sim import GearedServo, model_hash
from op3.tasks.setups import BENCH_CONTROL_PERIOD, OP3_CONTROL_PERIOD

PHYSICS_TIMESTEP = 0.001
"""Step of the physics [s]; paper, 1 ms."""


class Playback(composer.Task):
    """Servos follow a motion; the task commands itself and its action is empty.

    Build one with `squat_task` or `bench_task`, and an environment with `playback_environment`, which steps the
    physics in the order that the batched simulation uses.

    Args:
        scene: where it happens; its joints get servos.
        model: effects and parameter values.
        motion: targets; its joints are the scene's, in order.
        control_period: time between ticks [s].
        settle: time before the log starts in which the first target is held [s].
        pendulum: mass [kg] and length [m], for the log of a bench.
        commands: gains and other held commands, as `op3.servo.Signals` names them.
    """

    def __init__(
        self,
        scene: Scene,
        model: RobotModel,
        motion: Motion,
        control_period: float,
        *,
        settle: float = 1.0,
        pendulum: tuple[float, float] | tuple[None, None] = (None, None),
        **commands: float,
    ):
        self._scene = scene
        self._motion = motion
        self._held = commands
        self._metadata = Metadata(
            joints=tuple(joint.name for joint in scene.joints),
            robot="simulated",
            mount=scene.mount,
            rate=1.0 / control_period,
            motion=motion.name,
            model_hash=model_hash(model),
            battery=model.bus_voltage,
            mass=pendulum[0],
            length=pendulum[1],
            firmware_gain=commands.get("firmware_gain"),
        )
        trunk = None if scene.robot is None else scene.robot.trunk
        here = model.under(vars(self._metadata))
        self.servo = GearedServo(scene.joints, here, base_body=trunk, control_period=control_period)
        self._settle = round(settle / control_period)
        self._ticks = 0
        self._rows: list[dict[Any, torch.Tensor]] = []
        self.set_timesteps(control_timestep=control_period, physics_timestep=PHYSICS_TIMESTEP)

    @property
    def root_entity(self) -> composer.Entity:
        """The arena."""
        return self._scene.arena

    def action_spec(self, physics: Any) -> specs.BoundedArray:
        """Nothing is left to command."""
        del physics
        return specs.BoundedArray((0,), np.float64, minimum=0.0, maximum=0.0)

    def after_compile(self, physics: Any, random_state: Any) -> None:
        """Find the servos."""
        self.servo.after_compile(physics)

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Put the robot into the motion's first pose."""
        physics.data.qpos[:] = self._scene.initial_qpos(self._motion.position[0])
        physics.data.qvel[:] = 0.0
        self._rows, self._ticks = [], 0
        self.servo.initialize_episode(physics, position_target=self._motion.position[0], **self._held)

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
        """Log a row, then command the next target."""
        del action
        row = max(0, self._ticks - self._settle)
        target = self._motion.position[row]
        if self._ticks >= self._settle:
            self._rows.append(self._row(physics, row, target))
        self._ticks += 1
        self.servo.before_step(physics, position_target=target)

    def _row(self, physics: Any, row: int, target: np.ndarray) -> dict[Any, torch.Tensor]:
        held = {("command", name): value for name, value in self._held.items() if name != "bus_voltage"}
        channels: dict[Any, Any] = {
            **self.servo.measure(physics),
            **{key: np.full(len(target), value) for key, value in held.items()},
            ("command", "position"): target,
            "time": [row * self.control_timestep],
        }
        return {key: torch.as_tensor(value, dtype=torch.float64) for key, value in channels.items()}

    def before_substep(self, physics: Any, action: Any, random_state: Any) -> None:
        """Run the servo law."""
        del action
        self.servo.before_substep(physics)

    def get_reward(self, physics: Any) -> float:
        """A motion has no reward."""
        del physics
        return 0.0

    def should_terminate_episode(self, physics: Any) -> bool:
        """Whether the motion is over."""
        del physics
        return len(self._rows) >= len(self._motion.time)

    def rollout(self) -> Rollout:
        """The log of the episode so far."""
        arrays = {key: torch.stack([row[key] for row in self._rows]) for key in self._rows[0]}
        return Rollout.from_arrays(arrays, self._metadata)


def squat_task(
    model: RobotModel,
    motion: Motion,
    mount: str = "floor",
    p_gain: float = 6.0,
    d_gain: float = 0.1,
    settle: float = 1.0,
) -> Playback:
    """The OP3 follows a motion on the ``floor`` or in the ``stand``, with fixed gains [A/rad, A s/rad]."""
    return Playback(build_scene(mount), model, motion, OP3_CONTROL_PERIOD, settle=settle, p_gain=p_gain, d_gain=d_gain)


def bench_task(
    model: RobotModel, motion: Motion, mass: float, length: float, settle: float = 0.0, **commands: float
) -> Playback:
    """One servo swings a pendulum of this mass [kg] and length [m].

    Args:
        model: of a current-driven servo (commands ``p_gain``, ``d_gain``) or of a position servo (command
            ``firmware_gain``).
        motion: targets of the joint ``servo``, sampled every `BENCH_CONTROL_PERIOD`.
        mass: of the weight [kg].
        length: from the shaft to the weight [m].
        settle: time before the log starts in which the first target is held [s].
        **commands: held commands.
    """
    return Playback(
        build_bench(mass, length),
        model,
        motion,
        BENCH_CONTROL_PERIOD,
        settle=settle,
        pendulum=(mass, length),
        **commands,
    )


def playback_environment(task: Playback, seed: int = 0) -> composer.Environment:
    """A composer environment whose steps are those of ``mj_step`` with the servo law before each."""
    return composer.Environment(task, random_state=np.random.RandomState(seed), legacy_step=False)


def play(task: Playback) -> Rollout:
    """Run a playback to its end and return its log."""
    environment = playback_environment(task)
    timestep = environment.reset()
    while timestep.step_type != dm_env.StepType.LAST:
        timestep = environment.step(np.zeros(0))
    return task.rollout()
