"""The emulated robot as a user meets it: held up by the trunk, and put down on the floor when it is ready."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.deploy.emulator import (
    Battery,
    EmulatedRobot,
    Faults,
    Physics,
    Readings,
    SimPhysics,
    StandInPhysics,
    Timing,
)
from op3.deploy.emulator.firmware import Drive
from op3.deploy.operator import Yes
from op3.robot import BoardMotion, Waves, WeightSchedule, draw_tiles
from op3.sim import load_model
from op3.stand_in import World
from op3.tasks.beginning import board_of
from op3.tasks.task import Task, find_task

Array = NDArray[np.float64]

MakePhysics = Callable[[str, Array | None], Physics]
"""Makes a robot on a scene, at joint angles [joint] in rad."""

LOOK_EVERY = 32
"""Periods between two looks at how far the robot has got: once per policy step."""


@dataclass(frozen=True, eq=False)
class Place:
    """Where the robot is put down.

    Attributes:
        scene: a name that `op3.robot.build_scene` knows.
        board: what moves the board once the policy begins; None for a scene without one.
        tiles: heights of the terrain's tiles [m]; None for a scene without them.
    """

    scene: str = "floor"
    board: BoardMotion | WeightSchedule | None = None
    tiles: Array | None = None

    @classmethod
    def of_task(cls, task: str | Task, seed: int) -> Place:
        """The ground of a task's episode."""
        task = find_task(task)
        tiles = draw_tiles(seed, task.terrain_height, task.terrain_steps) if task.scene == "terrain" else None
        return cls(task.scene, board_of(task, seed), tiles)

    @property
    def waiting(self) -> BoardMotion | WeightSchedule | None:
        """What the board does until the policy begins: nothing."""
        if isinstance(self.board, WeightSchedule):
            return WeightSchedule(np.array(np.inf))
        return None if self.board is None else Waves.still()


class HandHeld:
    """A physics whose robot hangs from a hand until it is put down.

    A robot without torque collapses, so it is energised and brought to its start pose in the air. Putting it down
    puts it on the scene with the angles that its joints have, at rest.

    Args:
        make: the robot on a scene.
        place: where it is put down.
        joint_position: [joint] in rad at the start; None for the pose "stand".
    """

    def __init__(self, make: MakePhysics, place: Place, joint_position: ArrayLike | None = None):
        self._make, self._place = make, place
        self._periods = 0
        self._origin: float | None = None
        self._reached = 0.0
        start = None if joint_position is None else np.asarray(joint_position, dtype=float)
        self._physics = make("stand", start)
        self._drive: Drive | None = None
        self.held = True
        self.joints = self._physics.joints

    def put_down(self) -> None:
        """Let go; does nothing the second time."""
        if not self.held:
            return
        self.held = False
        supply = self._physics.supply
        self._physics = self._make(self._place.scene, np.array(self._physics.position))
        self._physics.supply = supply
        self._physics.set_ground(self._place.waiting, self._place.tiles)
        if self._drive is not None:
            self._physics.drive(self._drive)

    def begin(self) -> None:
        """Set the ground in motion, and measure from here how far the robot gets."""
        self._physics.set_ground(self._place.board)
        self._origin = self._physics.foremost()
        self._reached = self._origin

    @property
    def travelled(self) -> float | None:
        """How much further the inner tip of the foremost foot has been since `begin` [m]; None before it."""
        return None if self._origin is None else self._reached - self._origin

    @property
    def supply(self) -> float | None:
        """Voltage of the supply [V], where it is not the robot's own battery."""
        return self._physics.supply

    @supply.setter
    def supply(self, voltage: float | None) -> None:
        self._physics.supply = voltage

    @property
    def position(self) -> Array:
        """Joint angles [joint] in rad."""
        return self._physics.position

    @property
    def velocity(self) -> Array:
        """Joint velocities [joint] in rad/s."""
        return self._physics.velocity

    def drive(self, drive: Drive) -> None:
        """What the drivers do from now on."""
        self._drive = drive
        self._physics.drive(drive)

    def advance(self, steps: int) -> None:
        """Let a number of periods pass."""
        self._physics.advance(steps)
        if self._origin is not None:
            self._periods += steps
            if self._periods >= LOOK_EVERY:
                self._periods = 0
                self._reached = max(self._reached, self._physics.foremost())

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """What the ground does from now on."""
        self._physics.set_ground(board, tiles)

    def foremost(self) -> float:
        """How far ahead the inner tip of the foremost foot is [m]."""
        return self._physics.foremost()

    def read(self) -> Readings:
        """What all sensors say now."""
        return self._physics.read()


class Hands(Yes):
    """An operator who agrees to everything and puts the robot down when it is ready."""

    def __init__(self, physics: HandHeld):
        self._physics = physics

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Put the robot down and say go."""
        self._physics.put_down()
        return True

    def begins(self) -> None:
        """Set the ground in motion."""
        self._physics.begin()

    def travelled(self) -> float | None:
        """What a tape measure says [m]."""
        return self._physics.travelled


def emulate(
    *,
    world: str = "default",
    world_seed: int | None = None,
    model: str | Path | None = None,
    scene: str = "floor",
    task: str | Task | None = None,
    seed: int = 0,
    joint_position: ArrayLike | None = None,
    faults: Faults | None = None,
    timing: Timing | None = None,
    settings: dict[str, int] | None = None,
    record: str | Path | None = None,
    powered: bool = False,
    battery: float | None = 0.7,
) -> tuple[EmulatedRobot, Hands, str]:
    """An emulated robot in virtual time.

    Args:
        world: the stand-in's truth; see `op3.stand_in.World.find`. Ignored where a model is given.
        world_seed: which random world; None: as `seed`.
        model: name or file of a model, instead of a stand-in.
        scene: where it is put down: a name that `op3.robot.build_scene` knows.
        task: whose ground it is put down on, moving as in the episode of the seed; None for the scene.
        seed: of everything else that is random.
        joint_position: [joint] in rad at the start.
        faults: of the bus and the robot.
        timing: of the bus.
        settings: EEPROM of the servos.
        record: file for the frames on the wire.
        powered: whether someone has pressed the robot's power button; otherwise the servos' supply is off.
        battery: charge of a model's battery, 0 to 1; None: a supply at its bus voltage. A stand-in has its own.

    Returns:
        The robot, the operator who holds it, and what identifies the robot without telling its truth.
    """
    if model is None:
        truth = World.find(world, seed if world_seed is None else world_seed)
        identity = truth.identity

        def make(where: str, position: Array | None) -> Physics:
            return StandInPhysics(truth, where, seed=seed, joint_position=position)
    else:
        law = load_model(str(model))
        identity = str(model)
        source = None if battery is None else Battery(charge=float(battery))

        def make(where: str, position: Array | None) -> Physics:
            return SimPhysics(law, where, seed=seed, joint_position=position, battery=source)

    place = Place(scene) if task is None else Place.of_task(task, seed)
    physics = HandHeld(make, place, joint_position)
    held = cast(Physics, physics)  # the checker does not take a property for the attribute `supply`
    robot = EmulatedRobot(held, seed=seed, faults=faults, timing=timing, settings=settings, record=record)
    if powered:
        robot.switch_on()
    return robot, Hands(physics), identity
