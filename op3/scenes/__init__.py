"""Supports of a robot: floors, tiles, boards, stands and benches as MJCF."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.scenes.board import BoardDrive, BoardMotion, Tilts, Waves, WeightDrive, WeightSchedule, board_drive, stack
    from op3.scenes.scene import SCENES, Scene, build_bench, build_scene
    from op3.scenes.surfaces import draw_tiles, place_tiles, tile_ids

__all__ = [
    "SCENES",
    "BoardDrive",
    "BoardMotion",
    "Scene",
    "Tilts",
    "Waves",
    "WeightDrive",
    "WeightSchedule",
    "board_drive",
    "build_bench",
    "build_scene",
    "draw_tiles",
    "place_tiles",
    "stack",
    "tile_ids",
]

__getattr__ = lazy(__name__)
