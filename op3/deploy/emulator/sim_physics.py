"""A robot described by a `model.yaml`, behind the bus."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from op3.deploy.emulator.physics import PERIOD
from op3.robot import RobotEntity
from op3.robot.kinematics import roll_pitch_yaw
from op3.robot.register_units import GRAVITY
from op3.scenes import BoardMotion, WeightSchedule, board_drive, place_tiles, tile_ids
from op3.scenes.scene import Scene
from op3.servo import RobotModel, Stage, Trunk
from op3.servo.effects import Motor
from op3.sim import BatchSimulation, attach_servos
from op3.stand_in.sensors import Sensors

Array = NDArray[np.float64]

SLOW_EVERY = 10
"""Periods between updates of temperatures and checks for divergence."""

GROUND_EVERY = 8
"""Periods between updates of a board's motion, as in the environments."""

AMBIENT = 28.0
"""Temperature of the air [C]."""

WARMING = 240.0
"""Thermal time constant of a motor with a single heat capacity, heated by current losses [s] (inferred)."""

GYRO_NOISE, ACCELEROMETER_NOISE = 0.0015, 0.02
"""Standard deviations of readings [rad/s, m/s^2], similar to the stand-in's."""

IMU_BANDWIDTH = 45.0
"""Corner frequency of the IMU's low-pass [Hz]."""

IMU_EVERY = 5
"""Number of periods per update of the IMU, which runs at 200 Hz."""


BUS_EFFECTS = ("latency", "packet_drop")
"""Effects that the emulated bus produces itself."""


def behind_bus(model: RobotModel) -> RobotModel:
    """The model behind the bus: without PD loop and delays, and with a motor driven by current.

    Raises:
        ValueError: if the model's motor does not regulate current.
    """
    motor = model.effect("motor")
    if not isinstance(motor, Motor) or motor.drive != "current":
        raise ValueError(
            "the emulated servos regulate current, but this model's motor applies a voltage; give a model of servos"
            " with `motor: {drive: current}`"
        )
    gone = [e.name for e in model.effects if e.stage in (Stage.COMMAND, Stage.CONTROLLER) or e.name in BUS_EFFECTS]
    return model.without(*gone)


