"""What the robot's trunk carries beyond its model."""

from dataclasses import dataclass
from typing import ClassVar

from op3.servo.effect import Effect, ModelEdit, Parameter, Stage, register


@register
@dataclass(frozen=True)
class Payload(Effect):
    """Mass added to the base link at its centre of mass.

    The public model weighs 3.147 kg, the specification says about 3.5 kg: battery, cables and screws.
    """

    name: ClassVar[str] = "payload"
    stage: ClassVar[Stage] = Stage.BODY
    equation: ClassVar[str] = "m_base += dm"
    source: ClassVar[str] = "paper Table I, base mass offset"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("base_mass_offset", "kg", 0.0, 0.5, 0.25, 0.0, "added to the base link", per_joint=False),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = (ModelEdit("body_mass", "base_body", "add", "base_mass_offset"),)


@register
@dataclass(frozen=True)
class CentreOfMassOffset(Effect):
    """Shift of the base link's centre of mass, forwards and upwards."""

    name: ClassVar[str] = "com_offset"
    stage: ClassVar[Stage] = Stage.BODY
    equation: ClassVar[str] = "c_base += (dx, 0, dz)"
    source: ClassVar[str] = "paper Table I, base CoM offset x and z"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("base_com_offset_x", "m", -0.02, 0.02, 0.0, 0.0, "forwards", per_joint=False),
        Parameter("base_com_offset_z", "m", -0.02, 0.02, 0.0, 0.0, "upwards", per_joint=False),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = (
        ModelEdit("body_ipos", "base_body", "add", "base_com_offset_x", column=0),
        ModelEdit("body_ipos", "base_body", "add", "base_com_offset_z", column=2),
    )
