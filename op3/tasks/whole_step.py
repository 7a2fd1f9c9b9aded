"""Means and peaks over the 32 ms of a policy step, sampled every millisecond.

One sample per step would miss the peaks of a landing, which last a few milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.robot.register_units import GRAVITY
from op3.scenes import Scene
from op3.tasks.addresses import Addresses

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StepStatistics:
    """Means over a policy step and the largest values in it, ``[sim]`` unless stated.

    Attributes:
        current: norm of the currents of all motors together [A].
        angular_velocity: norm of the base's angular velocity [rad/s]; zeros for a fixed base.
        acceleration: norm of the base's acceleration without gravity [m/s^2]; zeros without an IMU.
        self_contact: share of the step in which the robot touches itself.
        foot_force: norm of the force above each foot, ``[sim, foot]`` in N; no columns for tasks without a gait.
        foot_speed: mean speed of the centre of a foot's key points, ``[sim, foot]`` in m/s.
        foot_clearance: height of a foot's lowest key point above that of the lowest foot, ``[sim, foot]`` in m.
        foot_rise: height of a foot's highest key point above the lowest of all feet, ``[sim, foot]`` in m.
        peak_force: largest force on a foot [N].
        peak_acceleration: largest acceleration of the base [m/s^2].
        peak_penetration: largest depth to which one part of the robot entered another [m].
    """

    current: Tensor
    angular_velocity: Tensor
    acceleration: Tensor
    self_contact: Tensor
    foot_force: Tensor
    foot_speed: Tensor
    foot_clearance: Tensor
    foot_rise: Tensor
    peak_force: Tensor
    peak_acceleration: Tensor
    peak_penetration: Tensor

    @classmethod
    def still(cls, count: int, feet: int) -> StepStatistics:
        """Values of robots before their first step."""
        whole, of_feet = torch.zeros(count, dtype=torch.float64), torch.zeros(count, feet, dtype=torch.float64)
        return cls(*[whole] * 4, *[of_feet] * 4, *[whole] * 3)

    def replace(self, **values: Tensor) -> StepStatistics:
        """A copy with changed attributes."""
        return replace(self, **values)


class WholeStep:
    """Accumulates the values of `StepStatistics` from live arrays of a simulation.

    Args:
        feet: whether to read the feet, which tasks with a gait need.
    """

    def __init__(self, model: mujoco.MjModel, scene: Scene, num_sims: int, feet: bool):
        at = Addresses.find(model, scene)
        # first of the quaternion in qpos and of the angular velocity in qvel; negative where the base is bolted
        self._base = (-1, -1) if at.qpos is None or at.dof is None else (at.qpos + 3, at.dof + 3)
        self._accelerometer = -1 if at.accelerometer is None or at.qpos is None else at.accelerometer
        self._contact = at.self_contact
        self._forces = at.foot_force if feet else at.foot_force[:0]
        self._points = at.foot_points[: len(self._forces)]
        count = len(self._forces)
        self._sums, self._peaks = np.zeros((num_sims, 4)), np.zeros((num_sims, 3))
        self._feet_sums, self._feet = np.zeros((num_sims, 4, count)), np.zeros((num_sims, count, 3))
        self._samples = 0
        self._timestep = float(model.opt.timestep)

    def begin(self, site_xpos: Array) -> None:
        """Begin a policy step with the feet at these positions, ``[sim, site, 3]``."""
        for sums in (self._sums, self._peaks, self._feet_sums):
            sums[:] = 0.0
        self._samples = 0
        if len(self._forces):
            self._feet[:] = site_xpos[:, self._points].mean(2)

    def look(self, qpos: Array, qvel: Array, sensordata: Array, site_xpos: Array, current: Array) -> None:
        """Add a step of the physics; arrays ``[sim, ...]``, `current` in A."""
        self._samples += 1
        _add(
            self._sums, self._peaks, self._feet_sums, self._feet, qpos, qvel, sensordata, site_xpos, current,
            self._base, self._accelerometer, self._contact, self._forces, self._points, self._timestep,
        )  # fmt: skip

    def result(self) -> StepStatistics:
        """Statistics of the step so far."""
        mean = torch.from_numpy(self._sums / max(self._samples, 1))
        feet = torch.from_numpy(self._feet_sums / max(self._samples, 1))
        peak = torch.from_numpy(self._peaks.copy())
        return StepStatistics(*mean.unbind(1), *feet.unbind(1), *peak.unbind(1))


@numba.njit(cache=True, nogil=True)
def _add(
    sums, peaks, feet_sums, feet, qpos, qvel, sensordata, site_xpos, current, base, accelerometer, contact, forces,
    points, timestep,
):  # fmt: skip
    """Adds one sample to sums ``[sim, 4]``, peaks ``[sim, 3]`` and sums of the feet ``[sim, 4, foot]``."""
    lowest, highest = np.zeros(len(forces)), np.zeros(len(forces))
    for sim in range(len(sums)):
        total = 0.0
        for joint in range(current.shape[1]):
            total += current[sim, joint] ** 2
        sums[sim, 0] += np.sqrt(total)
        if base[0] >= 0:
            rate = base[1]
            sums[sim, 1] += np.sqrt(qvel[sim, rate] ** 2 + qvel[sim, rate + 1] ** 2 + qvel[sim, rate + 2] ** 2)
        if accelerometer >= 0:
            w, x, y, z = qpos[sim, base[0]], qpos[sim, base[0] + 1], qpos[sim, base[0] + 2], qpos[sim, base[0] + 3]
            # the accelerometer also reads gravity, upwards in the world
            ax = sensordata[sim, accelerometer] - GRAVITY * 2.0 * (x * z - w * y)
            ay = sensordata[sim, accelerometer + 1] - GRAVITY * 2.0 * (y * z + w * x)
            az = sensordata[sim, accelerometer + 2] - GRAVITY * (1.0 - 2.0 * (x * x + y * y))
            acceleration = np.sqrt(ax * ax + ay * ay + az * az)
            sums[sim, 2] += acceleration
            peaks[sim, 1] = max(peaks[sim, 1], acceleration)
        if sensordata[sim, contact] > 0.0 and sensordata[sim, contact + 1] < 0.0:
            sums[sim, 3] += 1.0
            peaks[sim, 2] = max(peaks[sim, 2], -sensordata[sim, contact + 1])
        for foot in range(len(forces)):
            first = forces[foot]
            force = np.sqrt(
                sensordata[sim, first] ** 2 + sensordata[sim, first + 1] ** 2 + sensordata[sim, first + 2] ** 2
            )
            feet_sums[sim, 0, foot] += force
            peaks[sim, 0] = max(peaks[sim, 0], force)
            lowest[foot] = highest[foot] = site_xpos[sim, points[foot, 0], 2]
            for point in points[foot, 1:]:
                lowest[foot] = min(lowest[foot], site_xpos[sim, point, 2])
                highest[foot] = max(highest[foot], site_xpos[sim, point, 2])
            way = 0.0
            for axis in range(3):
                here = 0.0
                for point in points[foot]:
                    here += site_xpos[sim, point, axis]
                here /= points.shape[1]
                way += (here - feet[sim, foot, axis]) ** 2
                feet[sim, foot, axis] = here
            feet_sums[sim, 1, foot] += np.sqrt(way) / timestep
        if len(forces):
            ground = lowest.min()
            for foot in range(len(forces)):
                feet_sums[sim, 2, foot] += lowest[foot] - ground
                feet_sums[sim, 3, foot] += highest[foot] - ground
