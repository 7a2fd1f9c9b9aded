"""The emulated robot for users: held by the trunk, and put down on the floor when it is ready."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from op3.deploy.emulator import EmulatedRobot, Faults, LineTiming, Physics, SimPhysics, StandInPhysics
from op3.deploy.operator import Operator
from op3.deploy.registers import Units
from op3.robot import Robot, load_robot
from op3.scenes import Waves, WeightSchedule, build_scene
from op3.scenes.scene import check_scene
from op3.sim import model_for
from op3.stand_in import HiddenWorld
from op3.tasks.events import Terrain, board_motion
from op3.tasks.task import Task, find_task

MakePhysics = Callable[[str, ArrayLike | None], Physics]
"""Builds the physics of a robot in a scene, at joint angles [joint] in rad."""

LOOK_EVERY = 0.032
"""Interval between observations of the robot's true motion [s]: one policy step."""


class Hands(Operator):
    """An operator who agrees to everything, holds the robot up, and puts it down when it is ready.

    A robot without torque collapses, so it is energised and moved to its start pose on the stand. Putting it down
    creates the robot on the scene, at rest, with its present joint angles. A board does not move before the policy
    begins.

    Args:
        scene: scene in which the robot is put down, a name for `op3.scenes.build_scene`.
        task: task that defines scene and ground, moving as in the seed's episode; None: only the scene.
    """

    def __init__(self, robot: EmulatedRobot, make: MakePhysics, scene: str, task: Task | None, seed: int):
        self._robot, self._make = robot, make
        events = {} if task is None else task.terms("events")
        self._scene = scene if task is None else task.scene
        self._board = board_motion(seed=seed, **events["board"]) if "board" in events else None
        self._tiles = Terrain(**events["terrain"]).heights(seed) if "terrain" in events else None
        self.holding = True
        self._origin: float | None = None
        self._reached = 0.0

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Put the robot down and confirm."""
        if self.holding:
            self.holding = False
            physics = self._make(self._scene, np.array(self._robot.physics.position))
            weight = isinstance(self._board, WeightSchedule)
            still = WeightSchedule(np.array(np.inf)) if weight else self._board and Waves.still()
            physics.set_ground(still, self._tiles)
            self._robot.replace(physics)
        return True

    def begins(self) -> None:
        """Start the motion of the ground, and measure the distance travelled from here."""
        self._robot.physics.set_ground(self._board)
        self._origin = self._reached = self._robot.physics.foremost()
        self._look()

    def ends(self) -> None:
        """Lift the robot, as a person does, because it cannot balance on its way to the end pose."""
        self.holding = True
        self._robot.replace(self._make("stand", np.array(self._robot.physics.position)))

    def _look(self) -> None:
        if self.holding:
            return
        self._reached = max(self._reached, self._robot.physics.foremost())
        self._robot.at(self._robot.time + LOOK_EVERY, self._look)

    def travelled(self) -> float | None:
        """Largest advance of the foremost foot's inner tip since the policy began [m]; None before it."""
        return None if self._origin is None else self._reached - self._origin


def physics_maker(
    robot: str | Robot,
    *,
    world: str = "default",
    world_seed: int = 0,
    model: str | Path | None = None,
    seed: int = 0,
) -> tuple[MakePhysics, str]:
    """A function that creates the robot in a scene, and metadata that identify it without hidden parameters; see
    `emulate`."""
    known = load_robot(robot)
    if model is None:
        truth = HiddenWorld.find(world, world_seed)
        kind, identity = partial(StandInPhysics, truth), truth.identity
    else:
        law = model_for(known, None if model == "own" else model)
        kind, identity = partial(SimPhysics, law), str(model)

    def make(where: str, position: ArrayLike | None) -> Physics:
        return kind(build_scene(where, robot=known), seed=seed, joint_position=position)

    return make, identity


def emulate(
    robot: str | Robot,
    *,
    world: str = "default",
    world_seed: int | None = None,
    model: str | Path | None = None,
    scene: str = "floor",
    task: str | Task | None = None,
    seed: int = 0,
    joint_position: ArrayLike | None = None,
    faults: Faults | None = None,
    timing: LineTiming | None = None,
    settings: dict[str, int] | None = None,
    record: str | Path | None = None,
    powered: bool = False,
    jig: bool = False,
) -> tuple[EmulatedRobot, Hands, str]:
    """An emulated robot in virtual time.

    Args:
        robot: a name in `assets/robots`, or the path of its file.
        world: hidden parameters of the stand-in; see `op3.stand_in.HiddenWorld.find`. Ignored if a model is given.
        world_seed: seed of a random world; None: `seed`.
        model: name or file of a model, instead of a stand-in; "own": the model of its servo makes.
        scene: scene in which the robot is put down, a name for `op3.scenes.build_scene`.
        task: task that defines the ground, moving as in the seed's episode; None: only the scene.
        joint_position: [joint] in rad at the start; None for home.
        powered: whether someone has pressed the robot's power button; otherwise the servos' supply is off.
        jig: whether a jig holds the joints at their initial angles.

    Returns:
        The robot, the operator who holds it, and metadata that identify the robot without its hidden parameters.
    """
    Units(load_robot(robot))  # rejects servos of another bus first
    where, task = seed if world_seed is None else world_seed, None if task is None else find_task(task)
    make, identity = physics_maker(robot, world=world, world_seed=where, model=model, seed=seed)
    check_scene(scene if task is None else task.scene, load_robot(robot))  # the robot is put down with torque on
    hanging = make("stand", joint_position)
    if jig:
        hanging.advance = lambda duration: None  # time passes, nothing moves
    emulated = EmulatedRobot(hanging, seed=seed, faults=faults, timing=timing, settings=settings, record=record)
    if powered:
        emulated.switch_on()
    return emulated, Hands(emulated, make, scene, task, seed), identity
