"""The stand-in robot: MuJoCo's rigid bodies at 0.25 ms, own servos, own sensors."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
from collections import deque
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot import (
    BoardDrive,
    BoardMotion,
    Motion,
    WeightDrive,
    WeightSchedule,
    board_drive,
    build_scene,
    place_tiles,
    tile_ids,
)
from op3.robot.scenes import Scene
from op3.robot.units import CURRENT_UNIT, POSITION_UNIT, TEMPERATURE_UNIT, VELOCITY_UNIT, VOLTAGE_UNIT
from op3.rollout import Rollout
from op3.stand_in.play import play
from op3.stand_in.sensors import Imu, Sensors, VelocityFilter, quantise
from op3.stand_in.servos import SLOW_PERIOD, ServoBank
from op3.stand_in.world import World

TIMESTEP = 0.00025
"""Step of the physics [s]."""

BOARD_PERIOD = 0.008
"""Time between two looks of a board's drive at its motion [s]; in between the board follows it smoothly."""

CURRENT_LIMIT = 2.3
"""The servos hold no goal current beyond this [A]; stall current at 12 V, ROBOTIS e-Manual."""

Array = NDArray[np.float64]


class StandIn:
    """A robot whose truth is hidden behind its sensors.

    `play` records a motion as a computer on the robot would. Below it lies what a bus needs: `reset`,
    `write_current`, `advance`, `read_sensors`.

    The physics is Euler's semi-implicit step with elliptic friction cones. One evaluation of the dynamics per
    step suits servos that carry a state of their own and advance once per step; at 0.25 ms it needs no implicit
    damping (the stiffest term, damping over inertia, is 0.1 per step), and it costs a quarter of RK4.

    Args:
        world: the truth.
        scene: a name from `op3.robot.SCENES`, or a scene.
        seed: of everything random in the recordings. The k-th reset draws from its own stream, so equal seeds
            give equal bytes, and repeats differ.
        timestep: of the physics [s]; it must divide 1 ms.
    """

    def __init__(self, world: World, scene: str | Scene = "floor", *, seed: int = 0, timestep: float = TIMESTEP):
        self._world = world
        self.seed = _whole("seed", seed)
        self.scene = build_scene(scene) if isinstance(scene, str) else scene
        self.joints: tuple[str, ...] = tuple(str(joint.name) for joint in self.scene.joints)
        self._slow_every = round(SLOW_PERIOD / timestep)
        if self._slow_every < 1 or abs(self._slow_every * timestep - SLOW_PERIOD) > 1e-12:
            raise ValueError(f"timestep must divide {SLOW_PERIOD} s, got {timestep} s")
        self.timestep = timestep
        self._model = self._hidden_model()
        self._data = mujoco.MjData(self._model)
        ids = [self._model.joint(name).id for name in self.scene.joint_names]
        self._positions = self._data.qpos[_run(self._model.jnt_qposadr[ids])]
        dofs = _run(self._model.jnt_dofadr[ids])
        self._velocities = self._data.qvel[dofs]
        self._torques = self._data.qfrc_applied[dofs]
        count = len(self.joints)
        self._servos = ServoBank(world, count, timestep)
        self._velocity_filter = VelocityFilter(world, count)
        self._has_imu = self.scene.robot is not None
        if self._has_imu:
            self._imu = Imu(world)
            self._find_imu()
        self._goal_current = np.zeros(count)
        self._mixed_current = np.zeros(count)
        self._arrivals: deque[tuple[float, Array]] = deque()
        self._resets = 0
        self._steps = 0
        self._board: BoardMotion | WeightSchedule | None = None
        self._drive: BoardDrive | WeightDrive | None = None
        self._board_since = 0
        self._drive_every = round(BOARD_PERIOD / timestep)
        self._due = 0.0
        self._rng = np.random.default_rng([self.seed, 0])
        self.reset(np.zeros(count))

    def _hidden_model(self) -> mujoco.MjModel:
        """The scene compiled, with the world's body, armature and ground."""
        world = self._world
        model = self.scene.compile(visual=False)
        model.opt.timestep = self.timestep
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        for name in self.scene.joint_names:
            model.dof_armature[model.joint(name).dofadr] = world.armature
        if self.scene.robot is not None:
            trunk = model.body(self.scene.robot.trunk.full_identifier).id
            model.body_mass[trunk] += world.base_mass_offset
            model.body_ipos[trunk] += (world.base_com_offset_x, 0.0, world.base_com_offset_z)
        ground = [model.geom(name).id for name in self.scene.ground]
        model.geom_friction[ground, 0] = world.foot_friction
        model.geom_solref[ground] = (world.contact_time, 1.0)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def _find_imu(self) -> None:
        robot = self.scene.robot
        assert robot is not None
        views = []
        for element in (robot.imu_orientation, robot.imu_gyro, robot.imu_accelerometer):
            sensor = self._model.sensor(element.full_identifier)
            first, width = int(sensor.adr[0]), int(sensor.dim[0])
            views.append(self._data.sensordata[first : first + width])
        self._orientation, self._rates, self._force = views
        if not self.scene.floating:
            # MuJoCo's accelerometer reads zero on a body that cannot move.
            self._force = np.asarray(self.scene.mounted_specific_force)

    @property
    def time(self) -> float:
        """Time since the reset [s]."""
        return self._steps * self.timestep

    @property
    def world_id(self) -> str:
        """Tells one world from another, and nothing else about it."""
        return self._world.identity

    def truth(self) -> dict[str, float | Array]:
        """Every hidden number, for scorers and tests alone: scalars, and [joint] where servos differ."""
        return {**dataclasses.asdict(self._world), **self._world.per_joint(len(self.joints))}

    def reset(self, joint_position: ArrayLike, *, qpos: ArrayLike | None = None, by_hand: bool = False) -> None:
        """Put the robot down at rest, no current flowing, and start the next stream of random numbers.

        Args:
            joint_position: [joint] in rad. A free robot is put on the floor with its soles as level as the
                pose allows.
            qpos: the full position [qpos] instead, where the base shall be elsewhere.
            by_hand: whether the joints are set as a person does it, who misses each by a little.
        """
        self._rng = np.random.default_rng([self.seed, self._resets])
        self._resets += 1
        position = np.array(joint_position, dtype=float)
        if by_hand:
            position += self._world.placement * self._rng.standard_normal(len(self.joints))
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self.scene.initial_qpos(position) if qpos is None else np.asarray(qpos, dtype=float)
        mujoco.mj_forward(self._model, self._data)
        self._steps = self._board_since = 0
        self._due = 0.0
        self._arrivals.clear()
        self._goal_current[:] = 0
        self._servos.reset(self._rng)
        self._velocity_filter.reset()
        if self._has_imu:
            up = np.zeros(9)
            mujoco.mju_quat2Mat(up, self._orientation)
            self._imu.reset(self._orientation, -up.reshape(3, 3).T @ self._model.opt.gravity)

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """What the ground does from now on; its time counts from this call, or from a later reset.

        Args:
            board: what moves the board of the scenes "board" and "board_weight"; None: nothing does.
            tiles: heights of the tiles of the scene "terrain" [m], see `op3.robot.draw_tiles`; None: as they are.

        Raises:
            ValueError: if the scene has no such board.
        """
        self._drive = None if board is None else board_drive(self._model, board, BOARD_PERIOD)
        self._board = board
        self._board_since = self._steps
        if tiles is not None:
            place_tiles(self._model.geom_pos, tile_ids(self._model), np.asarray(tiles, dtype=float))

    def foremost(self) -> float:
        """How far ahead the inner tip of the foremost foot is in the world [m], as a tape measure; 0 on the bench."""
        if self.scene.robot is None:
            return 0.0
        return float(self._data.site_xpos[self._tips, 0].max())

    @cached_property
    def _tips(self) -> list[int]:
        """Ids of the soles' inner tips."""
        model = self._model
        return [number for number in range(model.nsite) if model.site(number).name.endswith("sole_inner_tip")]

    def write_current(self, current: ArrayLike, delay: float = 0.0) -> None:
        """Give the servos new goal currents.

        Args:
            current: [joint] in A; held until the next ones arrive.
            delay: how long they are under way [s]. Later writes may not overtake earlier ones.
        """
        goal = np.array(current, dtype=float)
        if goal.shape != self._goal_current.shape or not np.isfinite(goal).all():
            raise ValueError(f"current must be {len(self.joints)} finite numbers in A, got {current}")
        arrival = self.time + delay
        if delay < 0 or (self._arrivals and arrival < self._arrivals[-1][0]):
            raise ValueError(f"currents cannot arrive {delay} s after writing: not before those written earlier")
        self._arrivals.append((arrival, goal.clip(-CURRENT_LIMIT, CURRENT_LIMIT)))

    def advance(self, duration: float) -> None:
        """Let time pass [s]. Parts of a physics step are carried over to the next call."""
        self._due += duration
        while self._steps < round(self._due / self.timestep):
            self._step()
        if not np.isfinite(self._data.qacc).all() or self._data.warning.number[_DIVERGENCE].any():
            raise RuntimeError(f"the stand-in's physics diverged at {self.time:.3f} s in world {self.world_id}")

    def _step(self) -> None:
        goal = self._goal_current
        if self._arrivals and self._arrivals[0][0] < self.time + self.timestep:
            goal = self._receive()
        if self._drive is not None and (self._steps - self._board_since) % self._drive_every == 0:
            data: Any = self._data
            time = (self._steps - self._board_since) * self.timestep
            self._drive.apply(self._board, time, data.qpos, data.qvel, data.qfrc_applied)  # type: ignore[arg-type]
        self._torques[:] = self._servos.step(goal, self._velocities)
        mujoco.mj_step(self._model, self._data)
        self._steps += 1
        if self._steps % self._slow_every == 0:
            self._servos.step_slow(self.time, self._rng)
            self._velocity_filter.step(self._velocities)
            if self._has_imu:
                self._imu.step(self._orientation, self._rates, self._force, self._rng)

    def _receive(self) -> Array:
        """Take what arrives within this step; the currents of this step are the mean over it."""
        begin = self.time
        mixed = self._mixed_current
        mixed[:] = self._goal_current
        while self._arrivals and self._arrivals[0][0] < begin + self.timestep:
            arrival, current = self._arrivals.popleft()
            mixed += (1 - max(arrival - begin, 0.0) / self.timestep) * (current - self._goal_current)
            self._goal_current[:] = current
        return mixed

    def read_sensors(self) -> Sensors:
        """Read every register once."""
        servos, noise = self._servos, self._rng.standard_normal((2, len(self.joints)))
        imu = {}
        if self._has_imu:
            imu = dict(
                orientation=self._imu.orientation,
                angular_velocity=self._imu.rates_and_force[:3],
                linear_acceleration=self._imu.rates_and_force[3:],
            )
        return Sensors(
            position=quantise(self._positions, POSITION_UNIT),
            velocity=quantise(self._velocity_filter.value, VELOCITY_UNIT),
            current=quantise(servos.reading + self._world.current_noise * noise[0], CURRENT_UNIT),
            voltage=quantise(servos.bus_voltage + 0.2 * VOLTAGE_UNIT * noise[1], VOLTAGE_UNIT),
            temperature=quantise(servos.temperature, TEMPERATURE_UNIT),
            **imu,
        )

    def draw_latency(self) -> float:
        """How long the next command of the computer on the robot is under way [s]."""
        world = self._world
        return max(0.0, world.command_latency + world.latency_jitter * float(self._rng.standard_normal()))

    def play(
        self,
        motion: Motion,
        p_gain: ArrayLike = 6.0,
        d_gain: ArrayLike = 0.1,
        *,
        recording: str | None = None,
        settle: float = 1.5,
    ) -> Rollout:
        """Follow a motion with the PD of the robot's computer and record it.

        Args:
            motion: targets; joints that it does not name stay in the pose "stand".
            p_gain: one number, [joint], or [row, joint] with one row per tick of 8 ms [A/rad].
            d_gain: the same [A s/rad].
            recording: identity of the recording.
            settle: how long the first pose is held before the recording starts [s]; longer if the robot is not at
                rest by then.

        Returns:
            A rollout at 125 Hz whose first rows are at rest.
        """
        return play(self, motion, p_gain, d_gain, recording=recording, settle=settle)

    def skip(self) -> None:
        """Count a recording that exists already, so that the next is as it would have been after it."""
        self.reset(np.zeros(len(self.joints)))


_DIVERGENCE = [
    int(kind)
    for kind in (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
]


def _run(addresses: ArrayLike) -> slice:
    """Consecutive addresses as a slice, so that indexing gives a view."""
    first = np.asarray(addresses).ravel()
    if (np.diff(first) != 1).any():
        raise ValueError("the joints of the scene must be consecutive in the model")
    return slice(int(first[0]), int(first[-1]) + 1)


def _whole(name: str, value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}")
    return int(value)
