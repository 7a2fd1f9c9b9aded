"""Uneven ground: fixed surfaces of bricks, and tiles whose heights are redrawn for every simulation.

The robot starts at the origin on the level floor; what is uneven begins ahead of it.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BRICK = (0.04, 0.02, 0.0025)
"""Half sizes of a brick [m]: 80 x 40 x 5 mm."""

BRICK_SURFACES: dict[str, tuple[int, float, float]] = {
    "bricks_a": (0, 1.0, 0.0),
    "bricks_b": (1, 0.7, 0.0),
    "bricks_c": (3, 0.95, 0.0),
    "bricks_d": (2, 0.7, 0.5),
}
"""Seed, share of cells with a brick, share of those that carry a second one: 10 mm high.

The first three are 5 mm high, as the paper's; the last is ours.
"""

_CELL = (0.12, 0.10)
_FIRST, _LAST, _HALF_WIDTH = 0.16, 3.5, 0.3

TILE = 0.05
"""Half side of a tile of the terrain [m]."""

TILE_HEIGHT = 0.010
"""Highest tile of the terrain above the floor [m]; ours, twice the bricks of the test surfaces."""

_TILE_DEPTH = 0.02


def _cells(size: tuple[float, float]) -> Array:
    """Centres of the cells ahead of the robot, [cell, xy]."""
    x = np.arange(_FIRST + size[0] / 2, _LAST, size[0])
    y = np.arange(-_HALF_WIDTH + size[1] / 2, _HALF_WIDTH, size[1])
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def add_bricks(root: Any, name: str) -> None:
    """Lay the bricks of a surface on the floor.

    Args:
        root: dm_control MJCF root with a default class "ground" and materials "brick" and "brick_high".
        name: a name in `BRICK_SURFACES`. "bricks_a" is a regular pattern, "bricks_b" irregular, "bricks_c" irregular
            and dense, "bricks_d" irregular with a second layer.
    """
    seed, filled, doubled = BRICK_SURFACES[name]
    rng = np.random.default_rng([seed, 21])
    for number, centre in enumerate(_cells(_CELL)):
        shift, turn = rng.uniform(-1.0, 1.0, 2) * (0.014, 0.005), rng.uniform(0.0, np.pi)
        lay, double = rng.uniform(size=2)
        if name == "bricks_a":
            shift, turn = np.zeros(2), np.pi / 2 * (number % 2)
        if lay >= filled:
            continue
        for layer in range(2 if double < doubled else 1):
            angle = (turn + layer * np.pi / 2) / 2
            place = [*(centre + shift), BRICK[2] * (1 + 2 * layer)]
            brick = _box(root, f"brick_{number:03d}_{layer}", BRICK, place, "brick_high" if layer else "brick")
            brick.quat = [np.cos(angle), 0.0, 0.0, np.sin(angle)]


def _box(root: Any, name: str, size: Sequence[float], place: Sequence[float], material: str) -> Any:
    kind = {"dclass": "ground", "type": "box"}
    return root.worldbody.add("geom", name=name, size=size, pos=place, material=material, **kind)


def add_tiles(root: Any) -> None:
    """Lay the tiles of the terrain, all at their greatest height.

    MuJoCo's bounding volumes are made of the compiled places, so simulations may lower tiles but not raise them.

    Args:
        root: dm_control MJCF root with a default class "ground" and a material "brick".
    """
    for number, (x, y) in enumerate(_cells((2 * TILE, 2 * TILE))):
        _box(root, f"tile_{number:03d}", [TILE, TILE, _TILE_DEPTH], [x, y, TILE_HEIGHT - _TILE_DEPTH], "brick")


def tile_ids(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Geom ids [tile] of the terrain's tiles in a compiled model; empty where there is no terrain."""
    return np.array([i for i in range(model.ngeom) if model.geom(i).name.startswith("uneven/tile_")], dtype=np.int64)


def draw_tiles(seed: int, highest: float = TILE_HEIGHT, steps: float = 0.0) -> Array:
    """Heights [tile] of a seed's terrain above the floor [m], up to `highest`.

    With the probability `steps` all tiles lie either on the floor or at the largest height, a drawn share of them high;
    else the heights are uniform.
    """
    rng = np.random.default_rng([seed, 22])
    shares = rng.uniform(0.0, 1.0, len(_cells((2 * TILE, 2 * TILE))))
    lot, filled = np.random.default_rng([seed, 23]).uniform(0.0, 1.0, 2)
    return highest * (np.where(shares < filled, 1.0, 0.0) if lot < steps else shares)


def place_tiles(geom_pos: Array, tiles: NDArray[np.int64], heights: Array) -> None:
    """Write tile heights ``[..., tile]`` into a model's geom positions ``[..., geom, xyz]``."""
    geom_pos[..., tiles, 2] = heights - _TILE_DEPTH
