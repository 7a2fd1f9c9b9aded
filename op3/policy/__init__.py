"""Policies as files: observations, actions and inference."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.policy.actions import ActionMap
    from op3.policy.bundle import PolicyBundle
    from op3.policy.forward_kinematics import leg_kinematics
    from op3.policy.manifest import Manifest, Training
    from op3.policy.observation import Observer, layout_slices
    from op3.policy.observations import Sensed

__all__ = [
    "ActionMap",
    "Manifest",
    "Observer",
    "PolicyBundle",
    "Sensed",
    "Training",
    "layout_slices",
    "leg_kinematics",
]

__getattr__ = lazy(__name__)
