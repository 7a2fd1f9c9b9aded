"""A robot with hidden parameters: rigid-body dynamics from a library, and separate models of servos and sensors."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot import ServoMake
from op3.scenes import (
    BoardDrive,
    BoardMotion,
    WeightDrive,
    WeightSchedule,
    board_drive,
    place_tiles,
    tile_ids,
)
from op3.scenes.scene import Scene
from op3.stand_in.bodies import Floor, Limbs, change_body
from op3.stand_in.hidden_servos import HiddenServos
from op3.stand_in.integration import TICK
from op3.stand_in.play import play
from op3.stand_in.sensors import Imu, Sensors, quantise
from op3.stand_in.world import HiddenWorld, check_seed

BOARD_EVERY = 8
"""Ticks between two set points of a board's drive; the board moves smoothly in between."""

Array = NDArray[np.float64]


class StandIn:
    """A robot whose parameters are hidden behind its sensors.

    `play` records a motion as a computer on the robot would. A bus uses the lower-level methods `reset`,
    `write_current`, `drive`, `advance` and `read_sensors`.

    Args:
        world: the hidden parameters.
        scene: scene with the robot, without servos attached.
        seed: seed of all random numbers. The k-th reset draws from its own stream, so that the same seed gives the same
            bytes and repeats differ.

    Attributes:
        supply: voltage of the servos' supply [V]; None: the robot's battery.
    """

    def __init__(self, world: HiddenWorld, scene: Scene, *, seed: int = 0):
        self._world, self.hidden = world, world.hidden
        check_seed("seed", seed)
        self.seed = int(seed)
        self.scene = scene
        self.joints: tuple[str, ...] = tuple(str(joint.name) for joint in self.scene.joints)
        self.known = self.scene.robot_file
        own = self.known.indices(self.joints)
        self.rest, self.limits = self.known.home[own], self.known.limits[own]
        self.makes = tuple(self.known.servos[number] for number in own)
        self._units = {name: np.array([unit(make) for make in self.makes]) for name, unit in _UNITS.items()}
        limits = [make.limits.current.si if make.limits.current else np.inf for make in self.makes]
        self._current_limit = np.array(limits)
        self._per_tick = round(TICK / world.timestep)
        model = self._hidden_model()
        names = self.scene.joint_names
        ids = [model.joint(name).id for name in names]
        ranges = np.where(model.jnt_limited[ids, None], model.jnt_range[ids], [-np.inf, np.inf])
        count = len(self.joints)
        self.servos = HiddenServos(world, self.hidden, self.joints, self.makes, self.rest, ranges)
        self._model = model
        self._has_imu = self.scene.robot is not None and self.known.file.imu is not None
        if self.scene.floating:
            self._bodies: Floor | Limbs = Floor(model, self.servos, names, self._imu_places())
        else:
            mount = (0.0 if self.known.file.fixed else world.mount_frequency, world.mount_damping)
            self._bodies = Limbs(model, self.servos, names, mount)
        if self._has_imu:
            self._imu = Imu(world)
        self._arrivals: deque[tuple[int, Array]] = deque()
        self._resets = self._steps = self._board_since = 0
        self._due = self._late = 0.0
        self._losing = 0
        self.supply: float | None = None
        self._board: BoardMotion | WeightSchedule | None = None
        self._drive: BoardDrive | WeightDrive | None = None
        self._push: tuple[Array, int] | None = None
        self.reset(np.zeros(count))

    def _hidden_model(self) -> mujoco.MjModel:
        """The compiled scene with body and ground parameters of the world, and with hidden effects of links."""
        world = self._world
        model = self.scene.compile(visual=False)
        if self.scene.robot is not None and not self.known.file.fixed:
            trunk = model.body(self.scene.robot.trunk.full_identifier).id
            model.body_mass[trunk] += world.base_mass_offset
            model.body_ipos[trunk] += (world.base_com_offset_x, 0.0, world.base_com_offset_z)
        ground = [model.geom(name).id for name in self.scene.ground]
        model.geom_friction[ground, 0] = world.foot_friction
        model.geom_solref[ground] = (world.contact_time, 1.0)
        for effect in self.hidden:
            for joint in set(effect.joints) & set(self.joints):
                name = self.scene.joint_names[self.joints.index(joint)]
                change_body(model, int(model.jnt_bodyid[model.joint(name).id]), effect)
        return model

    def _imu_places(self) -> list[int] | None:
        robot = self.scene.robot
        if robot is None or not self._has_imu:
            return None
        return [int(self._model.sensor(element.full_identifier).adr[0]) for element in robot.imu_sensors]

    @property
    def time(self) -> float:
        """Time since the reset [s]."""
        return self._steps * self._world.timestep

    @property
    def loops(self) -> bool:
        """Whether the servos close a position loop themselves."""
        return self.makes[0].loop != "current"

    @property
    def world_id(self) -> str:
        """Id of the world, which reveals nothing else about it."""
        return self._world.identity

    def truth(self) -> dict[str, float | str | Array]:
        """All hidden parameters, only for scoring and tests: scalars, and [joint] if servos differ."""
        return {**dataclasses.asdict(self._world), **self._world.per_joint(len(self.joints))}

    def reset(
        self,
        joint_position: ArrayLike,
        *,
        qpos: ArrayLike | None = None,
        by_hand: bool = False,
        tilt: tuple[float, float] = (0.0, 0.0),
        day_time: float = 0.0,
        temperature: float | None = None,
    ) -> None:
        """Put the robot down at rest without currents, and start the next stream of random numbers.

        Args:
            joint_position: [joint] in rad. A free robot is placed on the floor with its soles as level as the pose
                allows.
            qpos: the full position [qpos] instead, to place the base elsewhere.
            by_hand: whether the joints have small random errors and follow encoder readings, as if a person had set
                them.
            tilt: roll and pitch of the stand in rad.
            day_time: how long the robot has worked before [s].
            temperature: temperature of air and windings [C]; None: unchanged.
        """
        self._rng = np.random.default_rng([self.seed, self._resets])
        self._resets += 1
        position = np.array(joint_position, dtype=float)
        if by_hand:
            position = self.servos.angles(position + self._world.placement * self._rng.standard_normal(len(position)))
        self._steps = self._board_since = 0
        self._due = self._late = 0.0
        self._losing = 0
        self._push = None
        self._arrivals.clear()
        full = self.scene.initial_qpos(position) if qpos is None else np.asarray(qpos, dtype=float)
        if temperature is not None:
            self.servos.states["temperature"] = self.servos.states["air"] = temperature
        self.servos.reset(position, self._rng, day_time)
        self._bodies.reset(position, full, tilt)
        if self._has_imu:
            quaternion, _, _ = self._bodies.trunk()
            up = np.zeros(9)
            mujoco.mju_quat2Mat(up, quaternion)
            self._imu.reset(quaternion, -up.reshape(3, 3).T @ self._model.opt.gravity)

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """Set the motion of the ground; its time counts from this call, or from a later reset.

        Args:
            board: motion of the board in the scenes "board" and "board_weight"; None: no motion.
            tiles: heights of the tiles of the scene "terrain" [m], see `op3.scenes.draw_tiles`; None: unchanged.

        Raises:
            ValueError: if the scene has no such board.
        """
        self._drive = None if board is None else board_drive(self._model, board, BOARD_EVERY * TICK)
        self._board = board
        self._board_since = self._steps
        if tiles is not None:
            place_tiles(self._model.geom_pos, tile_ids(self._model), np.asarray(tiles, dtype=float))

    def push(self, force: ArrayLike, duration: float) -> None:
        """Push the trunk of a robot on the floor.

        Args:
            force: force [xyz] in N, in the world's axes.
            duration: duration from now [s].

        Raises:
            ValueError: if the trunk is held.
        """
        if not isinstance(self._bodies, Floor):
            raise ValueError(f"the trunk is held in the scene {self.scene.name!r}: it cannot be pushed")
        self._push = np.array(force, dtype=float), self._steps + round(duration / self._world.timestep)

    def foremost(self) -> float:
        """See `op3.scenes.scene.Scene.foremost`; 0 on a fixed base."""
        return self.scene.foremost(self._bodies.data) if isinstance(self._bodies, Floor) else 0.0

    def write_current(self, current: ArrayLike, delay: float = 0.0) -> None:
        """Give the servos new goal currents.

        Args:
            current: goal currents [joint] in A, or goal angles in rad for servos with an internal position loop; held
                until the next goals arrive.
            delay: time until they arrive [s]; later writes must not overtake earlier ones.
        """
        goal = np.array(current, dtype=float)
        if goal.shape != (len(self.joints),) or not np.isfinite(goal).all():
            raise ValueError(f"current must be {len(self.joints)} finite numbers in A, got {current}")
        arrival = self._steps + round(delay / self._world.timestep)
        if delay < 0 or (self._arrivals and arrival < self._arrivals[-1][0]):
            raise ValueError(f"currents cannot arrive {delay} s after writing: not before those written earlier")
        own = self.servos.servos["position_gain"] > 0  # whose goal is an angle [rad]
        self._arrivals.append((arrival, np.where(own, goal, goal.clip(-self._current_limit, self._current_limit))))

    def drive(self, enabled: ArrayLike, current: ArrayLike) -> None:
        """Set the currents [joint] in A; joints that are not enabled move freely, with friction only."""
        self.servos.states["enabled"] = enabled
        self.write_current(current)

    def send(self, current: ArrayLike) -> None:
        """A command of the robot's computer: quantised, delayed, and sometimes lost."""
        world, rng = self._world, self._rng
        delay = world.command_latency + world.latency_jitter * float(rng.standard_normal())
        delay += next((effect.size for effect in self.hidden if effect.name == "latency"), 0.0)
        drop = next((effect for effect in self.hidden if effect.name == "packet_drop"), None)
        if drop is not None:
            if self._losing == 0 and rng.random() < (drop.size if drop.variant == 0 else drop.size / 3):
                self._losing = 1 if drop.variant == 0 else 3
            if self._losing:
                self._losing -= 1
                return
        last = self._arrivals[-1][0] - self._steps if self._arrivals else 0
        unit = np.where(self.servos.servos["position_gain"] > 0, self._units["position"], self._units["current"])
        self.write_current(quantise(np.asarray(current), unit), max(delay, last * world.timestep, 0.0))

    def wait(self, period: float) -> None:
        """Let approximately a period pass [s], with the jitter of a computer without real-time scheduling."""
        jitter = self._world.sampling_jitter * min(max(self._rng.standard_normal(), -2.0), 2.0)
        self.advance(period + jitter - self._late)
        self._late = jitter

    def advance(self, duration: float) -> None:
        """Let time pass [s]. Fractions of a physics step are carried over to the next call.

        Raises:
            RuntimeError: if the physics diverges.
        """
        self._due += duration
        end = round(self._due / self._world.timestep)
        try:
            while self._steps < end:
                self._run(end)
        except FloatingPointError:
            where = f"at {self.time:.3f} s in world {self.world_id}"
            raise RuntimeError(f"the stand-in's physics diverged {where}") from None

    def _run(self, end: int) -> None:
        """Go on to the next arrival, or the end of the tick, or a step."""
        steps = self._steps
        within = steps % self._per_tick
        if within == 0:
            self._begin_tick()
        while self._arrivals and self._arrivals[0][0] <= steps:
            self.servos.states["goal"] = self._arrivals.popleft()[1]
        stop = min(end, steps - within + self._per_tick)
        if self._arrivals:
            stop = min(stop, self._arrivals[0][0])
        self._bodies.run(stop - steps)
        self._steps = stop
        if stop % self._per_tick == 0:
            self.servos.robot["supply"] = np.nan if self.supply is None else self.supply
            self.servos.tick(self._rng)
            if self._has_imu:
                self._imu.step(*self._bodies.trunk(), self._rng)

    def _begin_tick(self) -> None:
        self._bodies.begin_tick()
        if self._drive is None and self._push is None:
            return
        assert isinstance(self._bodies, Floor)
        tick = (self._steps - self._board_since) // self._per_tick
        if self._drive is not None and tick % BOARD_EVERY == 0:
            data = self._bodies.data
            time = (self._steps - self._board_since) * self._world.timestep
            self._drive.apply(self._board, time, data.qpos, data.qvel, data.qfrc_applied)  # type: ignore[arg-type]
        if self._push is not None:
            force, end = self._push
            assert self.scene.robot is not None
            trunk = self._model.body(self.scene.robot.trunk.full_identifier).id
            self._bodies.data.xfrc_applied[trunk, :3] = force if self._steps < end else 0.0
            self._push = None if self._steps >= end else self._push

    def read_sensors(self) -> Sensors:
        """Read every register once."""
        servos, noise = self.servos, self._rng.standard_normal((2, len(self.joints)))
        volts = servos.voltage + 0.2 * self._units["voltage"] * noise[1]
        seen = {
            "position": servos.encoders,
            "velocity": servos.velocity,
            "current": servos.reading + self._world.current_noise * noise[0],
            "voltage": volts,
            "temperature": servos.states["temperature"],
        }
        read = {name: quantise(values, self._units[name]) for name, values in seen.items()}
        if self._has_imu:
            rates, force = np.split(self._imu.rates_and_force, 2)
            read.update(orientation=self._imu.orientation, angular_velocity=rates, linear_acceleration=force)
        return Sensors(**read)

    play = play
    """Follow a motion and record it, see `op3.stand_in.play.play`."""

    def skip(self) -> None:
        """Count an existing recording, so that the next recording is the same as if this one had been recorded now."""
        self.reset(np.zeros(len(self.joints)))


_UNITS: dict[str, Callable[[ServoMake], float]] = {
    "position": lambda make: make.position_unit,
    "velocity": lambda make: make.unit("velocity"),
    "current": lambda make: make.unit("current") if make.counts.current else 0.001,
    "voltage": lambda make: make.unit("voltage"),
    "temperature": lambda make: make.unit("temperature") if make.counts.temperature else 1.0,
}
"""Unit of every register; a fine unit for currents and temperatures that servos do not report."""
