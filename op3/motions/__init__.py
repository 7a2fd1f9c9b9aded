"""Excitation motions for any robot; motions specific to the OP3 are in `op3_motions` and `op3_suites`."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.motions.excitations import chirp, multisine, staircase, triangle
    from op3.motions.motion import Motion, hold
    from op3.motions.motion_checks import check_motion, motion_faults
    from op3.motions.op3_motions import SinusoidalGait, push_down, soften, squat, sway
    from op3.motions.op3_suites import Excitation, leg_suite, leg_walking, robot_suite, robot_walking

__all__ = [
    "Excitation",
    "Motion",
    "SinusoidalGait",
    "check_motion",
    "chirp",
    "hold",
    "leg_suite",
    "leg_walking",
    "motion_faults",
    "multisine",
    "push_down",
    "robot_suite",
    "robot_walking",
    "soften",
    "squat",
    "staircase",
    "sway",
    "triangle",
]

__getattr__ = lazy(__name__)
