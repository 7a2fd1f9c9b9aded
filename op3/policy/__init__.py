"""Policies as files: what a trained policy reads, what it commands, and its inference."""

from op3.policy.actions import ActionMap
from op3.policy.bundle import PolicyBundle
from op3.policy.leg_kinematics import LegKinematics, leg_kinematics
from op3.policy.manifest import Manifest, Training
from op3.policy.observation import BALANCE_LAYOUT, WALK_LAYOUT, History, layout_slices, observe

__all__ = [
    "BALANCE_LAYOUT",
    "WALK_LAYOUT",
    "ActionMap",
    "History",
    "LegKinematics",
    "Manifest",
    "PolicyBundle",
    "Training",
    "layout_slices",
    "leg_kinematics",
    "observe",
]
