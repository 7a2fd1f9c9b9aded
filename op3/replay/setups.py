"""The scene of a log, by its mount, ready for many simulations at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from op3.common.settings import CONTROL_PERIOD
from op3.robot import Robot, load_robot
from op3.rollout import LogError, Rollout
from op3.scenes import build_bench, build_scene
from op3.scenes.scene import Scene
from op3.servo import RobotModel
from op3.sim import BatchSimulation, PendulumSimulation, attach_servos

BENCH_CONTROL_PERIOD = 0.001
"""Period of a servo's internal position loop in simulation [s]."""


@dataclass(frozen=True, eq=False)
class Setup:
    """A scene with servos, compiled.

    Attributes:
        scene: the scene.
        mj_model: its compiled model.
        joints: joint names as in logs.
        base_body: full name of the robot's base; None if its file names none, and on the bench.
        control_period: time between commands [s].
    """

    scene: Scene
    mj_model: mujoco.MjModel
    joints: tuple[str, ...]
    base_body: str | None
    control_period: float

    @classmethod
    def of_mount(
        cls,
        mount: str,
        bench_timestep: float = BENCH_CONTROL_PERIOD,
        tilt: tuple[float, float] = (0.0, 0.0),
        joints: Sequence[str] | None = None,
        control_period: float = CONTROL_PERIOD,
        *,
        robot: str | Robot,
    ) -> "Setup":
        """The setup for logs of this mount.

        Args:
            mount: ``floor``, ``stand``, ``pendulum`` or a brick surface.
            bench_timestep: simulation step of a pendulum, and cycle of its servo's position loop [s].
            tilt: roll and pitch of the stand [rad].
            joints: joints of the logs; on the stand, other limbs are omitted. None: all joints.
            control_period: time between commands to a robot [s]; the simulation step is at most 1 ms and divides it.
            robot: robot of the logs, or its file.

        Raises:
            ValueError: for a ground that the log does not determine, such as a moving board.
        """
        if mount in ("board", "board_weight", "terrain"):
            raise ValueError(f"a log of the mount {mount!r} cannot be replayed: its ground is not in the log")
        known = load_robot(robot)
        limbs = joints if mount == "stand" and set(joints or ()) & set(known.joints) else None
        if mount == "pendulum":
            scene = build_bench()
        else:
            scene = build_scene(mount, tilt_roll=tilt[0], tilt_pitch=tilt[1], joints=limbs, robot=known)
        attach_servos(scene.joints)
        entity, mj_model = scene.robot, scene.compile(visual=False)
        if entity is not None:
            steps = np.ceil(control_period / mj_model.opt.timestep - 1e-6)
            mj_model.opt.timestep = control_period / steps
        return cls(
            scene=scene,
            mj_model=mj_model,
            joints=tuple(joint.name for joint in scene.joints),
            base_body=None if entity is None or known.file.base is None else entity.trunk.full_identifier,
            control_period=bench_timestep if entity is None else control_period,
        )

    @property
    def pendulum(self) -> bool:
        """Whether this is the bench, whose pendulums are stepped in closed form."""
        return self.scene.robot is None

    def simulation(
        self, model: RobotModel, logs: Sequence[Rollout], candidates: int, num_threads: int = 0
    ) -> BatchSimulation | PendulumSimulation:
        """A simulation for every candidate and log; simulation ``c * len(logs) + l`` is candidate c on log l.

        Args:
            num_threads: threads that step the physics of a robot; 0 for all processors.

        Raises:
            LogError: if a log has other joints than the scene.
        """
        for log in logs:
            if log.joints != self.joints:
                raise LogError(
                    f"the log's joints are {', '.join(log.joints)}, the scene's {', '.join(self.joints)}",
                    "write the joints in the scene's order",
                    source=log.metadata.recording,
                    column="joints",
                )
        if self.pendulum:
            mass, length = zip(*((log.metadata.mass, log.metadata.length) for log in logs), strict=True)
            return PendulumSimulation(
                model,
                torch.tensor(mass, dtype=torch.float64).repeat(candidates),
                torch.tensor(length, dtype=torch.float64).repeat(candidates),
                timestep=self.control_period,
            )
        return BatchSimulation(
            self.mj_model,
            self.scene.joint_names,
            model,
            candidates * len(logs),
            control_period=self.control_period,
            base_body=self.base_body,
            joint_names=self.joints,
            num_threads=num_threads,
        )

    def initial_qpos(self, log: Rollout) -> np.ndarray:
        """Full position at the first row; a free robot stands on its soles, level if the log has no orientation."""
        position = log.array("joint/position")[0]
        if not self.scene.floating:
            return self.scene.initial_qpos(position)
        roll, pitch = log.array("imu/orientation")[0, :2] if "imu/orientation" in log else (None, None)
        return self.scene.initial_qpos(position, roll, pitch)
