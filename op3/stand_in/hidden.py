"""Effects that can be hidden in a robot, with units, sizes and joints from `kinds.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

SEVERITIES: dict[str, float] = {"mild": 1.0, "clear": 2.5, "strong": 5.0}
"""Multiples of the smallest size that matters."""

BASES: dict[str, str] = {
    "dte": "paper_without_dte",
    "stribeck": "paper_without_stribeck",
    "latency": "paper_without_latency",
}
"""The model without an effect that the model `paper` includes."""


@dataclass(frozen=True)
class Kind:
    """A kind of hidden effect; `kinds.yaml` explains the fields."""

    size: float
    unit: str
    meaning: str
    place: str = "all"
    signed: bool = False
    forms: tuple[str, ...] | list[str] = ("plain",)
    outsider: bool = False
    parameter: str = ""

    def catalogue_size(self, size: float) -> float:
        """A size in the catalogue's convention; for the gear this is the efficiency."""
        return 1 / (1 + size) if self.parameter == "backward_efficiency" else size


KINDS: dict[str, Kind] = {
    name: Kind(**fields) for name, fields in yaml.safe_load(Path(__file__).with_name("kinds.yaml").read_text()).items()
}
"""All kinds of effects that the bench can hide."""

OUTSIDERS: tuple[str, ...] = tuple(name for name, kind in KINDS.items() if kind.outsider)
"""Names of out-of-catalogue effects."""

CATALOGUE: tuple[str, ...] = tuple(name for name in KINDS if name not in OUTSIDERS)
"""Names that a diagnosis can give."""

ALIAS_PAIRS: tuple[tuple[str, str], ...] = (
    ("dte", "load_friction"),
    ("link_com", "encoder_offset"),
    ("terminal_resistance", "voltage_sag"),
    ("current_offset", "cable_spring"),
    ("latency", "current_lag"),
    ("backlash", "encoder_nonlinearity"),
    ("viscous", "quadratic_drag"),
    ("asymmetric_friction", "current_offset"),
    ("link_mass", "link_com"),
    ("stribeck", "lugre"),
)
"""Effects with similar signatures; half of the cases with two effects hide such a pair."""


@dataclass(frozen=True)
class Hidden:
    """One effect hidden in a robot.

    Attributes:
        name: key of `KINDS`.
        size: size in the unit of the kind; 0: no effect.
        joints: affected joints; empty: all joints.
        form: one of the kind's forms; the first if empty.
        shape: numbers in [0, 1] that determine further properties, such as phases and angles.
    """

    name: str
    size: float
    joints: tuple[str, ...] = ()
    form: str = ""
    shape: tuple[float, ...] = (0.5, 0.5, 0.5)

    def __post_init__(self):
        """Raise an error for an effect or form that the table does not contain."""
        kind = KINDS.get(self.name)
        if kind is None:
            raise ValueError(f"{self.name!r} cannot be hidden; choose one of {', '.join(KINDS)}")
        object.__setattr__(self, "form", self.form or kind.forms[0])
        object.__setattr__(self, "joints", tuple(self.joints))  # from a file they are lists
        object.__setattr__(self, "shape", tuple(self.shape))
        if self.form not in kind.forms:
            raise ValueError(f"{self.name} has no form {self.form!r}; it has {', '.join(kind.forms)}")

    @property
    def variant(self) -> int:
        """Number of the form."""
        return KINDS[self.name].forms.index(self.form)
