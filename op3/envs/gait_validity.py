"""Plausibility of a gait on a real robot: self-contact, swing-foot clearance, step width, slip, drift, tilt."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.envs.batched import BatchedEnv
from op3.envs.record import record_episodes
from op3.envs.step_traces import SKIPPED, TOUCHED, StepWatch, Traces, swings
from op3.policy.actions import GAIN_HIGH
from op3.robot import Robot
from op3.robot.self_collision import SelfCollision
from op3.rollout import Rollout


@dataclass(frozen=True)
class GaitValidity:
    """Validity over all episodes; None if not applicable, such as the clearance of a standing robot.

    Attributes:
        self_contact: share of physics steps in which the robot touches itself [-].
        penetration: depth of the deepest self-contact [m].
        clearance: median over swings of the largest height of the sole's lowest corner above the higher of the lift-off
            and touchdown points [m].
        step_width: median over touchdowns of the lateral distance between the soles' centres [m]; only for bipeds.
        double_support: share of the time in which both feet are loaded [-]; only for bipeds.
        foot_slip: mean horizontal speed of the lowest corner of a loaded foot's sole [m/s].
        yaw_drift: mean over episodes of the absolute change of heading per time [rad/s].
        tilt: mean angle of the trunk from upright [rad].
        collision_ahead: share of episodes that `op3 deploy` would have ended for a measured or commanded pose in which
            parts collide [-]; None if it was not checked.
    """

    self_contact: float
    penetration: float
    clearance: float | None
    step_width: float | None
    double_support: float | None
    foot_slip: float | None
    yaw_drift: float
    tilt: float
    collision_ahead: float | None = None

    def __str__(self) -> str:
        shares = [f"touches itself in {self.self_contact:.1%} of the steps, {1000 * self.penetration:.1f} mm deep"]
        if self.clearance is not None and self.step_width is not None:
            shares.append(f"swing foot clears the ground by {1000 * self.clearance:.1f} mm")
            shares.append(f"step width {1000 * self.step_width:.0f} mm")
        if self.double_support is not None:
            shares.append(f"double support {self.double_support:.0%}")
        if self.foot_slip is not None:
            shares.append(f"loaded feet slip at {self.foot_slip:.3f} m/s")
        shares.append(f"yaw drifts by {np.degrees(self.yaw_drift):.2f} deg/s")
        return f"{', '.join(shares)}, trunk tilts by {np.degrees(self.tilt):.1f} deg"


def judged_episodes(env: BatchedEnv, policy: Any, recording: str | None = None) -> tuple[list[Rollout], GaitValidity]:
    """One episode of each robot of an environment, as in `op3.envs.record_episodes`, and the validity of the gait."""
    watch = StepWatch(env)
    with watch.watching():
        logs = record_episodes(env, policy, recording=recording)
    timestep = env.simulation.timestep
    lengths = np.array([round(log.rows / log.metadata.rate / timestep) for log in logs])
    stopped = float(np.mean([collision_ahead(log) for log in logs]))
    return logs, replace(gait_validity(watch.traces(), lengths, timestep), collision_ahead=stopped)


def gait_validity(traces: Traces, lengths: NDArray[np.int64], timestep: float = 0.001) -> GaitValidity:
    """Compute the validity of episodes from their traces.

    Self-contact is evaluated from the first step, everything else after `SKIPPED`.

    Args:
        lengths: number of steps of each robot's episode, [sim].
        timestep: time step of the physics [s].
    """
    first = round(SKIPPED / timestep)
    touching, clearances, widths, turned, tilts = [], [], [], [], []
    slips, both, steps = [], 0, 0
    for robot, length in enumerate(lengths):
        touching.append(traces.penetration[:length, robot])
        kept = slice(min(first, length // 2), length)
        force, sole, centre = (values[kept, robot] for values in (traces.force, traces.sole, traces.centre))
        yaw, loaded = np.unwrap(traces.yaw[kept, robot]), force >= TOUCHED
        slips.append(traces.slip[kept, robot][loaded])
        both, steps = both + int(loaded.all(-1).sum()), steps + len(force)
        tilts.append(traces.tilt[kept, robot])
        if len(yaw) > 1:
            turned.append(abs(float(yaw[-1] - yaw[0])) / (len(yaw) * timestep))
        for foot in range(force.shape[-1]):
            for left, time in swings(force[:, foot]):
                clearances.append(sole[left : time + 1, foot].max() - max(sole[left, foot], sole[time, foot]))
                apart = centre[time, 0] - centre[time, -1]
                widths.append(abs(apart[1] * np.cos(yaw[time]) - apart[0] * np.sin(yaw[time])))
    depth, slip = np.concatenate(touching), np.concatenate(slips)
    biped = clearances and traces.force.shape[-1] == 2
    return GaitValidity(
        self_contact=float((depth > 0).mean()),
        penetration=float(depth.max()),
        clearance=float(np.median(clearances)) if clearances else None,
        step_width=float(np.median(widths)) if biped else None,
        double_support=both / steps if biped else None,
        foot_slip=float(slip.mean()) if len(slip) else None,
        yaw_drift=float(np.mean(turned)) if turned else 0.0,
        tilt=float(np.concatenate(tilts).mean()),
    )


def collision_ahead(log: Rollout) -> bool:
    """Whether `op3 deploy` would have ended this episode for a measured or commanded pose in which parts collide.

    Servos that close a position loop themselves count as stiff.
    """
    parts, position, target = _self_collision(log.robot), log.array("joint/position"), log.array("command/position")
    p_gain = log.array("command/p_gain") if "command/p_gain" in log else np.full_like(target, GAIN_HIGH)
    measured = zip(position, log.array("joint/velocity"), strict=True)
    return any(parts.measured(*row) for row in measured) or any(
        parts.commanded(*row) for row in zip(position, target, p_gain, strict=True)
    )


@lru_cache(maxsize=4)
def _self_collision(robot: Robot) -> SelfCollision:
    return SelfCollision(robot, margin=0.0)
