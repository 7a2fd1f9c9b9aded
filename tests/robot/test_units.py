"""Units and gravity have one home, and the files that cannot import it agree with it."""

import mujoco
import pytest

from op3.robot.register_units import (
    ACCELERATION_UNIT,
    ANGLE_UNIT,
    CURRENT_UNIT,
    GRAVITY,
    GYRO_UNIT,
    POSITION_UNIT,
    VELOCITY_UNIT,
    VOLTAGE_UNIT,
)
from op3.scenes import SCENES, build_scene


def test_units_are_those_of_the_manual():
    """A turn is 4096 counts, a rev/min 1 / 0.229 units, 2.69 mA, 0.1 V; gyro, accelerometer and angles full scale."""
    assert pytest.approx(6.283185307) == 4096 * POSITION_UNIT
    assert pytest.approx(0.0239808, rel=1e-5) == VELOCITY_UNIT
    assert pytest.approx(3.20917) == 1193 * CURRENT_UNIT
    assert pytest.approx(12.0) == 120 * VOLTAGE_UNIT
    assert pytest.approx(34.906585) == 32800 * GYRO_UNIT  # 2000 deg/s
    assert pytest.approx(19.6133) == 32768 * ACCELERATION_UNIT  # 2 g
    assert pytest.approx(3.14159265) == 1800 * ANGLE_UNIT


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_has_this_gravity(name):
    """The MJCF files say what the constant says."""
    model: mujoco.MjModel = build_scene(name, "op3").compile()
    assert model.opt.gravity.tolist() == [0.0, 0.0, -GRAVITY]
