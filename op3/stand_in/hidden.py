"""What can be hidden in a leg: names, units, sizes. The one table of the hidden-effect bench.

A size of `smallest` is the smallest that matters; mild cases have about that, moderate ones 2.5 times and strong ones 5
times as much. Names are those of the project's catalogue; `outsider` marks what no catalogue holds.
"""

from __future__ import annotations

from dataclasses import dataclass

from op3.robot import JOINTS, LEG_JOINTS

SEVERITIES: dict[str, float] = {"mild": 1.0, "moderate": 2.5, "strong": 5.0}
"""Multiples of the smallest size that matters."""

BASES: dict[str, str] = {
    "dte": "paper_without_dte",
    "stribeck": "paper_without_stribeck",
    "latency": "paper_without_latency",
}
"""The model that lacks an effect which the model `paper` has."""


@dataclass(frozen=True)
class Kind:
    """One thing that can be hidden.

    Attributes:
        unit: of the size.
        smallest: smallest size that matters [unit].
        meaning: what the size is.
        joints: where it can sit; empty: in all joints alike.
        signed: whether the size may be negative.
        forms: ways in which the stand-in can build it; the first is used in two thirds of the cases.
        outsider: whether no catalogue holds it.
    """

    unit: str
    smallest: float
    meaning: str
    joints: tuple[str, ...] = ()
    signed: bool = False
    forms: tuple[str, ...] = ("plain",)
    outsider: bool = False

    def size(self, factor: float) -> float:
        """Size [unit] of an effect `factor` times as strong as the smallest that matters."""
        return self.smallest * factor


_PITCH = ("r_hip_pitch", "r_knee", "r_ank_pitch")
_ANY = LEG_JOINTS
_HEAVY = ("r_hip_roll", "r_hip_pitch", "r_knee")
_LOADED = ("r_hip_roll", *_PITCH)

KINDS: dict[str, Kind] = {
    "dte": Kind("-", 0.1, "1/(eta_fw eta_bw) - 1", forms=("power", "m6")),
    "coulomb": Kind("N m", 0.03, "more Coulomb friction in one joint", _ANY),
    "stribeck": Kind("N m", 0.03, "static friction beyond Coulomb friction", forms=("gaussian", "exponential")),
    "viscous": Kind("N m s/rad", 0.02, "more viscous friction in one joint", _ANY),
    "load_friction": Kind("-", 0.04, "friction per torque passed on", forms=("sum", "motor")),
    "lugre": Kind("rad/(N m)", 0.01, "compliance before sliding", forms=("prandtl", "lugre")),
    "backlash": Kind("rad", 0.0015, "half of the gap", _PITCH, forms=("dead_zone", "tooth")),
    "compliance": Kind("rad/(N m)", 0.004, "compliance of gear and bracket", _PITCH),
    "cogging": Kind("N m", 0.01, "amplitude of the ripple", _ANY, forms=("sine", "rounded_square")),
    "cable_spring": Kind("N m/rad", 0.05, "stiffness of a cable", _ANY, forms=("linear", "hysteretic")),
    "position_friction": Kind("N m", 0.04, "friction added at the worst angle", _ANY, forms=("sine", "ramp")),
    "asymmetric_friction": Kind("N m", 0.02, "fc(v > 0) - fc(v < 0)", _ANY, signed=True),
    "quadratic_drag": Kind("N m s^2/rad^2", 0.005, "drag over v |v|"),
    "friction_drift": Kind("-", 0.12, "share of friction lost in the warm", forms=("time", "temperature")),
    "torque_constant": Kind("-", 0.05, "relative error in one joint", _ANY, signed=True),
    "torque_constant_temperature": Kind("1/K", 0.0008, "share lost per kelvin"),
    "terminal_resistance": Kind("-", 0.06, "relative error in one joint", _LOADED),
    "voltage_sag": Kind("ohm", 0.12, "between voltmeter and servos, for the sum of currents"),
    "current_lag": Kind("s", 0.0012, "time constant of the current loop", forms=("first_order", "two_stage")),
    "current_offset": Kind("A", 0.008, "zero of the current sensor", _ANY, signed=True),
    "latency": Kind("s", 0.0025, "delay of commands"),
    "packet_drop": Kind("-", 0.01, "share of command packets lost", forms=("single", "bursts")),
    "velocity_filter": Kind("s", 0.003, "time constant of the velocity reading", forms=("first_order", "mean")),
    "encoder_offset": Kind("rad", 0.012, "reading at the true zero", _HEAVY, signed=True),
    "encoder_nonlinearity": Kind("rad", 0.006, "amplitude over a turn", _LOADED, forms=("position", "both")),
    "link_mass": Kind("kg", 0.02, "payload on the foot", ("r_ank_roll",), forms=("point", "plate")),
    "link_com": Kind("m", 0.004, "shift of a link's centre of mass forwards", ("r_hip_pitch", "r_ank_pitch"), True),
    "link_inertia": Kind("m^2", 0.003, "squared radius of gyration added to a link", ("r_hip_pitch", "r_ank_pitch")),
    "vibration": Kind("N m", 0.03, "amplitude of a torque of fixed frequency", _PITCH, outsider=True),
    "hard_stop": Kind("N m/rad", 4.0, "stiffness of an obstacle in the way", _PITCH, outsider=True),
    "sticky_patch": Kind("N m", 0.06, "friction in a narrow range of angles", _PITCH, outsider=True),
    "creep": Kind("N m/rad", 0.15, "stiffness of a slowly yielding element", _PITCH, outsider=True),
    "chipped_tooth": Kind("-", 0.15, "share of torque lost at one place of the gear", _PITCH, outsider=True),
}
"""Everything the bench can hide."""

