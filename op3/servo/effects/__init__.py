# ruff: noqa: F401
"""The catalogue of effects; importing it registers them all."""

from op3.servo.effects.body import CentreOfMassOffset, LinkCentreOfMass, LinkInertia, LinkMass, Payload
from op3.servo.effects.bus import PacketDrop
from op3.servo.effects.drive import CurrentPD, Latency, MinimumDuty, PositionServo
from op3.servo.effects.electrical import (
    CurrentLag,
    CurrentOffset,
    TerminalResistance,
    TorqueConstant,
    TorqueConstantTemperature,
    VoltageSag,
)
from op3.servo.effects.friction import AsymmetricFriction, BearingFriction, Coulomb, QuadraticDrag, Stribeck, Viscous
from op3.servo.effects.gear import DirectionalEfficiency, MixedLubrication
from op3.servo.effects.ground import FootCompliance, FootFriction, GroundTilt
from op3.servo.effects.load import AntagonisticFriction, DirectionalFriction, LoadFriction
from op3.servo.effects.motor import Motor
from op3.servo.effects.position import CableSpring, Cogging, PositionFriction
from op3.servo.effects.presliding import LuGre
from op3.servo.effects.sensing import EncoderNonlinearity, EncoderOffset, VelocityFilter
from op3.servo.effects.transmission import Backlash, Compliance
from op3.servo.effects.trunk import GyroBias, ImuMount
from op3.servo.effects.variation import FrictionDrift, LeftRightAsymmetry
