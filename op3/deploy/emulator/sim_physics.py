"""A robot described by a `model.yaml`, behind the bus."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from op3.deploy.emulator.firmware import PERIOD, Drive
from op3.deploy.emulator.physics import Readings
from op3.deploy.emulator.power import Battery, Windings
from op3.deploy.emulator.sim_drive import UNBOUNDED, behind_bus
from op3.robot import (
    BoardDrive,
    BoardMotion,
    WeightDrive,
    WeightSchedule,
    board_drive,
    build_scene,
    place_tiles,
    pose,
    tile_ids,
)
from op3.robot.scenes import Scene
from op3.robot.units import GRAVITY
from op3.servo import Effect, RobotModel, Signals, Stage, Trunk
from op3.servo.compiled_step import CompiledStep
from op3.servo.recording import Untranslatable
from op3.sim import BatchSimulation, attach_servos
from op3.sim.translated import HANDED_OVER
from op3.stand_in.sensors import roll_pitch_yaw

Array = NDArray[np.float64]

FLOWS = ("current", "duty", "voltage")
"""What the law says of the motors, of which the servos report."""

SLOW_EVERY = 10
"""Battery and temperatures move on, and divergence is looked for, once in this many periods."""

GROUND_EVERY = 8
"""A board is driven once in this many periods, as in the environments."""

IMU_EVERY = 5
"""The IMU's loop runs at 200 Hz: once in this many periods."""


