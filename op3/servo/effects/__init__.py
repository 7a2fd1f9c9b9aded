"""The catalogue of effects; importing it registers them all."""

from op3.servo.effects.body import CentreOfMassOffset, LinkInertia, Payload
from op3.servo.effects.drive import CurrentPD, Latency, MinimumDuty, PositionServo
from op3.servo.effects.friction import BearingFriction, Coulomb, Stribeck, Viscous
from op3.servo.effects.gear import DirectionalEfficiency
from op3.servo.effects.load import AntagonisticFriction, DirectionalFriction, LoadFriction
from op3.servo.effects.motor import Motor
from op3.servo.effects.sensing import EncoderOffset

__all__ = [
    "AntagonisticFriction",
    "BearingFriction",
    "CentreOfMassOffset",
    "Coulomb",
    "CurrentPD",
    "DirectionalEfficiency",
    "DirectionalFriction",
    "EncoderOffset",
    "Latency",
    "LinkInertia",
    "LoadFriction",
    "MinimumDuty",
    "Motor",
    "Payload",
    "PositionServo",
    "Stribeck",
    "Viscous",
]
