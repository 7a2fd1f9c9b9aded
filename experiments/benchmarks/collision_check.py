"""Measure the time that the self-collision check takes in a tick of the control loop.

python experiments/benchmarks/collision_check.py
"""

import sys
import time

import numpy as np

from op3.common.settings import GAIN_HIGH
from op3.deploy.ticker import PERIOD
from op3.motions import SinusoidalGait
from op3.robot import load_robot
from op3.robot.self_collision import SelfCollision

TICKS = 5000
"""Of 8 ms that are checked."""


def main() -> None:
    """Check every tick of the walk shipped with the OP3, and print the durations."""
    robot, position = load_robot("op3"), SinusoidalGait().motion(TICKS * PERIOD, rate=1 / PERIOD).position
    velocity = np.gradient(position, PERIOD, axis=0)
    parts, p_gain = SelfCollision(robot, margin=0.0), np.full(len(robot.joints), GAIN_HIGH)
    taken = []
    for angles, speeds in zip(position, velocity, strict=True):
        began = time.perf_counter()
        parts.measured(angles, speeds)
        parts.commanded(angles, angles, p_gain)
        taken.append(time.perf_counter() - began)
    middle, late = np.quantile(taken, (0.5, 0.99))
    print(f"{1e6 * middle:.0f} us in the median, {1e6 * late:.0f} us at the 99th percentile of {1e6 * PERIOD:.0f} us")


if __name__ == "__main__":
    sys.exit(main())
