"""What a policy step was like throughout: means and peaks over its 32 ms, looked at after every millisecond.

One look per step lets the peaks of a landing escape the reward, which last a few milliseconds.
"""

from dataclasses import dataclass

import mujoco
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.robot import Scene
from op3.robot.units import GRAVITY
from op3.tasks.addresses import Addresses

Array = NDArray[np.float64]

MEANS, PEAKS = 10, 3
"""How many numbers of a step are means, and how many are largest values."""


@dataclass(frozen=True, eq=False)
class Throughout:
    """Means over a policy step and the largest values in it, ``[sim]`` unless stated.

    Attributes:
        current: of all motors together [A].
        angular_velocity: of the body [rad/s].
        acceleration: of the body, without gravity [m/s^2].
        foot_force: between ankle and foot, left and right, ``[sim, 2]`` in N; zeros for tasks without a gait.
        foot_speed: path of the middle of a foot's key points per time, ``[sim, 2]`` in m/s; the same.
        foot_clearance: height of a foot's lowest key point above that of the other foot, ``[sim, 2]`` in m, at least 0;
            the same.
        self_contact: share of the step in which the robot touches itself.
        peak_force: largest force on a foot [N].
        peak_acceleration: largest acceleration of the body [m/s^2].
        peak_penetration: how deep one part of the robot entered another [m].
    """

    current: Tensor
    angular_velocity: Tensor
    acceleration: Tensor
    foot_force: Tensor
    foot_speed: Tensor
    foot_clearance: Tensor
    self_contact: Tensor
    peak_force: Tensor
    peak_acceleration: Tensor
    peak_penetration: Tensor


class WholeStep:
    """Adds up what `Throughout` tells, over live arrays of a simulation.

    Args:
        feet: whether to look at the feet, which tasks with a gait need.
    """

    def __init__(self, model: mujoco.MjModel, scene: Scene, num_sims: int, feet: bool):
        at = Addresses.find(model, scene)
        self._base = at.qpos + 3, at.dof + 3
        self._accelerometer, self._contact = at.accelerometer, at.self_contact
        self._forces = at.foot_force if feet else at.foot_force[:0]
        self._points = at.foot_points[: len(self._forces)]
        self._sums = np.zeros((num_sims, MEANS + PEAKS))
        self._feet = np.zeros((num_sims, 2, 3))
        self._samples = 0
        self._timestep = float(model.opt.timestep)

    def begin(self, site_xpos: Array) -> None:
        """A policy step begins with the feet here, ``[sim, site, 3]``."""
        self._sums[:] = 0.0
        self._samples = 0
        if len(self._forces):
            self._feet[:] = site_xpos[:, self._points].mean(2)

    def look(self, qpos: Array, qvel: Array, sensordata: Array, site_xpos: Array, current: Array) -> None:
        """After a step of the physics; arrays ``[sim, ...]``, `current` in A."""
        self._samples += 1
        _add(
            self._sums, self._feet, qpos, qvel, sensordata, site_xpos, current,
            self._base, self._accelerometer, self._contact, self._forces, self._points, self._timestep,
        )  # fmt: skip

    def result(self) -> Throughout:
        """The step so far."""
        mean = torch.from_numpy(self._sums[:, :MEANS] / max(self._samples, 1))
        peak = torch.from_numpy(self._sums[:, MEANS:].copy())
        feet = mean[:, 3:5], mean[:, 5:7], mean[:, 7:9]
        return Throughout(mean[:, 0], mean[:, 1], mean[:, 2], *feet, mean[:, 9], peak[:, 0], peak[:, 1], peak[:, 2])


@numba.njit(cache=True, nogil=True)
def _add(
    sums, feet, qpos, qvel, sensordata, site_xpos, current, base, accelerometer, contact, forces, points, timestep
):  # fmt: skip
    """Adds one look to sums ``[sim, MEANS + PEAKS]``."""
    for sim in range(len(sums)):
        total = 0.0
        for joint in range(current.shape[1]):
            total += current[sim, joint] ** 2
        sums[sim, 0] += np.sqrt(total)
        rate = base[1]
        sums[sim, 1] += np.sqrt(qvel[sim, rate] ** 2 + qvel[sim, rate + 1] ** 2 + qvel[sim, rate + 2] ** 2)
        w, x, y, z = qpos[sim, base[0]], qpos[sim, base[0] + 1], qpos[sim, base[0] + 2], qpos[sim, base[0] + 3]
        # the accelerometer reads gravity too, upwards in the world
        ax = sensordata[sim, accelerometer] - GRAVITY * 2.0 * (x * z - w * y)
        ay = sensordata[sim, accelerometer + 1] - GRAVITY * 2.0 * (y * z + w * x)
        az = sensordata[sim, accelerometer + 2] - GRAVITY * (1.0 - 2.0 * (x * x + y * y))
        acceleration = np.sqrt(ax * ax + ay * ay + az * az)
        sums[sim, 2] += acceleration
        sums[sim, MEANS + 1] = max(sums[sim, MEANS + 1], acceleration)
        if sensordata[sim, contact] > 0.0 and sensordata[sim, contact + 1] < 0.0:
            sums[sim, 9] += 1.0
            sums[sim, MEANS + 2] = max(sums[sim, MEANS + 2], -sensordata[sim, contact + 1])
        lowest = np.zeros(2)
        for foot in range(len(forces)):
            first = forces[foot]
            force = np.sqrt(
                sensordata[sim, first] ** 2 + sensordata[sim, first + 1] ** 2 + sensordata[sim, first + 2] ** 2
            )
            sums[sim, 3 + foot] += force
            sums[sim, MEANS] = max(sums[sim, MEANS], force)
            lowest[foot] = site_xpos[sim, points[foot, 0], 2]
            for point in points[foot, 1:]:
                lowest[foot] = min(lowest[foot], site_xpos[sim, point, 2])
            way = 0.0
            for axis in range(3):
                here = 0.0
                for point in points[foot]:
                    here += site_xpos[sim, point, axis]
                here /= points.shape[1]
                way += (here - feet[sim, foot, axis]) ** 2
                feet[sim, foot, axis] = here
            sums[sim, 5 + foot] += np.sqrt(way) / timestep
        sums[sim, 7] += max(0.0, lowest[0] - lowest[1])
        sums[sim, 8] += max(0.0, lowest[1] - lowest[0])
