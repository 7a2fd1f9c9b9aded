"""What bodies carry beyond their models."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from op3.servo.effect import Effect, ModelEdit, Parameter, Scope, Stage, register


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
    size: ClassVar[str] = "base_mass_offset"
    smallest: ClassVar[float] = 0.02
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"base_mass_offset": 0.1},)
    fingerprint: ClassVar[str] = (
        "in the phase of gravity, in fixed ratio over all joints that carry the base link; a step between recordings"
    )
    confounders: ClassVar[tuple[str, ...]] = ("com_offset", "link_mass", "torque_constant")
    separating_experiment: ClassVar[str] = "add a known mass; turn the base"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("robot",)


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
    size: ClassVar[str] = "base_com_offset_x"
    smallest: ClassVar[float] = 0.002
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"base_com_offset_x": 0.005}, {"base_com_offset_z": 0.005})
    fingerprint: ClassVar[str] = "in the phase of gravity of the base link, turning with the pose"
    confounders: ClassVar[tuple[str, ...]] = ("payload", "encoder_offset", "cable_spring", "imu_mount", "ground_tilt")
    separating_experiment: ClassVar[str] = "turn the base: gravity turns, a spring does not; a known added mass"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("robot",)


@register
@dataclass(frozen=True)
class LinkInertia(Effect):
    """Inertia of the moved link about its own centre of mass, beyond its model.

    On a bench whose weight is modelled as a point, this is the weight's own: ``m k^2`` with its radius of gyration k.
    """

    name: ClassVar[str] = "link_inertia"
    stage: ClassVar[Stage] = Stage.BODY
    equation: ClassVar[str] = "J_link += m_link k^2"
    source: ClassVar[str] = "rigid body; a disc of radius r about its axis has k^2 = r^2 / 2"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gyration_squared", "m^2", 0.0, 0.0125, 0.0, 0.0, "squared radius of gyration added, k^2"),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = (
        ModelEdit("body_inertia", "joint_body", "add", "gyration_squared", per="body_mass"),
    )
    size: ClassVar[str] = "gyration_squared"
    smallest: ClassVar[float] = 5e-05
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"gyration_squared": 2e-3},)
    fingerprint: ClassVar[str] = "in proportion to acceleration, in the joint and in those that carry it"
    confounders: ClassVar[tuple[str, ...]] = ("motor", "torque_constant")
    separating_experiment: ClassVar[str] = "fast motion of a neighbour: link inertia couples joints, the rotor does not"
    alias_class: ClassVar[str] = "inertia"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")


@register
@dataclass(frozen=True)
class LinkMass(Effect):
    """Mass added to the moved link at its centre of mass: screws, cables, a payload at hand or foot."""

    name: ClassVar[str] = "link_mass"
    stage: ClassVar[Stage] = Stage.BODY
    equation: ClassVar[str] = "m_link += dm"
    source: ClassVar[str] = "models from CAD miss screws and cables, about 10 % of a link"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("link_mass_offset", "kg", -0.01, 0.3, 0.0, 0.0, "added to the moved link", least=-0.011),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = (ModelEdit("body_mass", "joint_body", "add", "link_mass_offset"),)
    size: ClassVar[str] = "link_mass_offset"
    smallest: ClassVar[float] = 0.01
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"link_mass_offset": 0.02}, {"link_mass_offset": 0.1})
    fingerprint: ClassVar[str] = "in the phase of gravity, in fixed ratio over all joints that carry the link"
    confounders: ClassVar[tuple[str, ...]] = ("payload", "link_com", "torque_constant", "encoder_offset")
    separating_experiment: ClassVar[str] = "add a known mass; turn the base"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint",)


@register
@dataclass(frozen=True)
class LinkCentreOfMass(Effect):
    """Shift of the moved link's centre of mass, in the frame of the link."""

    name: ClassVar[str] = "link_com"
    stage: ClassVar[Stage] = Stage.BODY
    equation: ClassVar[str] = "c_link += (dx, dy, dz)"
    source: ClassVar[str] = "models from CAD, up to 10 mm"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("link_com_offset_x", "m", -0.02, 0.02, 0.0, 0.0, "forwards in the stand pose with straight legs"),
        Parameter("link_com_offset_y", "m", -0.02, 0.02, 0.0, 0.0, "to the left"),
        Parameter("link_com_offset_z", "m", -0.02, 0.02, 0.0, 0.0, "upwards"),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = tuple(
        ModelEdit("body_ipos", "joint_body", "add", f"link_com_offset_{axis}", column=column)
        for column, axis in enumerate("xyz")
    )
    size: ClassVar[str] = "link_com_offset_x"
    smallest: ClassVar[float] = 0.002
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"link_com_offset_x": 0.005},
        {"link_com_offset_y": 0.005},
        {"link_com_offset_z": 0.005},
    )
    fingerprint: ClassVar[str] = "in the phase of gravity, turning with the pose, in all joints that carry the link"
    confounders: ClassVar[tuple[str, ...]] = ("encoder_offset", "link_mass", "cable_spring", "current_offset")
    separating_experiment: ClassVar[str] = "turn the base: gravity turns, a spring does not; IMU against kinematics"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint",)
