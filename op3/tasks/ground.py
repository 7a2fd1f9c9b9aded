"""What moves under the robots of a task."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from op3.robot.board import board_drive, stack
from op3.tasks.setups import OP3_CONTROL_PERIOD

Array = NDArray[np.float64]


class Ground:
    """Boards under many robots, each with a motion of its own, driven once per control tick."""

    def __init__(self, model: mujoco.MjModel, motions: Sequence[Any]):
        self._motion = stack(motions)
        self._drive: Any = board_drive(model, motions[0], OP3_CONTROL_PERIOD)

    def replace(self, rows: Array, motions: Sequence[Any]) -> None:
        """Give the robots in `rows` these motions."""
        new = stack(motions)
        for field in fields(new):
            getattr(self._motion, field.name)[rows] = getattr(new, field.name)

    def drive(self, time: Array, qpos: Array, qvel: Array, qfrc_applied: Array) -> None:
        """Drive the boards at times [s] of each episode, ``[sim]``, in arrays ``[sim, nq | nv]``."""
        self._drive.apply(self._motion, time, qpos, qvel, qfrc_applied)
