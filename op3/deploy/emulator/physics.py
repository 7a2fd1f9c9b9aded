"""The robot behind the bus: what it takes to stand there, and the stand-in robot in that place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.deploy.emulator.firmware import PERIOD, Drive
from op3.robot import GEAR_RATIO, BoardMotion, WeightSchedule, pose
from op3.robot.scenes import Scene
from op3.stand_in import StandIn, World

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Readings:
    """What the sensors feel, in SI units; the registers round it.

    Attributes:
        position: [joint] in rad.
        velocity: [joint] in rad/s.
        current: [joint] in A.
        duty: [joint] of the drivers, -1 to 1.
        voltage: [joint] in V.
        temperature: [joint] in C.
        orientation: roll, pitch, yaw of the trunk [rad]; None without an IMU.
        angular_velocity: [xyz] in rad/s in the trunk's axes; None without an IMU.
        linear_acceleration: [xyz] specific force in m/s^2 in the trunk's axes; None without an IMU.
    """

    position: Array
    velocity: Array
    current: Array
    duty: Array
    voltage: Array
    temperature: Array
    orientation: Array | None = None
    angular_velocity: Array | None = None
    linear_acceleration: Array | None = None


class Physics(Protocol):
    """A robot without its electronics. Time goes in steps of `op3.deploy.emulator.firmware.PERIOD`.

    Attributes:
        joints: names of the joints, in the order of every [joint] array.
        supply: voltage of the supply [V], where it is not the robot's own battery.
    """

    joints: tuple[str, ...]
    supply: float | None

    @property
    def position(self) -> Array:
        """Joint angles as the encoders see them [joint] in rad."""
        ...

    @property
    def velocity(self) -> Array:
        """Joint velocities [joint] in rad/s."""
        ...

    def drive(self, drive: Drive) -> None:
        """What the drivers do from now on; joints that are not enabled run free, with friction alone."""
        ...

    def advance(self, steps: int) -> None:
        """Let a number of periods pass.

        Raises:
            RuntimeError: if the physics diverges.
        """
        ...

    def read(self) -> Readings:
        """What all sensors say now."""
        ...

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """What the ground does from now on; its time counts from this call.

        Args:
            board: what moves the board of the scene; None: nothing does.
            tiles: heights of the tiles of the scene "terrain" [m]; None: as they are.

        Raises:
            ValueError: if the scene has no such board.
        """
        ...

    def foremost(self) -> float:
        """How far ahead the inner tip of the foremost foot is in the world [m]; 0 without a robot."""
        ...


class StandInPhysics:
    """A stand-in robot, whose truth is hidden, behind the bus. It has its own battery, temperatures and IMU.

    Drivers that apply a voltage become goal currents once per period, from the world's own motor. The stand-in's
    own current loop, with its lag and offset, stays in the way, so a free joint carries the offset of its current
    sensor, some mA.

    Args:
        world: the truth.
        scene: a name that `op3.robot.build_scene` knows, or a scene.
        seed: of the sensors' noise and the servos' state.
        joint_position: [joint] in rad at the start; by default the pose "stand", or zero on the bench.
    """

    def __init__(
        self,
        world: World | None = None,
        scene: str | Scene = "floor",
        *,
        seed: int = 0,
        joint_position: ArrayLike | None = None,
    ):
        self.robot = StandIn(world or World(), scene, seed=seed)
        self.joints = self.robot.joints
        self.supply: float | None = None
        count = len(self.joints)
        start = (
            (pose("stand") if self.robot.scene.robot is not None else np.zeros(count))
            if joint_position is None
            else joint_position
        )
        self.robot.reset(start)
        truth = self.robot.truth()
        self._constant = GEAR_RATIO * np.broadcast_to(np.asarray(truth["torque_constant"], dtype=float), count)
        self._resistance = np.asarray(truth["terminal_resistance"], dtype=float)
        self._drive: Drive | None = None
        self._goal = np.zeros(count)
        self._sensed()

    def _sensed(self) -> None:
        self._sensors = self.robot.read_sensors()

    @property
    def position(self) -> Array:
        """Joint angles as the encoders see them [joint] in rad."""
        return self._sensors.position

    @property
    def velocity(self) -> Array:
        """Joint velocities [joint] in rad/s."""
        return self._sensors.velocity

    def drive(self, drive: Drive) -> None:
        """What the drivers do from now on."""
        self._drive = drive
        self._write()

    def _write(self) -> None:
        drive = self._drive
        if drive is None:
            return
        goal = np.where(drive.enabled, drive.current, 0.0)
        driven = drive.enabled & drive.voltage
        if driven.any() or self.supply is not None:
            supply = self._sensors.voltage if self.supply is None else self.supply
            back_emf = self._constant * self._sensors.velocity
            wanted = (drive.duty * supply - back_emf) / self._resistance
            goal = np.where(driven, np.clip(wanted, -drive.limit, drive.limit), goal)
            reach = (supply - back_emf) / self._resistance, (-supply - back_emf) / self._resistance
            goal = np.where(drive.enabled, np.clip(goal, np.minimum(*reach), np.maximum(*reach)), 0.0)
        self._goal = goal
        self.robot.write_current(goal)

    def advance(self, steps: int) -> None:
        """Let a number of periods pass."""
        if self._drive is not None and ((self._drive.enabled & self._drive.voltage).any() or self.supply is not None):
            for _ in range(steps):
                self._write()
                self.robot.advance(PERIOD)
                self._sensed()
        else:
            self.robot.advance(steps * PERIOD)
            self._sensed()

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """What the ground does from now on."""
        self.robot.set_ground(board, tiles)

    def foremost(self) -> float:
        """How far ahead the inner tip of the foremost foot is in the world [m]; 0 without a robot."""
        return self.robot.foremost()

    def read(self) -> Readings:
        """What all sensors say now."""
        sensors = self._sensors
        voltage = sensors.voltage if self.supply is None else np.full(len(self.joints), self.supply)
        applied = self._resistance * sensors.current + self._constant * sensors.velocity
        return Readings(
            position=sensors.position,
            velocity=sensors.velocity,
            current=sensors.current,
            duty=np.clip(applied / voltage, -1, 1),
            voltage=voltage,
            temperature=sensors.temperature,
            orientation=sensors.orientation,
            angular_velocity=sensors.angular_velocity,
            linear_acceleration=sensors.linear_acceleration,
        )
