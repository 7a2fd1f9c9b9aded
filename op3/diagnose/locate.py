"""Where simulation and logs disagree: residual torque by joint and regime, beside how large the gap is in all.

Within every window the torque that explains the residual is estimated in pieces of 50 ms.
Its means by joint, speed, driving or driven, and load form a fixed family of cells; flipping the signs of whole seconds
tells how large the largest of them would be by chance.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from op3.diagnose.fitting import Fit
from op3.diagnose.windows import FLOOR, WindowResiduals

REST = 0.02
"""Joints slower than this are held by friction, and a small torque does not move them [rad/s]."""

SPEEDS = {"slow": (REST, 0.2), "middling": (0.2, 1.0), "fast": (1.0, np.inf)}
"""Regimes of speed [rad/s]."""

PIECES = 4
"""Pieces of a window in each of which the residual torque is constant."""

NOISY = 1.5
"""Times the usual noise of a velocity reading beyond which the logs' own counts in its place."""

PRIOR = 0.1
"""Prior standard deviation of the residual torque of a piece [N m]."""

FLIPS = 400
"""Random signs of seconds from which chance is told."""

FEWEST = 6
"""Seconds that a cell must be seen in."""


@dataclass(frozen=True)
class Cell:
    """Mean residual torque in one regime.

    Attributes:
        joint: name.
        speed: key of `SPEEDS`.
        driven: ``driving``, the motor moves the load, or ``back-driven``.
        load: ``low`` or ``high``, below or above the joint's median.
        torque: mean in the direction of motion [N m].
        statistic: mean over its standard error, seconds being independent.
        chance: how often the largest of all cells is as large by chance.
    """

    joint: str
    speed: str
    driven: str
    load: str
    torque: float
    statistic: float
    chance: float

    def plain(self) -> dict[str, Any]:
        """Plain values for YAML."""
        numbers = {"torque": round(self.torque, 4), "t": round(self.statistic, 2), "chance": round(self.chance, 4)}
        return {"joint": self.joint, "speed": self.speed, "driven": self.driven, "load": self.load, **numbers}


class Response:
    """How windows answer to small torques, to first order: the joints' inertia, and stiction that holds what rests.

    Args:
        engine: whose windows.
        parameters: of the base, ``[1, joint]``; they give the rotors' inertia.
    """

    def __init__(self, engine: WindowResiduals, parameters: Mapping[str, Tensor]):
        self.engine = engine
        armature = parameters["armature"][0].numpy() if "armature" in parameters else 0.0
        mass = engine.by_window(engine.motion.dynamics.mass, end=True) + np.eye(len(engine.joints)) * armature
        self.mobility = np.linalg.inv(mass)  # [window, tick, joint, joint]
        self.moves = (np.abs(engine.by_window(engine.motion.velocity, end=True)) > REST).astype(float)

    def __call__(self, torque: np.ndarray, joint: int) -> np.ndarray:
        """Whitened change of the residual, ``[window, residual, feature]``; `torque` is ``[window, tick, feature]``."""
        engine, period = self.engine, self.engine.period
        windows, ticks, features = torque.shape
        change = np.zeros((features, windows, ticks + 1, len(engine.joints), len(engine.channels)), dtype=np.float32)
        at = {key[1]: k for k, key in enumerate(engine.channels)}
        v = np.zeros((windows, len(engine.joints), features))
        q = np.zeros_like(v)
        for tick in range(ticks):
            push = self.mobility[:, tick, :, joint, None] * torque[:, tick, None, :]
            v = (v + period * push) * self.moves[:, tick, :, None]
            q = q + period * v
            change[:, :, tick + 1, :, at["position"]] = q.transpose(2, 0, 1)
            if "velocity" in at:
                change[:, :, tick + 1, :, at["velocity"]] = v.transpose(2, 0, 1)
        return np.moveaxis(engine.whiten(change), 0, -1)


