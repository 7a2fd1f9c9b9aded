"""Policies as files: what a trained policy reads, what it commands, and its inference."""

from op3.policy.actions import ActionMap
from op3.policy.bundle import PolicyBundle
from op3.policy.manifest import Manifest, Training

__all__ = ["ActionMap", "Manifest", "PolicyBundle", "Training"]
