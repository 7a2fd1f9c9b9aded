"""Energy of walking and standing: power, currents and heat of every servo, extrapolated to an hour."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.common.sample_intervals import with_interval
from op3.envs.batched import BatchedEnv
from op3.robot import Robot
from op3.robot.register_units import GRAVITY
from op3.rollout import Rollout
from op3.servo import RobotModel

Array = NDArray[np.float64]

HOUR = 3600.0
"""[s]."""

SETTLED = 2.0
"""Time omitted at the beginning of an episode [s]."""

AMBIENT = 25.0
"""[C]."""

WARMING = 240.0
"""Thermal time constant of a servo [s], estimated from its size and its mass of 82 g; no data sheet states it.

After an hour, fifteen time constants, the temperature does not depend on it.
"""


@dataclass(frozen=True, eq=False)
class Energy:
    """Costs of episodes; intervals are 95 % over episodes.

    Attributes:
        power: power drawn by all motors, with its interval, [3] in W; regenerated power is not recovered.
        cost_of_transport: power over weight and speed, with its interval, [3]; None for robots that do not travel.
        current: root mean square of each motor's current, [joint] in A.
        temperature: temperature of each servo after an hour at this load [C], [joint].
        drift: relative change of all motors' losses from the first to the second half of the episodes; near 0 if they
            may be extrapolated to an hour.
        continuous: continuous current rating of the weakest servo [A].
    """

    power: Array
    cost_of_transport: Array | None
    current: Array
    temperature: Array
    joints: tuple[str, ...]
    drift: float
    continuous: float

    @property
    def hottest(self) -> str:
        """The hottest joint."""
        return self.joints[int(self.temperature.argmax())]


def measure_energy(logs: Sequence[Rollout], model: RobotModel, robot: Robot, mass: float, travels: bool) -> Energy:
    """The costs of episodes, from their logs with `joint/current` and `joint/velocity`.

    Args:
        mass: mass of the robot [kg].
        travels: whether the robot walks, so that a cost of transport is defined.
    """
    resistance = model.tensors(robot.joints)["terminal_resistance"].numpy().reshape(-1)
    constant = torque_per_current(model, robot)
    thermal = np.array([servo.thermal_resistance for servo in robot.servos])
    powers, costs, losses, halves = [], [], [], []
    for log in logs:
        kept = log.array("time")[:, 0] >= min(SETTLED, 0.5 * log.duration)
        current, velocity = log.array("joint/current")[kept], log.array("joint/velocity")[kept]
        loss = resistance * current**2
        drawn = np.maximum(loss + constant * current * velocity, 0.0).sum(1).mean()
        powers.append(drawn)
        losses.append(loss.mean(0))
        half = len(loss) // 2
        halves.append((loss[:half].sum(1).mean(), loss[half:].sum(1).mean()))
        if travels:
            speed = log.metadata.travelled_distance / log.metadata.episode_duration  # type: ignore[operator]
            if speed > 0:
                costs.append(drawn / (mass * GRAVITY * speed))
    loss, (first, second) = np.mean(losses, 0), np.mean(halves, 0)
    return Energy(
        power=with_interval(powers),
        cost_of_transport=with_interval(costs) if costs else None,
        current=np.sqrt(loss / resistance),
        temperature=temperature_after(loss, thermal),
        joints=robot.joints,
        drift=float(second / first - 1) if first > 0 else 0.0,
        continuous=min(servo.continuous_current for servo in robot.servos),
    )


def robot_mass(env: BatchedEnv) -> float:
    """Mass of each robot [kg]."""
    return float(env.simulation.batch.get_model(0).body_subtreemass[0])


def torque_per_current(model: RobotModel, robot: Robot) -> Array:
    """Torque of each motor at its gear's output [N m/A], [joint]: torque constant times gear ratio, without losses."""
    motor: Any = model.effect("motor")
    constant = model.tensors(robot.joints)["torque_constant"].numpy().reshape(-1)
    return np.broadcast_to(constant * motor.gear_ratio, len(robot.joints))


def temperature_after(loss: Array, resistance: Array | float, duration: float = HOUR) -> Array:
    """Temperature [C] of servos that begin at `AMBIENT` and lose a steady power [W] as heat, after `duration` [s].

    Solution of dT/dt = (ambient + resistance loss - T) / `WARMING` for one heat capacity.
    """
    return AMBIENT + resistance * np.asarray(loss) * (1 - np.exp(-duration / WARMING))
