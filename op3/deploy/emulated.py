"""The emulated robot as a user meets it: held up by the trunk, and put down on the floor when it is ready."""

from __future__ import annotations

from collections.abc import Callable
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
from op3.sim import load_model
from op3.stand_in import World

Array = NDArray[np.float64]

MakePhysics = Callable[[str, Array | None], Physics]
"""Makes a robot on a scene, at joint angles [joint] in rad."""


class HandHeld:
    """A physics whose robot hangs from a hand until it is put down.

    A robot without torque collapses, so it is energised and brought to its start pose in the air. Putting it down
    puts it on the scene with the angles that its joints have, at rest.

    Args:
        make: the robot on a scene.
        scene: where it is put down.
        joint_position: [joint] in rad at the start; None for the pose "stand".
    """

    def __init__(self, make: MakePhysics, scene: str, joint_position: ArrayLike | None = None):
        self._make, self._scene = make, scene
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
        self._physics = self._make(self._scene, np.array(self._physics.position))
        self._physics.supply = supply
        if self._drive is not None:
            self._physics.drive(self._drive)

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

    def read(self) -> Readings:
        """What all sensors say now."""
        return self._physics.read()


class Hands(Yes):
    """An operator who agrees to everything and puts the robot down when it is ready."""

    def __init__(self, physics: HandHeld):
        self._physics = physics

    def said_go(self) -> bool:
        """Put the robot down and say go."""
        self._physics.put_down()
        return True


def emulate(
    *,
    world: str = "default",
    world_seed: int | None = None,
    model: str | Path | None = None,
    scene: str = "floor",
    seed: int = 0,
    joint_position: ArrayLike | None = None,
    faults: Faults | None = None,
    timing: Timing | None = None,
    settings: dict[str, int] | None = None,
    record: str | Path | None = None,
) -> tuple[EmulatedRobot, Hands, str]:
    """An emulated robot in virtual time.

    Args:
        world: the stand-in's truth; see `op3.stand_in.World.find`. Ignored where a model is given.
        world_seed: which random world; None: as `seed`.
        model: name or file of a model, instead of a stand-in.
        scene: where it is put down; a name that `op3.robot.build_scene` knows.
        seed: of everything random.
        joint_position: [joint] in rad at the start.
        faults: of the bus and the robot.
        timing: of the bus.
        settings: EEPROM of the servos.
        record: file for the frames on the wire.

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
        battery = Battery()

        def make(where: str, position: Array | None) -> Physics:
            return SimPhysics(law, where, seed=seed, joint_position=position, battery=battery)

    physics = HandHeld(make, scene, joint_position)
    held = cast(Physics, physics)  # the checker does not take a property for the attribute `supply`
    robot = EmulatedRobot(held, seed=seed, faults=faults, timing=timing, settings=settings, record=record)
    return robot, Hands(physics), identity
