"""The catalogue of effects; importing it registers them all."""

from op3.servo.effects.body import CentreOfMassOffset, Payload
from op3.servo.effects.drive import CurrentPD, Latency, PositionServo
from op3.servo.effects.friction import Coulomb, Stribeck, Viscous
from op3.servo.effects.gear import DirectionalEfficiency
from op3.servo.effects.motor import Motor
from op3.servo.effects.sensing import EncoderOffset

__all__ = [
    "CentreOfMassOffset",
    "Coulomb",
    "CurrentPD",
    "DirectionalEfficiency",
    "EncoderOffset",
    "Latency",
    "Motor",
    "Payload",
    "PositionServo",
    "Stribeck",
    "Viscous",
]
