"""Back-drivability: response of joints to a slowly growing torque at gait states, with the whole servo law."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.common.settings import CONTROL_PERIOD
from op3.replay.setups import Setup
from op3.robot import Robot
from op3.robot.register_units import POSITION_UNIT
from op3.servo import RobotModel
from op3.sim import BatchSimulation

Array = NDArray[np.float64]

SETTLE = 0.6
"""Time for which commands act before the torque ramp begins [s]."""

RATE = 0.5
"""Slope of the torque ramp [N m/s]."""

MOST = 2.0
"""Torque at which the ramp ends [N m]; half of a servo's stall torque."""

MOVED = 3 * POSITION_UNIT
"""Displacement that counts as breaking away [rad]: three encoder counts."""

FITTED = 0.1
"""Displacement up to which the slope is fitted [rad]."""


@dataclass(frozen=True, eq=False)
class BackDrive:
    """Back-drive results at states of the gait; arrays ``[state, joint, direction]``.

    Attributes:
        break_away: torque at which the joint starts to move [N m]; NaN if it never does.
        slope: additional torque per additional angle [N m/rad]; NaN if the joint hardly moves.
    """

    break_away: Array
    slope: Array
    joints: tuple[str, ...]


def back_drive(
    model: RobotModel, robot: Robot, position: Array, commands: Mapping[str, Array], num_threads: int = 1
) -> BackDrive:
    """Hold the trunk, freeze the commands, and turn the controlled joints one after the other in both directions.

    Args:
        position: joint angles of the states, ``[state, joint]`` in rad.
        commands: commands at these states, by the names in `BatchSimulation.command`, ``[state, joint]``.
    """
    setup = Setup.of_mount("stand", robot=robot)
    turned = robot.indices(robot.controlled)
    shape = (len(position), len(turned), 2)
    rows = np.prod(shape)
    state, which, way = (axis.reshape(-1) for axis in np.indices(shape))
    simulation = BatchSimulation(
        setup.mj_model, setup.scene.joint_names, model, int(rows), base_body=setup.base_body,
        control_period=CONTROL_PERIOD, num_threads=num_threads,
    )  # fmt: skip
    frozen: dict[str, Tensor] = {name: torch.from_numpy(np.asarray(v)[state]) for name, v in commands.items()}
    simulation.reset(position[state], frozen)
    for _ in range(round(SETTLE / CONTROL_PERIOD)):
        simulation.advance()
    joint, sign = turned[which], np.where(way, -1.0, 1.0)
    qpos, turning = simulation.batch.bind("qpos"), simulation.ports.qpos[joint]
    everyone = np.arange(rows)
    start, twist = qpos[everyone, turning], _twister(simulation, joint)
    grown = RATE * CONTROL_PERIOD * np.arange(1, round(MOST / RATE / CONTROL_PERIOD) + 1)
    moved = np.zeros((len(grown), int(rows)))
    for step, size in enumerate(grown):
        twist(sign * size)
        simulation.advance()
        moved[step] = sign * (qpos[everyone, turning] - start)
        if (moved[step] >= FITTED).all():
            grown, moved = grown[: step + 1], moved[: step + 1]
            break
    break_away, slope = (values.reshape(shape) for values in _fits(grown, moved))
    return BackDrive(break_away, slope, robot.controlled)


def _twister(simulation: BatchSimulation, joint: NDArray[np.int64]) -> Callable[[Array], None]:
    """Apply torques [N m] between the two links of a joint ``[sim]`` of each robot until the next call.

    The torques act on the links and not in the servo, so that they load the servo's output.
    """
    model, batch, everyone = simulation.batch.model, simulation.batch, np.arange(simulation.num_sims)
    child = simulation.ports.body[joint]
    parent = model.body_parentid[child]
    hinge = np.array([model.joint(name).id for name in simulation.ports.joints])[joint]
    axis, external = batch.bind("xaxis"), batch.bind("xfrc_applied")

    def twist(torque: Array) -> None:
        turning = torque[:, None] * axis[everyone, hinge]
        external[everyone, child, 3:] = turning
        external[everyone, parent, 3:] = -turning

    return twist


def _fits(torque: NDArray[np.floating], moved: Array) -> tuple[Array, Array]:
    """Break-away torque and slope of each column of displacements ``[time, sim]`` under torques [time]."""
    break_away, slope = np.full(moved.shape[1], np.nan), np.full(moved.shape[1], np.nan)
    for sim, angle in enumerate(moved.T):
        if angle.max() < MOVED:
            continue
        first = int(np.argmax(angle >= MOVED))
        last = int(np.argmax(angle >= FITTED)) if angle.max() >= FITTED else len(angle)
        break_away[sim] = torque[first]
        if last - first > 4 and angle[last - 1] - angle[first] > 2 * MOVED:
            slope[sim] = 1.0 / np.polyfit(torque[first:last], angle[first:last], 1)[0]
    return break_away, slope