@dataclass(frozen=True)
class ImuNoise:
    """Noise and filter of the IMU; the noise is about that of the stand-in.

    Attributes:
        gyro: standard deviation of a reading [rad/s].
        accelerometer: standard deviation of a reading [m/s^2].
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
        compiled: whether the servo law is translated to numpy where it can be, which is several times faster.
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
        compiled: bool = True,
    ):
        self.scene = build_scene(scene) if isinstance(scene, str) else scene
        attach_servos(self.scene.joints)
        self.joints = tuple(str(joint.name) for joint in self.scene.joints)
        robot = self.scene.robot
        super().__init__(
            self.scene.compile(visual=False),
            self.scene.joint_names,
            behind_bus(model),
            1,
            control_period=PERIOD,
            base_body=None if robot is None else robot.trunk.full_identifier,
            joint_names=self.joints,
            num_threads=1,
            translated=False,  # here a tick and its one step are translated together
        )
        self.battery, self._windings = battery, windings or Windings()
        self.supply: float | None = None
        count = len(self.joints)
        self._temperature = self._windings.start(count)
        imu = imu or ImuNoise()
        self._imu_spread = np.repeat([imu.gyro, imu.accelerometer], 3)
        self._rng = np.random.default_rng([seed, 5])
        self._blend = 1 - np.exp(-2 * np.pi * imu.bandwidth * PERIOD * IMU_EVERY)
        self._steps = self._board_since = 0
        self._board: BoardMotion | WeightSchedule | None = None
        self._board_drive: BoardDrive | WeightDrive | None = None
        if joint_position is None:
            joint_position = np.zeros(count) if robot is None else pose("stand")
        self.reset(self.scene.initial_qpos(joint_position), {"torque_enable": torch.zeros(1, count)})
        self.law.sense(self.signals)
        self._voltage = self.model.bus_voltage if battery is None else battery.voltage
        self.signals.bus_voltage = torch.full_like(self.signals.position, self._voltage)
        self.signals.temperature = torch.from_numpy(self._temperature.copy())[None]
        self._resistance = self.parameters["terminal_resistance"][0].numpy()
        self._compiled = self._compile() if compiled else None
        # without an effect on the sensors they say what is, and that can be seen in the batch's own arrays
        self._senses = self._compiled is None or _has(self.model, "apply", Stage.SENSING)
        self._reports, self._tilts = _has(self.model, "report"), _has(self.model, "sense_trunk")
        self._report = None if self._compiled is None or not self._reports else self._compile_report(self._compiled)
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
            self._felt[3:] = 0.0, 0.0, GRAVITY
        self._latch_imu()

    def _latch_imu(self) -> None:
        assert self._attitude is not None
        felt = self._felt
        felt += self._blend * (np.concatenate([self._rates, self._force]) - felt)
        self._imu = self._attitude.copy(), felt + self._imu_spread * self._rng.standard_normal(6)

    @property
    def translated(self) -> bool:
        """Whether the law runs in numpy."""
        return self._compiled is not None

    @property
    def position(self) -> Array:
        """Joint angles as the encoders see them [joint] in rad."""
        return self.signals.measured_position[0].numpy() if self._senses else self._position[0]

    @property
    def velocity(self) -> Array:
        """Joint velocities [joint] in rad/s."""
        return self.signals.measured_velocity[0].numpy() if self._senses else self._velocity[0]

    def drive(self, drive: Drive) -> None:
        """What the drivers do from now on; joints that are not enabled run free, with friction alone."""
        goals = {
            "goal_current": drive.current,
            "goal_duty": drive.duty,
            "by_voltage": drive.voltage,
            "bound": np.minimum(drive.limit, UNBOUNDED),
        }
        self.signals.torque_enable = torch.from_numpy(drive.enabled.astype(float))[None]
        if self._compiled is None:
            for name, value in goals.items():
                self.signals.state[name] = torch.from_numpy(value.astype(float))[None]
        else:
            self._compiled.inputs["torque_enable"][0] = drive.enabled
            for name, value in goals.items():
                self._compiled.state[name][0] = value

    def advance(self, steps: int = 1) -> None:
        """Let a number of periods pass.

        Raises:
            RuntimeError: if the physics has diverged; within `SLOW_EVERY` periods.
        """
        law = self._compiled
        step = super().advance if law is None else partial(self._step_in_numpy, law)
        for _ in range(steps):
            if self._board_drive is not None:
                self._move_board()
            step()
            self._steps += 1
            if self._attitude is not None and self._steps % IMU_EVERY == 0:
                self._latch_imu()
            if self._steps % SLOW_EVERY == 0:
                self._check()
                self._step_slow()
        if self._senses:
            self._read()
            self.law.sense(self.signals)

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """What the ground does from now on; its time counts from this call.

        Args:
            board: what moves the board of the scene; None: nothing does.
            tiles: heights of the tiles of the scene "terrain" [m]; None: as they are.

        Raises:
            ValueError: if the scene has no such board.
        """
        model = self.batch.model
        self._board_drive = None if board is None else board_drive(model, board, GROUND_EVERY * PERIOD)
        self._board, self._board_since = board, self._steps
        if tiles is not None:
            place_tiles(self.batch.expand("geom_pos"), tile_ids(model), np.asarray(tiles, dtype=float)[None])

    def _move_board(self) -> None:
        steps = self._steps - self._board_since
        if steps % GROUND_EVERY == 0:
            drive: Any = self._board_drive
            forces = self.batch.bind("qfrc_applied")
            drive.apply(self._board, np.array([steps * PERIOD]), self._qpos.numpy(), self._qvel.numpy(), forces)

    def foremost(self) -> float:
        """How far ahead the inner tip of the foremost foot is in the world [m]; 0 without a robot."""
        if self.scene.robot is None:
            return 0.0
        model, (data, tips) = self.batch.model, self._soles
        data.qpos[:] = self._qpos[0].numpy()
        mujoco.mj_kinematics(model, data)
        return float(data.site_xpos[tips, 0].max())

    @cached_property
    def _soles(self) -> tuple[mujoco.MjData, list[int]]:
        """Where positions are computed, and the ids of the soles' inner tips."""
        model = self.batch.model
        tips = [number for number in range(model.nsite) if model.site(number).name.endswith("sole_inner_tip")]
        return mujoco.MjData(model), tips

    def _check(self) -> None:
        if self._compiled is not None:
            # a number that is not finite spreads through the sum
            finite = np.isfinite(sum(float(array.sum()) for array in self._handed))
            self.failed[0] = not finite or bool(self.batch.warning.any())
        if bool(self.failed[0]):
            raise RuntimeError(f"the simulated robot's physics diverged at {self._steps * PERIOD:.3f} s")

    def _law_alone(self, signals: Signals) -> None:
        self.law.tick(signals)
        self.law.step(signals)

    def _compile(self) -> CompiledStep | None:
        """The law in numpy, reading the batch's own arrays; None where that cannot be."""
        if any(e.stage == Stage.SENSING and e.name in self.signals.state for e in self.model.effects):
            return None  # its memory would be asked for outside the law's own steps
        live = self._live_arrays()
        if live is None:
            return None
        self._position, self._velocity = live["position"], live["velocity"]
        try:
            return CompiledStep(self._law_alone, self.signals, (*HANDED_OVER, *FLOWS), live, tuple(live))
        except Untranslatable:
            return None

    def _flow(self, name: str) -> Array:
        """Current, duty or voltage of the last step [joint]."""
        if self._compiled is None:
            return getattr(self.signals, name)[0].numpy()
        return self._compiled.outputs[name][0]

    def _step_slow(self) -> None:
        signals, duration = self.signals, SLOW_EVERY * PERIOD
        current = self._flow("current")
        if self.battery is not None:
            self.battery.step(float((self._flow("voltage") * current).sum()), duration)
            self._voltage = self.battery.voltage
        if self.supply is not None:
            self._voltage = self.supply
        elif self.battery is None:
            self._voltage = self.model.bus_voltage
        self._windings.step(self._temperature, self._resistance * current**2, duration)
        if self._compiled is not None:
            slow = {"bus_voltage": self._voltage, "temperature": self._temperature}
            for name in slow.keys() & self._compiled.inputs.keys():
                self._compiled.inputs[name][...] = slow[name]
        if self._compiled is None or self._senses or self._reports:
            signals.bus_voltage = torch.full_like(signals.position, self._voltage)
            signals.temperature = torch.from_numpy(self._temperature.copy())[None]

    def _compile_report(self, compiled: CompiledStep) -> CompiledStep | None:
        """What the servos say of their current, in numpy, from what the compiled law left; None if that cannot be."""
        live = compiled.inputs | {name: compiled.outputs[name] for name in FLOWS}
        live |= {"position": self._position, "velocity": self._velocity}

        def step(signals: Signals) -> None:
            # of the law's step only the factors on the motor's parameters are kept, and computed
            before = replace(signals, state=dict(signals.state), factors={})
            self.law.step(before)
            signals.factors.update(before.factors)
            self.law.report(signals)

        try:
            return CompiledStep(step, self.signals, ("measured_current",), live, tuple(live))
        except Untranslatable:
            return None

    def _measured_current(self) -> Array:
        """Current of every joint as the effects say that it is measured [A]."""
        signals, compiled, report = self.signals, self._compiled, self._report
        if compiled is not None and report is not None:
            for name, memory in report.state.items():
                memory[...] = compiled.state[name] if name in compiled.state else compiled.next_state[name]
            report()
            return report.outputs["measured_current"][0]
        if compiled is not None:
            for name in FLOWS:
                setattr(signals, name, torch.from_numpy(self._flow(name).copy())[None])
            signals.position = torch.from_numpy(self._position.copy())
            signals.velocity = torch.from_numpy(self._velocity.copy())
            memories = compiled.next_state | compiled.state
            signals.state.update({name: torch.from_numpy(memory) for name, memory in memories.items()})
        self.law.report(signals)
        return signals.measured_current[0].numpy()

    def read(self) -> Readings:
        """What all sensors say now."""
        orientation, rates, force = None, None, None
        if self._attitude is not None:
            quaternion, felt = self._imu
            rates, force = felt[:3], felt[3:]
            if self._tilts:
                seen = self.law.sense_trunk(Trunk(torch.from_numpy(quaternion)[None], torch.from_numpy(rates)[None]))
                quaternion, rates = seen.quaternion[0].numpy(), seen.angular_velocity[0].numpy()
            orientation = roll_pitch_yaw(quaternion)
        current = self._measured_current() if self._reports else self._flow("current")
        return Readings(
            position=self.position.copy(),
            velocity=self.velocity.copy(),
            current=current.copy(),
            duty=self._flow("duty").copy(),
            voltage=np.full(len(self.joints), self._voltage),
            temperature=self._temperature.copy(),
            orientation=orientation,
            angular_velocity=rates,
            linear_acceleration=force,
        )


def _has(model: RobotModel, hook: str, stage: Stage | None = None) -> bool:
    """Whether an effect of the model, of this stage, acts at a hook of `Effect`."""
    effects = [effect for effect in model.effects if stage is None or effect.stage == stage]
    return any(getattr(type(effect), hook) is not getattr(Effect, hook) for effect in effects)