OUTSIDERS: tuple[str, ...] = tuple(name for name, kind in KINDS.items() if kind.outsider)
"""Names of what no catalogue holds."""

CATALOGUE: tuple[str, ...] = tuple(name for name in KINDS if name not in OUTSIDERS)
"""Names that a diagnosis can give."""

ALIAS_PAIRS: tuple[tuple[str, str], ...] = (
    ("dte", "load_friction"),
    ("link_com", "encoder_offset"),
    ("terminal_resistance", "voltage_sag"),
    ("current_offset", "cable_spring"),
    ("latency", "current_lag"),
    ("backlash", "compliance"),
    ("viscous", "quadratic_drag"),
    ("asymmetric_friction", "current_offset"),
    ("link_mass", "link_com"),
    ("stribeck", "lugre"),
)
"""Effects that look alike; half of the cases with two effects hide such a pair."""


@dataclass(frozen=True)
class Hidden:
    """One effect hidden in a leg.

    Attributes:
        name: key of `KINDS`.
        size: [unit of the kind]; 0 is no effect.
        joints: where it sits; empty: everywhere.
        form: one of the kind's forms.
        shape: numbers in [0, 1] from which the stand-in takes what the size does not say (phases, places).
    """

    name: str
    size: float
    joints: tuple[str, ...] = ()
    form: str = ""
    shape: tuple[float, ...] = (0.5, 0.5, 0.5)

    def __post_init__(self):
        """Refuse what the table does not hold."""
        kind = KINDS.get(self.name)
        if kind is None:
            raise ValueError(f"nothing called {self.name!r} can be hidden; there are {', '.join(KINDS)}")
        object.__setattr__(self, "form", self.form or kind.forms[0])
        if self.form not in kind.forms:
            raise ValueError(f"{self.name} has no form {self.form!r}; it has {', '.join(kind.forms)}")
        unknown = set(self.joints) - set(JOINTS)
        if unknown:
            raise ValueError(f"the robot has no joint {sorted(unknown)[0]!r}; it has {', '.join(JOINTS)}")
