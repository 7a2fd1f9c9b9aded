"""The library of excitations: safe by construction, checked with MuJoCo, and each does what it is for."""

from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate

from op3.apps.compose import composed
from op3.common.assets import named_configs
from op3.motions import (
    Motion,
    check_motion,
    chirp,
    hold,
    motion_faults,
    multisine,
    push_down,
    soften,
    staircase,
    sway,
    triangle,
)
from op3.motions.op3_motions import SQUAT_LEAN
from op3.robot import pose
from op3.robot.kinematics import rotation_matrix, sole_normals
from tests.op3_table import indices

CONF = Path(__file__).resolve().parents[2] / "conf"
GENERAL = {path.stem for path in (CONF / "motion").glob("*.yaml") if "${robot}" in path.read_text()}
KNEE = indices(["l_knee"])[0]


def configured(name: str) -> Motion:
    """A motion as `collect.py motion=<name>` builds it."""
    robot = "arm" if name in GENERAL else "op3"
    return instantiate(composed("collect", [f"motion={name}", f"robot={robot}"]).motion)


@pytest.mark.parametrize("name", named_configs("motion"))
def test_every_motion_of_the_library_is_safe(name):
    """Soft limits, speed and 5 mm between parts are kept, the name is its file's, and it starts at rest."""
    motion = configured(name)
    assert motion_faults(motion) == []
    assert motion.name == name
    assert np.abs(np.diff(motion.position, axis=0)[0]).max() * 125 < 0.5
    assert 2.0 < motion.duration < 15.0


def test_a_chirp_sweeps_from_low_to_high():
    """Zero crossings per second grow from twice the low to twice the high frequency; other joints do not move."""
    motion = chirp({"l_knee": 0.3}, low=0.5, high=4.0, duration=10.0, speed=10.0, robot="op3")
    angle = motion.position[:, KNEE] - pose("stand", "op3")[KNEE]
    # exponential sweep: f(t) = 0.5 * 8^(t/10); in the first second about 0.5 cycles, from 8 to 9 s about 2.9
    crossings = np.flatnonzero(np.diff(np.sign(angle[1:-1]))) / 125
    assert np.sum((crossings > 0.2) & (crossings < 2.2)) in (2, 3)
    assert np.sum((crossings > 8.0) & (crossings < 9.0)) in (5, 6)
    others = np.delete(motion.position, KNEE, axis=1)
    assert np.ptp(others, axis=0).max() == 0.0


def test_a_triangle_moves_at_constant_speed():
    """Nine tenths of a slow triangle pass at the speed asked for, the same in both directions."""
    motion = triangle({"l_knee": 0.4, "r_knee": -0.2}, speed=0.2, acceleration=2.0, cycles=1, robot="op3")
    knees = indices(["l_knee", "r_knee"])
    left, right = motion.position[:, knees].T - pose("stand", "op3")[knees][:, None]
    speed = np.diff(left) * 125
    at_speed = np.abs(np.abs(speed) - 0.2) < 1e-3
    assert at_speed.mean() > 0.9
    assert np.sum(speed[at_speed] > 0) == pytest.approx(np.sum(speed[at_speed] < 0), rel=0.05)
    np.testing.assert_allclose(right, -0.5 * left, atol=1e-12)
    assert left.max() == pytest.approx(0.4, abs=1e-3)


def test_multisine_lines_are_distinct():
    """In the spectrum no two joints share a line, so their effects can be told apart."""
    joints = {"l_knee": 0.3, "l_hip_pitch": 0.2, "l_ank_pitch": 0.3}
    motion = multisine(joints, duration=20.0, lines=4, robot="op3")
    # the fade spreads each line a little: the strongest lines are compared
    spectra = np.abs(np.fft.rfft(motion.position[:, indices(joints)] - pose("stand", "op3")[indices(joints)], axis=0))
    strongest = [set(np.argsort(spectrum)[-2:]) for spectrum in spectra.T]
    assert len(set.union(*strongest)) == 6
    assert np.abs(motion.position[:, KNEE] - pose("stand", "op3")[KNEE]).max() == pytest.approx(0.3)


def test_staircase_reaches_a_level_from_both_sides():
    """The knee rests at half its amplitude on the way up and on the way down."""
    motion = staircase({"l_knee": 0.4}, levels=(0.5, 1.0, 0.5), ramp=0.4, rest=0.8, robot="op3")
    angle = motion.position[:, KNEE] - pose("stand", "op3")[KNEE]
    resting = np.isclose(angle, 0.2, atol=1e-12)
    assert np.sum(np.diff(resting.astype(int)) == 1) == 2


def test_push_down_and_sway_keep_the_soles_level():
    """On the floor the soles stay level, so the robot stands on them throughout."""
    for motion, lean in ((push_down(), SQUAT_LEAN), (sway(), 0.0)):
        for position in motion.position[::60]:
            normals = sole_normals(position, "op3") @ rotation_matrix(0.0, lean).T
            np.testing.assert_allclose(normals[0], normals[1], atol=1e-9)
            # "stand" is level to the digits of its source
            assert np.arccos(np.clip(normals[0, 2], -1, 1)) < 1e-3


def test_soften_lowers_the_gain_and_raises_it_again():
    """The command stays, the gain goes from 6 to the lowest and back."""
    motion = soften(p_gain=2.5, cycles=1)
    assert np.ptp(motion.position, axis=0).max() == 0.0
    gain = np.asarray(motion.p_gain)
    assert gain[[0, -1]] == pytest.approx([6.0, 6.0])
    assert gain.min() == pytest.approx(2.5, rel=1e-3)


@pytest.mark.parametrize(
    ("motion", "mount", "message"),
    [
        (
            hold(pose("stand", "op3") + 3.0 * (np.arange(20) == 11), 1.0, robot="op3"),
            None,
            r"commands l_knee to 4.131 rad",
        ),
        (triangle({"l_knee": 0.8}, speed=6.0, acceleration=100.0, robot="op3"), "stand", r"moves l_knee at 6.00 rad/s"),
        (triangle({"l_hip_roll": 0.3}, cycles=1, robot="op3"), "stand", r"brings \w+ within .* mm of \w+"),
        (chirp({"l_knee": 0.1}, robot="op3"), "floor", r"not for the floor; choose mount=stand"),
    ],
)
def test_unsafe_motions_are_refused(motion, mount, message):
    """Each fault is told with the joint or part, the time and the limit."""
    with pytest.raises(ValueError, match=message):
        check_motion(motion, mount)


def test_a_gain_of_the_wrong_length_is_refused():
    """One gain, or one per row."""
    with pytest.raises(ValueError, match="one per row"):
        Motion(np.arange(3.0), np.zeros((3, 20)), p_gain=np.ones(2), robot="op3")
