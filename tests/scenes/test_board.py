"""Boards: motions as functions of time, and drives that make the physics follow them."""

import mujoco
import numpy as np
import pytest

from op3.robot import pose
from op3.scenes import BoardDrive, Tilts, Waves, WeightDrive, WeightSchedule, build_scene
from op3.scenes.board import TILT, WAVE_AMPLITUDE, WEIGHT_DISTANCE, WEIGHT_MASS, stack

PERIOD = 0.008
TIMES = np.linspace(0.0, 10.0, 20001)


@pytest.mark.parametrize("motion", [Waves.draw(0), Waves.draw(5), Tilts.draw(0), Tilts.draw(3)])
def test_derivatives(motion):
    """The rate is the derivative of the angle, by central differences."""
    angle, rate = motion.at(TIMES)
    np.testing.assert_allclose(np.gradient(angle, TIMES[1], axis=0)[1:-1], rate[1:-1], atol=1e-4)


def test_waves_are_bounded_and_start_level():
    """Waves of any seed stay within 10 degrees on each axis, start level and at rest, and differ by seed."""
    seen = [Waves.draw(seed).at(TIMES)[0] for seed in range(30)]
    assert max(np.abs(angle).max() for angle in seen) <= WAVE_AMPLITUDE
    assert max(np.abs(angle).max() for angle in seen) > 0.6 * WAVE_AMPLITUDE
    for seed in range(5):
        for value in Waves.draw(seed).at(0.0):
            np.testing.assert_array_equal(value, 0.0)
    assert not np.allclose(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], Waves.draw(0).at(TIMES)[0])
    larger, _ = Waves.draw(0, 1.5 * WAVE_AMPLITUDE).at(TIMES)
    np.testing.assert_allclose(larger, 1.5 * seen[0])


def test_tilts_reach_six_degrees_to_both_sides():
    """The board is level for a second, then rests at +-6 degrees of pitch, and never rolls."""
    for seed in range(10):
        angle, _ = Tilts.draw(seed).at(TIMES)
        assert np.abs(angle[TIMES <= 1.0]).max() == 0.0
        assert angle[:, 1].max() == pytest.approx(TILT, rel=1e-9)
        assert angle[:, 1].min() == pytest.approx(-TILT, rel=1e-9)
        assert np.abs(angle[:, 0]).max() == 0.0


def test_stacked_motions_are_their_parts():
    """Many motions at times of their own equal each alone."""
    for kind in (Waves, Tilts):
        motions, times = [kind.draw(seed) for seed in range(4)], np.array([0.5, 1.7, 4.2, 9.0])
        together = stack(motions).at(times)
        for i, motion in enumerate(motions):
            for many, one in zip(together, motion.at(times[i]), strict=True):
                np.testing.assert_array_equal(many[i], one)


def test_board_is_driven():
    """While a limp robot collapses on it, the board is within 0.5 mrad and 0.05 rad/s of its motion."""
    scene = build_scene("board", "op3")
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(pose("stand", "op3"))
    drive, motion = BoardDrive(model, PERIOD), Waves.draw(5)
    for tick in range(250):
        drive.apply(motion, tick * PERIOD, data.qpos, data.qvel, data.qfrc_applied)
        mujoco.mj_step(model, data, 8)
        angle, rate = motion.at((tick + 1) * PERIOD)
        np.testing.assert_allclose(data.qpos[[28, 27]], angle, atol=5e-4)
        np.testing.assert_allclose(data.qvel[[27, 26]], rate, atol=0.05)
    assert data.ncon > 0
    assert not any(warning.number for warning in data.warning)


def test_weight_tips_the_board():
    """Without a robot the board lies as it was put until the weight is lowered behind its axis, then at its stop."""
    scene = build_scene("board_weight", "op3")
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(pose("stand", "op3"))
    data.qpos[0] = 3.0  # the robot falls beside the board
    data.qpos[27] = 0.5 * TILT
    drive, schedule = WeightDrive(model), WeightSchedule(np.array(1.0))
    heights = []
    for tick in range(500):
        drive.apply(schedule, tick * PERIOD, data.qpos, data.qvel, data.qfrc_applied)
        mujoco.mj_step(model, data, 8)
        heights.append(data.body("board/weight").xpos[2])
        if tick * PERIOD < 1.0:
            assert data.qpos[27] == pytest.approx(0.5 * TILT, abs=1e-6)
    assert data.qpos[27] == pytest.approx(-TILT, abs=0.005)
    # the hand has let go, and lowered it no faster than 0.15 m/s
    assert data.qfrc_applied[model.joint("board/weight").dofadr[0]] == 0.0
    assert np.diff(heights).min() / PERIOD > -0.15
    assert model.body("board/weight").mass[0] == WEIGHT_MASS
    assert model.body("board/weight").pos[0] == -WEIGHT_DISTANCE


def test_robot_starts_on_the_tilted_board():
    """On the board at its front stop all sole boxes touch and nothing penetrates."""
    scene = build_scene("board_weight", "op3")
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(pose("stand", "op3"))
    data.qpos[2] -= 1e-5
    mujoco.mj_forward(model, data)
    top = model.geom("board/top").id
    assert sum(top in contact.geom for contact in data.contact) == 16
    assert np.abs(data.contact.dist).max() < 2e-5
