"""Bricks and tiles: heights, room for the start, and contacts that MuJoCo does not miss."""

import mujoco
import numpy as np
import pytest

from op3.robot import pose
from op3.scenes import build_scene, draw_tiles, place_tiles, tile_ids
from op3.scenes.surfaces import TILE_HEIGHT


@pytest.mark.parametrize(
    ("name", "highest"), [("bricks_a", 0.005), ("bricks_b", 0.005), ("bricks_c", 0.005), ("bricks_d", 0.010)]
)
def test_bricks(name, highest):
    """Bricks are 5 mm high, in one layer or two, and none lies under the robot that starts."""
    model = build_scene(name, "op3").compile()
    bricks = [i for i in range(model.ngeom) if model.geom(i).name.startswith("uneven/brick")]
    tops = model.geom_pos[bricks, 2] + model.geom_size[bricks, 2]
    assert tops.max() == pytest.approx(highest)
    assert (model.geom_pos[bricks, 0] - np.hypot(*model.geom_size[bricks, :2].T) > 0.08).all()
    assert len(bricks) > 100


def test_bricks_do_not_overlap():
    """In a layer, circles around bricks in neighbouring cells keep their centres a brick's width apart."""
    model = build_scene("bricks_b", "op3").compile()
    bricks = [i for i in range(model.ngeom) if model.geom(i).name.startswith("uneven/brick")]
    places = model.geom_pos[bricks, :2]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.eye(len(places))
    assert apart.min() > 0.08


@pytest.mark.parametrize("seed", [0, 1])
def test_lowered_tiles_are_met(seed):
    """With tiles lowered after compiling, a foot finds the same contacts as without MuJoCo's bounding volumes."""
    model = build_scene("terrain", "op3").compile()
    place_tiles(model.geom_pos, tile_ids(model), draw_tiles(seed))
    rng = np.random.default_rng(seed)
    scene = build_scene("terrain", "op3")
    found = []
    for enabled in (True, False):
        if not enabled:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        data, rng = mujoco.MjData(model), np.random.default_rng(seed)
        contacts = []
        for _ in range(20):
            data.qpos[:] = scene.initial_qpos(pose("stand", "op3"))
            data.qpos[:2] = rng.uniform((0.3, -0.2), (3.0, 0.2))
            data.qpos[2] += rng.uniform(-0.002, 0.01)
            mujoco.mj_forward(model, data)
            contacts.append(sorted((tuple(c.geom), round(c.dist, 9)) for c in data.contact))
        found.append(contacts)
    assert found[0] == found[1]
    assert sum(map(len, found[0])) > 20


def test_tiles_are_drawn():
    """Heights of a seed are fixed, differ from another seed's, and stay between floor and compiled height."""
    heights = draw_tiles(0)
    np.testing.assert_array_equal(heights, draw_tiles(0))
    assert not np.array_equal(heights, draw_tiles(1))
    assert heights.min() >= 0.0
    assert heights.max() <= TILE_HEIGHT
    np.testing.assert_allclose(draw_tiles(0, 0.4 * TILE_HEIGHT), 0.4 * heights)
    kinds = [len(np.unique(draw_tiles(seed, steps=0.5))) for seed in range(40)]
    assert 10 < sum(kind <= 2 for kind in kinds) < 30  # on the floor or high, nothing between
    assert len(heights) == len(tile_ids(build_scene("terrain", "op3").compile()))
    assert len(tile_ids(build_scene("floor", "op3").compile())) == 0
