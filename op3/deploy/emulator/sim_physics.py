"""A robot described by a `model.yaml`, behind the bus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from op3.deploy.emulator.firmware import PERIOD, Drive
from op3.deploy.emulator.physics import Readings
from op3.deploy.emulator.power import Battery, Windings
from op3.robot import build_scene, pose
from op3.robot.scenes import Scene
from op3.servo import RobotModel, Signals, Stage
from op3.servo.effect import Prepared
from op3.servo.effects import Motor
from op3.sim import BatchSimulation, attach_servos, roll_pitch_yaw

Array = NDArray[np.float64]

_ELSEWHERE = (Stage.COMMAND, Stage.TRANSPORT, Stage.CONTROLLER)
"""Stages that the bus, its timing and the emulated firmware take the place of."""

SLOW_EVERY = 10
"""Battery and temperatures move on once in this many periods."""

IMU_EVERY = 5
"""The IMU's loop runs at 200 Hz: once in this many periods."""


@dataclass(frozen=True)
class ServoDrive(Motor):
    """The motor with the driver of a real servo: per joint off, regulating current, or applying a voltage.

    Its goals are tensors in ``signals.state``, which `SimPhysics` writes.
    """

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """No current is asked for."""
        for name in ("goal_current", "goal_duty", "by_voltage"):
            signals.state[name] = torch.zeros_like(signals.position)
        signals.state["bound"] = torch.full_like(signals.position, 1e3)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Voltage, current, torque, and the part of the torque that is linear in velocity."""
        state, resistance = signals.state, prepared["resistance"]
        back_emf = prepared["constant"] * signals.velocity
        reach = resistance * state["bound"]
        applied = state["goal_duty"] * signals.bus_voltage
        regulated = torch.addcmul(back_emf, resistance, state["goal_current"])
        driven = torch.where(state["by_voltage"] > 0, applied, regulated)
        within = torch.minimum(torch.maximum(driven, back_emf - reach), back_emf + reach)
        signals.voltage = torch.clamp(within, -signals.bus_voltage, signals.bus_voltage)
        signals.duty = signals.voltage / signals.bus_voltage * signals.torque_enable
        signals.current = (signals.voltage - back_emf) / resistance * signals.torque_enable
        signals.motor_torque = prepared["constant"] * signals.current
        signals.applied_torque = signals.motor_torque
        fixed = (state["by_voltage"] > 0) & (driven == within) | (signals.voltage.abs() >= signals.bus_voltage)
        signals.damping = torch.where(fixed, prepared["back_emf_damping"], 0.0) * signals.torque_enable


def without_commands(model: RobotModel) -> RobotModel:
    """A model as it stands behind the bus: without a PD and latency of its own, its motor driven by the firmware.

    Raises:
        ValueError: if the model's motor does not regulate current.
    """
    motor = model.effect("motor")
    if not isinstance(motor, Motor) or motor.drive != "current":
        raise ValueError(
            "the emulated servos regulate current, but this model's motor applies a voltage; give a model of the OP3's"
            " servos, with `motor: {drive: current}`"
        )
    gone = [effect.name for effect in model.effects if effect.stage in _ELSEWHERE]
    return model.without(*gone).with_effect(ServoDrive(gear_ratio=motor.gear_ratio))  # pyright: ignore[reportCallIssue]


@dataclass(frozen=True)
class ImuNoise:
    """Noise and filter of the IMU; values as the stand-in's defaults, seen at 200 Hz behind the filter.

    Attributes:
        gyro: standard deviation [rad/s].
        accelerometer: standard deviation [m/s^2].
        bandwidth: corner frequency of the low-pass [Hz].
    """

    gyro: float = 0.0015
    accelerometer: float = 0.02
    bandwidth: float = 45.0


class SimPhysics(BatchSimulation):
    """One simulated robot with the law and the parameters of a model.

    Args:
        model: of the OP3; see `op3.sim.load_model`.
        scene: a name that `op3.robot.build_scene` knows, or a scene without servos attached.
        seed: of the IMU's noise.
        joint_position: [joint] in rad at the start; by default the pose "stand", or zero on the bench.
        battery: where the servos' voltage comes from; None for a supply at the model's `bus_voltage`.
        windings: how the motors warm up.
        imu: noise and filter of the IMU.
    """

    def __init__(
        self,
        model: RobotModel,
        scene: str | Scene = "floor",
        *,
        seed: int = 0,
        joint_position: ArrayLike | None = None,
        battery: Battery | None = None,
        windings: Windings | None = None,
        imu: ImuNoise | None = None,
    ):
        self.scene = build_scene(scene) if isinstance(scene, str) else scene
        attach_servos(self.scene.joints)
        self.joints = tuple(str(joint.name) for joint in self.scene.joints)
        robot = self.scene.robot
        super().__init__(
            self.scene.compile(),
            self.scene.joint_names,
            without_commands(model),
            1,
            control_period=PERIOD,
            base_body=None if robot is None else robot.trunk.full_identifier,
            joint_names=self.joints,
            num_threads=1,
        )
        self.battery, self._windings = battery, windings or Windings()
        self.supply: float | None = None
        count = len(self.joints)
        self._temperature = self._windings.start(count)
        self._imu_noise = imu or ImuNoise()
        self._rng = np.random.default_rng([seed, 5])
        self._blend = 1 - np.exp(-2 * np.pi * self._imu_noise.bandwidth * PERIOD * IMU_EVERY)
        self._steps = 0
        if joint_position is None:
            joint_position = np.zeros(count) if robot is None else pose("stand")
        self.reset(self.scene.initial_qpos(joint_position), {"torque_enable": torch.zeros(1, count)})
        self.law.sense(self.signals)
        self._voltage = self.model.bus_voltage if battery is None else battery.voltage
        self._find_imu()

    def _find_imu(self) -> None:
        robot = self.scene.robot
        self._attitude = None
        if robot is None:
            return
        views = []
        for element in (robot.imu_orientation, robot.imu_gyro, robot.imu_accelerometer):
            sensor = self.batch.model.sensor(element.full_identifier)
            first, width = int(sensor.adr[0]), int(sensor.dim[0])
            views.append(self._sensors[0, first : first + width].numpy())
        self._attitude, self._rates, self._force = views
        if not self.scene.floating:
            # MuJoCo's accelerometer reads zero on a body that cannot move.
            self._force = np.asarray(self.scene.mounted_specific_force)
        self._felt = np.concatenate([self._rates, self._force])
        if self.scene.floating:
            self._felt[3:] = 0.0, 0.0, 9.80665
        self._latch_imu()

    def _latch_imu(self) -> None:
        noise = self._imu_noise
        new = np.concatenate([self._rates, self._force]) + self._rng.standard_normal(6) * np.repeat(
            [noise.gyro, noise.accelerometer], 3
        )
        self._felt += self._blend * (new - self._felt)
        self._imu = roll_pitch_yaw(torch.from_numpy(np.array(self._attitude))).numpy(), self._felt.copy()

    @property
    def position(self) -> Array:
        """Joint angles as the encoders see them [joint] in rad."""
        return self.signals.measured_position[0].numpy()

    @property
    def velocity(self) -> Array:
        """Joint velocities [joint] in rad/s."""
        return self.signals.measured_velocity[0].numpy()

    def drive(self, drive: Drive) -> None:
        """What the drivers do from now on; joints that are not enabled run free, with friction alone."""
        state = self.signals.state
        self.signals.torque_enable = torch.from_numpy(drive.enabled.astype(float))[None]
        state["goal_current"] = torch.from_numpy(drive.current.copy())[None]
        state["goal_duty"] = torch.from_numpy(drive.duty.copy())[None]
        state["by_voltage"] = torch.from_numpy(drive.voltage.astype(float))[None]
        state["bound"] = torch.from_numpy(np.minimum(drive.limit, 1e3))[None]

    def advance(self, steps: int = 1) -> None:
        """Let a number of periods pass.

        Raises:
            RuntimeError: if the physics diverges.
        """
        for _ in range(steps):
            super().advance()
            self._steps += 1
            if self._attitude is not None and self._steps % IMU_EVERY == 0:
                self._latch_imu()
            if self._steps % SLOW_EVERY == 0:
                self._step_slow()
        self._read()
        self.law.sense(self.signals)
        if bool(self.failed[0]):
            raise RuntimeError(f"the simulated robot's physics diverged at {self._steps * PERIOD:.3f} s")

    def _step_slow(self) -> None:
        signals, duration = self.signals, SLOW_EVERY * PERIOD
        current = signals.current[0].numpy()
        if self.battery is not None:
            self.battery.step(float((signals.voltage[0].numpy() * current).sum()), duration)
            self._voltage = self.battery.voltage
        if self.supply is not None:
            self._voltage = self.supply
        elif self.battery is None:
            self._voltage = self.model.bus_voltage
        signals.bus_voltage = torch.full_like(signals.position, self._voltage)
        resistance = self.parameters["terminal_resistance"][0].numpy()
        self._windings.step(self._temperature, resistance * current**2, duration)

    def read(self) -> Readings:
        """What all sensors say now."""
        signals = self.signals
        count = len(self.joints)
        orientation, rates, force = None, None, None
        if self._attitude is not None:
            orientation, felt = self._imu
            rates, force = felt[:3], felt[3:]
        return Readings(
            position=self.position,
            velocity=self.velocity,
            current=signals.current[0].numpy(),
            duty=signals.duty[0].numpy(),
            voltage=np.full(count, self._voltage),
            temperature=self._temperature,
            orientation=orientation,
            angular_velocity=rates,
            linear_acceleration=force,
        )
