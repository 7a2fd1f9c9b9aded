"""What windows are reduced by: noise of readings, pieces, and features of what a joint goes through."""

import numpy as np

from op3.replay.windows import WindowResiduals

FLOORS = {("joint", "position"): 0.0005, ("joint", "velocity"): 0.010, ("joint", "current"): 0.0035}
"""Of a reading [rad, rad/s, A]: a count of a 4096-step encoder and of 0.024 rad/s over sqrt(12), and a little more
(ROBOTIS e-Manual, XM430; Feetech's magnetic encoders have as many steps). A current is noisier than its count of
2.69 mA, by how much no maker says: 1.3 counts are our own choice."""

PIECES = 4
"""Pieces of a window in each of which the torque is constant."""

OFTEN = np.array([3, 3, 3, 3, 2, 1, 1.0])
"""How often a feature looks at position, velocity, its direction, load, load times velocity, warmth, time."""


def random_features(engine: WindowResiduals, joints: np.ndarray, count: int) -> list[np.ndarray]:
    """Features along the windows, each ``[window, tick, joint]``; the first is constant.

    What a joint does and nobody explains is a sum of them (Rahimi & Recht 2007).
    """
    rng = np.random.default_rng(0)
    motion = engine.motion
    q, v, i = (engine.by_window(a)[..., joints] for a in (motion.position, motion.velocity, motion.current))
    time = np.broadcast_to(engine.by_window(motion.time), q.shape)
    warmth = motion.inputs.get("temperature")
    warm = np.zeros_like(q) if warmth is None else engine.by_window(warmth)[..., joints]
    target = engine.by_window(motion.inputs["position_target"])[..., joints]
    load = i if np.ptp(i) > 0 else target - q  # a servo with its own loop pushes in proportion to its error
    x = np.stack([q, v, np.tanh(v / 0.05), load, load * v, warm, time], -1)
    spread = x.std((0, 1))
    x = (x - x.mean((0, 1))) / np.where(spread < 1e-4, 1e9, spread)
    made = [np.ones(q.shape)]
    for number in range(count - 1):
        picked = rng.choice(7, 2, replace=False, p=OFTEN / OFTEN.sum()) if number % 2 else rng.choice(5, 1)
        weight = np.zeros(7)
        weight[picked] = rng.standard_normal(len(picked)) / (1.5 if number % 4 < 2 else 0.6)
        made.append(np.sqrt(2) * np.cos(x @ weight + rng.uniform(0, 2 * np.pi)))
    return made
