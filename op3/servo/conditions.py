"""Parameters that depend on a condition of the recording, such as the arm of a bench that was remounted.

Their names contain the condition: ``encoder_offset@length=7e-2`` is the encoder offset of logs whose metadata field
``length`` is 0.07. (Config keys are split at dots, hence ``7e-2``.) ``coulomb_friction@joint=elbow`` is the Coulomb
friction of one joint in all logs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

JOINT = "joint"
"""Field of a condition that selects a joint instead of logs."""


@dataclass(frozen=True)
class Condition:
    """Condition on a log's metadata, or the choice of a joint.

    Attributes:
        field: field of the metadata, or `JOINT`.
        value: number or text that it must equal.
    """

    field: str
    value: float | str

    @property
    def joint(self) -> str | None:
        """The joint that the condition selects; None if it selects logs."""
        return str(self.value) if self.field == JOINT else None

    def holds(self, metadata: Mapping[str, Any]) -> bool:
        """Whether these metadata, by field, meet the condition.

        Raises:
            ValueError: if the metadata have no such field.
        """
        if self.field not in metadata:
            raise ValueError(f"condition {self}: no field {self.field!r}; there are {', '.join(metadata)}")
        return metadata[self.field] == self.value

    def __str__(self) -> str:
        value = self.value if isinstance(self.value, str) else _without_dot(self.value)
        return f"{self.field}={value}"


def split_name(name: str) -> tuple[str, Condition | None]:
    """The parameter in a name, and its condition, if any.

    Raises:
        ValueError: if the part behind ``@`` is not ``field=value``.
    """
    parameter, at, condition = name.partition("@")
    if not at:
        return parameter, None
    field, equals, text = condition.partition("=")
    if not (parameter and field and equals and text) or "@" in text:
        raise ValueError(f"{name!r}: write <parameter>@<field of the metadata>=<value>, such as offset@length=7e-2")
    try:
        return parameter, Condition(field, float(text))
    except ValueError:
        return parameter, Condition(field, text)


def _without_dot(value: float) -> str:
    """A number as text without a dot: 0.07 is 7e-2."""
    if value == int(value):
        return str(int(value))
    sign, digits, exponent = Decimal(repr(value)).normalize().as_tuple()
    return f"{'-' * sign}{''.join(map(str, digits))}e{exponent}"