class SimPhysics(BatchSimulation):
    """One simulated robot with the law and the parameters of a model.

    Args:
        model: model of the robot; see `op3.sim.load_model`.
        scene: scene without servos attached.
        joint_position: [joint] in rad at the start; by default home.

    Attributes:
        supply: voltage of the servos' supply [V]; None: the model's `bus_voltage`.
    """

    def __init__(
        self,
        model: RobotModel,
        scene: Scene,
        *,
        seed: int = 0,
        joint_position: ArrayLike | None = None,
    ):
        self.scene = scene
        attach_servos(self.scene.joints)
        self.known, robot = self.scene.robot_file, self.scene.robot
        super().__init__(
            self.scene.compile(visual=False),
            self.scene.joint_names,
            behind_bus(model),
            1,
            control_period=PERIOD,
            base_body=None if robot is None else robot.trunk.full_identifier,
            joint_names=self.known.joints,
            num_threads=1,
        )
        self._thermal_resistance = np.array([make.thermal_resistance for make in self.known.servos])
        self.supply: float | None = None
        count = len(self.known.joints)
        self._temperature = np.full(count, AMBIENT)
        self._imu_spread = np.repeat([GYRO_NOISE, ACCELEROMETER_NOISE], 3)
        self._rng = np.random.default_rng([seed, 5])
        self._blend = 1 - np.exp(-2 * np.pi * IMU_BANDWIDTH * PERIOD * IMU_EVERY)
        self._steps = self._board_since = 0
        self._board_drive: Any = None
        self._data = mujoco.MjData(self.batch.model)
        if joint_position is None:
            joint_position = self.known.home
        self.reset(self.scene.initial_qpos(joint_position), {"torque_enable": torch.zeros(1, count)})
        self.law.sense()
        self._resistance = self.parameters["terminal_resistance"][0].numpy()
        self._step_slow()
        self._attitude = None
        if robot is not None and self.known.file.imu is not None:
            self._find_imu(robot)

    def _find_imu(self, robot: RobotEntity) -> None:
        views = []
        for element in robot.imu_sensors:
            sensor = self.batch.model.sensor(element.full_identifier)
            first, width = int(sensor.adr[0]), int(sensor.dim[0])
            views.append(self._sensors[0, first : first + width].numpy())
        self._attitude, self._rates, self._force = views
        if not self.scene.floating:
            # MuJoCo's accelerometer reads zero on a body that cannot move.
            self._force = np.asarray(self.scene.mounted_specific_force)
        self._felt = np.concatenate([self._rates, self._force])
        if self.scene.floating:
            self._felt[3:] = 0.0, 0.0, GRAVITY
        self._latch_imu(self._attitude)

    def _latch_imu(self, attitude: Array) -> None:
        self._felt += self._blend * (np.concatenate([self._rates, self._force]) - self._felt)
        self._imu = attitude.copy(), self._felt + self._imu_spread * self._rng.standard_normal(6)

    @property
    def position(self) -> Array:
        """See `Physics`."""
        return self.signals.measured_position[0].numpy()

    def drive(self, enabled: NDArray[np.bool_], current: Array) -> None:
        """See `Physics`; a motor that does not regulate current runs freely."""
        row = self.law.records[0]
        row["torque_enable"], row["target_current"] = enabled, current * enabled

    def advance(self, duration: float = PERIOD) -> None:
        """Simulate whole periods [s]; a divergence is detected within `SLOW_EVERY` of them."""
        for _ in range(round(duration / PERIOD)):
            if self._board_drive is not None and (self._steps - self._board_since) % GROUND_EVERY == 0:
                time = np.array([(self._steps - self._board_since) * PERIOD])
                forces = self.batch.bind("qfrc_applied")
                self._board_drive.apply(self._board, time, self._qpos.numpy(), self._qvel.numpy(), forces)
            super().advance()
            self._steps += 1
            if self._attitude is not None and self._steps % IMU_EVERY == 0:
                self._latch_imu(self._attitude)
            if self._steps % SLOW_EVERY == 0:
                if bool(self.failed[0]):
                    raise RuntimeError(f"the simulated robot's physics diverged at {self._steps * PERIOD:.3f} s")
                self._step_slow()
        self._read()
        self.law.report()

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """See `Physics`."""
        model = self.batch.model
        self._board_drive = None if board is None else board_drive(model, board, GROUND_EVERY * PERIOD)
        self._board, self._board_since = board, self._steps
        if tiles is not None:
            place_tiles(self.batch.expand("geom_pos"), tile_ids(model), np.asarray(tiles, dtype=float)[None])

    def foremost(self) -> float:
        """See `Physics`."""
        self._data.qpos[:] = self._qpos[0].numpy()
        mujoco.mj_kinematics(self.batch.model, self._data)
        return self.scene.foremost(self._data)

    def _step_slow(self) -> None:
        rise = self._thermal_resistance * self._resistance * self.signals.current[0].numpy() ** 2
        self._temperature += SLOW_EVERY * PERIOD / WARMING * (AMBIENT + rise - self._temperature)
        self._voltage = (self.model.bus_voltage if self.supply is None else self.supply) * self.known.supply_shares
        self.signals.bus_voltage = torch.from_numpy(self._voltage)
        self.signals.temperature = torch.from_numpy(self._temperature)

    def read(self) -> Sensors:
        """See `Physics`."""
        orientation, rates, force = None, None, None
        if self._attitude is not None:
            quaternion, felt = self._imu
            rates, force = felt[:3], felt[3:]
            seen = self.law.sense_trunk(Trunk(torch.from_numpy(quaternion)[None], torch.from_numpy(rates)[None]))
            quaternion, rates = seen.quaternion[0].numpy(), seen.angular_velocity[0].numpy()
            orientation = roll_pitch_yaw(quaternion)
        return Sensors(
            position=self.position.copy(),
            velocity=self.signals.measured_velocity[0].numpy().copy(),
            current=self.signals.measured_current[0].numpy().copy(),
            voltage=self._voltage.copy(),
            temperature=self._temperature.copy(),
            orientation=orientation,
            angular_velocity=rates,
            linear_acceleration=force,
        )
