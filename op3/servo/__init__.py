"""The servo model, computed once per millisecond, and its catalogue of effects."""

from op3.servo import effects as _registered  # noqa: F401
from op3.servo.effect import (
    Effect,
    ModelEdit,
    Parameter,
    Scope,
    Stage,
    Usual,
    catalogue,
    effect_class,
    parameter,
    register,
)
from op3.servo.robot_model import Estimate, RobotModel
from op3.servo.servos import Servos, Signals
from op3.servo.signals import Trunk

__all__ = [
    "Effect",
    "Estimate",
    "ModelEdit",
    "Parameter",
    "RobotModel",
    "Scope",
    "Servos",
    "Signals",
    "Stage",
    "Trunk",
    "Usual",
    "catalogue",
    "effect_class",
    "parameter",
    "register",
]
