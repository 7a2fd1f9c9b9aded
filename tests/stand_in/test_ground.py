"""The stand-in on boards and uneven ground: the same motions as everywhere."""

import numpy as np
import pytest

from op3.robot import pose
from op3.scenes import Tilts, WeightSchedule, build_scene, draw_tiles
from op3.stand_in import HiddenWorld, StandIn


def test_board_follows_its_motion():
    """The board under a stand-in is where its motion says, within 0.1 mrad, and tilts what stands on it."""
    robot = StandIn(HiddenWorld(), build_scene("board", "op3"))
    motion = Tilts.draw(0)
    robot.set_ground(motion)
    robot.reset(pose("stand", "op3"))
    for _ in range(225):
        robot.write_current(6.0 * (pose("stand", "op3") - robot.read_sensors().position))
        robot.advance(0.008)
    angle, _ = motion.at(robot.time)
    np.testing.assert_allclose(robot._bodies.data.qpos[[28, 27]], angle, atol=1e-4)
    assert abs(angle[1]) > 0.1
    assert np.sign(robot.read_sensors().orientation[1]) == np.sign(angle[1])


def test_time_counts_from_the_call():
    """A board that is set in motion later moves later."""
    robot, motion = StandIn(HiddenWorld(), build_scene("board", "op3")), Tilts.draw(0)
    robot.reset(pose("stand", "op3"))
    robot.advance(0.3)
    robot.set_ground(motion)
    robot.advance(1.2)
    np.testing.assert_allclose(robot._bodies.data.qpos[[28, 27]], motion.at(1.2)[0], atol=5e-4)
    assert abs(motion.at(1.2)[0][1]) > 0.001


def test_reset_puts_the_robot_on_the_board():
    """A robot on the board of the weight starts tilted with it."""
    robot = StandIn(HiddenWorld(), build_scene("board_weight", "op3"))
    robot.set_ground(WeightSchedule.draw(0))
    robot.reset(pose("stand", "op3"))
    assert robot.read_sensors().orientation[1] == pytest.approx(np.deg2rad(6.0), abs=2e-3)


def test_hidden_friction_is_that_of_all_ground():
    """Bricks, tiles and boards have the friction of the world, as the floor has."""
    for name in ("board", "bricks_c", "terrain"):
        model = StandIn(HiddenWorld(foot_friction=0.66), build_scene(name, "op3"))._model
        ground = [model.geom(geom).id for geom in build_scene(name, "op3").ground]
        assert (model.geom_friction[ground, 0] == 0.66).all()
        assert len(ground) > 1


def test_tiles_are_placed():
    """The terrain of a seed has that seed's heights."""
    robot, heights = StandIn(HiddenWorld(), build_scene("terrain", "op3")), draw_tiles(4)
    robot.set_ground(tiles=heights)
    model = robot._model
    tops = [model.geom_pos[i, 2] + model.geom_size[i, 2] for i in range(model.ngeom) if "tile" in model.geom(i).name]
    np.testing.assert_allclose(tops, heights)


def test_wrong_ground():
    """A board's motion is refused where there is no board."""
    with pytest.raises(ValueError, match="moves the scene 'board'"):
        StandIn(HiddenWorld(), build_scene("floor", "op3")).set_ground(Tilts.draw(0))
