"""What the servo's sensors say that is not so."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from op3.servo.effect import Effect, Parameter, Prepared, Scope, Signals, Stage, register


@register
@dataclass(frozen=True)
class EncoderOffset(Effect):
    """The encoder's zero is not the joint's zero."""

    name: ClassVar[str] = "encoder_offset"
    stage: ClassVar[Stage] = Stage.SENSING
    equation: ClassVar[str] = "q_measured = q + b"
    source: ClassVar[str] = "homing of a servo horn; Rhoban's servo bench fits -0.126 rad on its STS3032"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("encoder_offset", "rad", -0.2, 0.2, 0.0, 0.0, "reading at the joint's true zero"),
    )
    size: ClassVar[str] = "encoder_offset"
    smallest: ClassVar[float] = 0.003
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"encoder_offset": 0.01},)
    fingerprint: ClassVar[str] = (
        "a constant angle: gravity of the links acts in another phase; foot pose and IMU disagree with the joint angles"
    )
    confounders: ClassVar[tuple[str, ...]] = (
        "link_com",
        "com_offset",
        "cable_spring",
        "current_offset",
        "encoder_nonlinearity",
    )
    separating_experiment: ClassVar[str] = (
        "turn the base: gravity terms turn with it; compare the IMU with forward kinematics"
    )
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Shift the reading."""
        signals.measured_position = signals.measured_position + prepared["encoder_offset"]