def remaining(engine: WindowResiduals, residual: np.ndarray) -> np.ndarray:
    """How large residuals are, in standard deviations of a velocity reading; root mean squares ``[joint]``.

    Whitening makes residuals relative to what is usual in these logs; this undoes it, so that a gap that all windows
    share is seen too.
    """
    count = len(engine.channels)
    plain = engine.unwhitened(residual).reshape(len(residual), engine.ticks + 1, len(engine.joints), count)
    velocity = ("joint", "velocity") in engine.channels
    at = engine.channels.index(("joint", "velocity") if velocity else engine.channels[0])
    noise = np.full(len(engine.joints), FLOOR[engine.channels[at]])
    if velocity:
        told = engine.smooth_logs[0].sensing.spread
        noise = np.where(told > NOISY * noise, told, noise)
    return np.sqrt(np.square(plain[..., at] / noise).mean((0, 1)))


def residual_torque(
    engine: WindowResiduals,
    parameters: Mapping[str, Tensor],
    residual: np.ndarray,
    pieces: int = PIECES,
    prior: float = PRIOR,
) -> np.ndarray:
    """Torque that the model lacks, ``[window, piece, joint]`` [N m], by ridge regression in each window.

    Args:
        engine: whose windows.
        parameters: see `Response`.
        residual: simulated minus measured, ``[window, residual]``.
        pieces: of a window, in each of which the torque is constant.
        prior: standard deviation that is expected [N m].
    """
    response = Response(engine, parameters)
    piece = (np.arange(engine.ticks) * pieces // engine.ticks)[:, None] == np.arange(pieces)
    pulses = np.broadcast_to(piece.astype(float), (len(residual), *piece.shape))
    columns = np.concatenate([response(pulses, j) for j in range(len(engine.joints))], -1).astype(np.float64)
    gram = columns.transpose(0, 2, 1) @ columns + np.eye(columns.shape[-1]) / prior**2
    lacking = np.linalg.solve(gram, -(columns.transpose(0, 2, 1) @ residual[..., None].astype(np.float64)))
    return lacking[..., 0].reshape(len(residual), len(engine.joints), pieces).transpose(0, 2, 1)


def locate(engine: WindowResiduals, base: Fit, seed: int = 0) -> list[Cell]:
    """Cells in which the model lacks torque, the surest first.

    Args:
        engine: whose windows.
        base: with its residual.
        seed: of the random signs.
    """

    def by_piece(values: np.ndarray) -> np.ndarray:
        parts = np.array_split(engine.by_window(values), PIECES, 1)
        return np.stack([part.mean(1) for part in parts], 1)  # [window, piece, joint]

    torque = residual_torque(engine, base.parameters, base.residual)
    v, i, load = (by_piece(x) for x in (engine.motion.velocity, engine.motion.current, engine.motion.dynamics.bias))
    oriented = torque * np.sign(v)
    second = np.unique(engine.blocks, return_inverse=True)[1]
    cells: list[tuple[tuple[str, str, str, str], float]] = []
    sums = []
    heavy = np.abs(load) > np.median(np.abs(load), (0, 1))
    for j, joint in enumerate(engine.joints):
        for speed, (low, high) in SPEEDS.items():
            for driven in ("driving", "back-driven"):
                for weight in ("low", "high"):
                    inside = (np.abs(v[..., j]) >= low) & (np.abs(v[..., j]) < high)
                    inside &= ((v * i)[..., j] > 0) == (driven == "driving")
                    inside &= heavy[..., j] == (weight == "high")
                    seen = np.bincount(second, inside.sum(1)) > 0
                    if seen.sum() < FEWEST:
                        continue
                    sums.append(np.bincount(second, (oriented[..., j] * inside).sum(1)))
                    cells.append(((joint, speed, driven, weight), float(oriented[..., j][inside].mean())))
    if not cells:
        return []
    total = np.stack(sums)  # [cell, second]
    scale = np.sqrt(np.square(total).sum(1)) + 1e-12
    statistic = total.sum(1) / scale
    signs = np.random.default_rng([seed, 19]).choice([-1.0, 1.0], size=(total.shape[1], FLIPS))
    largest = np.abs(total @ signs / scale[:, None]).max(0)
    found = [
        Cell(*regime, mean, float(t), float((1 + (largest >= abs(t)).sum()) / (1 + FLIPS)))
        for (regime, mean), t in zip(cells, statistic, strict=True)
    ]
    return sorted(found, key=lambda cell: -abs(cell.statistic))
