"""What the servo's sensors say that is not so."""

from dataclasses import dataclass
from typing import ClassVar

from op3.servo.effect import Effect, Parameter, Prepared, Signals, Stage, register


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

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Shift the reading."""
        signals.measured_position = signals.measured_position + prepared["encoder_offset"]
