"""A motion simulated to a log."""

import numpy as np

from op3.motions import Motion, soften, squat
from op3.replay import simulate_motion
from op3.sim import load_model


def test_a_motions_own_gains_are_played():
    """The log holds the gain of every row, the same for all joints."""
    motion = soften(cycles=1, period=0.3)
    log = simulate_motion(load_model("paper"), motion)
    np.testing.assert_array_equal(log.array("command/p_gain"), np.tile(motion.p_gain[:, None], (1, 20)))
    assert log.metadata.mount == "floor"


def test_a_fall_is_noticed():
    """A robot that leans far over its toes falls, and its log says so."""
    lean = squat(lean=0.3, duration=1.5, knee_low=1.2, knee_high=1.2)
    position = lean.position.copy()
    names = list(lean.joints)
    for side, sign in (("l", 1.0), ("r", -1.0)):
        position[:, names.index(f"{side}_ank_pitch")] += sign * np.linspace(0.0, 0.7, len(position))
    log = simulate_motion(load_model("paper"), Motion(lean.time, position, lean.joints, "lean", robot="op3"), "floor")
    assert log.metadata.fallen == (np.abs(log.array("imu/orientation")[:, :2]).max() > np.deg2rad(45))
    assert log.metadata.fallen is True
