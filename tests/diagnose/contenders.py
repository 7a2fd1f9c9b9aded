"""Contenders of synthetic decisions."""

import numpy as np

from op3.diagnose.evidence import Contender

BLOCKS = 60
"""Seconds of the logs."""


def contender(label: str, gain: float, *, seed: int = 0, size: float = 1.0, noise: float = 0.02) -> Contender:
    """An effect that explains about as much in every second."""
    rng = np.random.default_rng(seed)
    losses = 1.0 - gain + noise * rng.normal(size=BLOCKS)
    effect, _, joint = label.partition("@")
    joints = (int(joint),) if joint else None
    return Contender(label, effect, joints, effect, gain, gain, losses, size, 0.1, False)
