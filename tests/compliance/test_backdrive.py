"""A joint that is turned gives way as its gain says, and its friction."""

import numpy as np
import pytest

from op3.compliance.backdrive import MOVED, back_drive
from op3.robot import load_robot, pose
from op3.servo import RobotModel
from op3.sim import load_model
from tests.op3_table import CONTROLLED_JOINTS


def measured(model: RobotModel, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """Break-away torque and slope at the stand pose, ``[joint, direction]``."""
    commands = {
        "position_target": pose("stand", "op3")[None],
        "p_gain": np.full((1, 20), gain),
        "d_gain": np.full((1, 20), 0.1),
    }
    found = back_drive(model, load_robot("op3"), pose("stand", "op3")[None], commands)
    return found.break_away[0], found.slope[0]


@pytest.fixture(scope="module")
def ideal() -> RobotModel:
    """Without losses in the gear, and with friction of 0.2 N m that does not depend on the speed."""
    return load_model("paper").without("dte", "stribeck", "viscous").with_values({"coulomb_friction": 0.2})


def test_slope_is_the_gain(ideal):
    """Without losses an ankle's slope is gain times torque constant times gear ratio, but for the foot's weight.

    2 A/rad * 0.006 N m/A * 353.5 = 4.24 N m/rad; gravity changes an ankle's torque by 0.02 N m/rad.
    """
    ankle = CONTROLLED_JOINTS.index("l_ank_pitch")
    break_away, slope = measured(ideal, 2.0)
    np.testing.assert_allclose(slope[ankle], 2 * 0.006 * 353.5, rtol=0.03)
    # it may rest anywhere within the band of its friction: both ways together take twice that, and the gain's part
    assert break_away[ankle].sum() == pytest.approx(2 * (0.2 + 4.24 * MOVED), abs=0.06)


def test_losses_make_it_stiffer(ideal):
    """A gear that loses a part of what drives it back takes more torque for the same angle."""
    lossy = load_model("paper").without("stribeck", "viscous").with_values({"backward_efficiency": 0.6})
    assert np.nanmedian(measured(lossy, 2.0)[1]) > 1.3 * np.nanmedian(measured(ideal, 2.0)[1])
