"""Base classes of effects: each physical law of a servo, body, sensor or floor is one small class.

A robot model is a list of effects with parameter values. The same class serves simulation, identification,
diagnosis and training; adding an effect is one class here and one test.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from functools import cache
from math import inf, isfinite
from typing import ClassVar, Literal, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

from torch import Tensor

from op3.common.settings import nearest
from op3.servo.signals import Periods, Trunk


class Stage(IntEnum):
    """Stage of a simulation step in which an effect acts; effects run in this order."""

    SENSING = 0
    COMMAND = 1
    TRANSPORT = 2
    CONTROLLER = 3
    DRIVER = 4
    MOTOR = 5
    GEAR = 6
    FRICTION = 7
    LOAD = 8
    TRANSMISSION = 9  # between the gear and the link
    PARALLEL = 10  # beside the servo, between the two links
    BODY = 11
    GROUND = 12


type_hints = cache(get_type_hints)
"""Types of a class's fields, cached: resolving them takes longer than everything else in building an effect."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    Attributes:
        name: name, unique within the catalogue.
        unit: SI unit, ``-`` for a ratio.
        low: smallest plausible value.
        high: largest plausible value.
        nominal: typical value, used as initial value.
        neutral: value at which the effect has no influence; None if there is no such value.
        per_joint: whether joints may differ; False for a quantity of the whole robot.
        least: smallest physically possible value.
        most: largest physically possible value.
        text: short description.
        searched: whether it is searched with its effect by default; others are fixed unless a config names them.
        mirrored: whether it is an angle of the joint, which is mirrored in the joint on the other side.
    """

    name: str
    unit: str
    low: float
    high: float
    nominal: float
    neutral: float | None
    text: str
    per_joint: bool = True
    least: float = -inf
    most: float = inf
    searched: bool = True
    mirrored: bool = False


@dataclass(frozen=True)
class Usual:
    """Usual value of a parameter of the measurement chain; every baseline fit includes these parameters.

    Attributes:
        value: expected value.
        spread: standard deviation among sound robots; a value far outside is a finding.
        wide: standard deviation of the baseline's prior.
        most: largest value that the baseline may take.
        own: whether each joint may have a different value.
        least: smallest value that the baseline may take, within the physically possible ones.
        none: standard deviation about zero for models without the effect; None if such a model makes no statement about
            it, for example for sensors.
        bench: whether it applies only to benches.
    """

    value: float
    spread: float
    wide: float
    most: float
    own: bool = False
    least: float = -inf
    none: float | None = None
    bench: bool = False


@dataclass(frozen=True)
class ModelEdit:
    """A change to a MuJoCo model, declared as data and applied by the simulation.

    Attributes:
        field: name of the ``mjModel`` array, for example ``dof_armature``.
        target: edited rows: the servo joints' degrees of freedom, the bodies that they move, the robot's base body, the
            colliding geoms of the feet or of the ground, or the only row of an option such as ``opt.gravity``. In a
            scene without feet or ground, the edit has no effect on these.
        operation: whether the parameter replaces the compiled value, adds to it, or scales it by ``1 + parameter``; or
            ``turn``, which expresses a vector in a frame that is turned by the parameter [rad] about axis `column`.
        parameter: name of the parameter whose value is written.
        column: second index of the field, for example 0 for x of ``body_ipos``; None writes all columns.
        per: name of a second array, whose rows multiply the value, for example ``body_mass``.
    """

    field: str
    target: Literal["joint_dof", "joint_body", "base_body", "ground_geom", "option"]
    operation: Literal["set", "add", "scale", "turn"]
    parameter: str
    column: int | None = None
    per: str | None = None


Scope = Literal["robot", "shared", "joint", "side"]
"""Scope of an effect: the whole robot, all joints equally, one joint, or the joints of one side."""


class Effect:
    """Base class of everything in the catalogue; `register` makes subclasses frozen dataclasses of their options.

    The law of an effect consists of a few scalar functions of one joint, which are compiled with those of all other
    effects into one kernel; they use no objects and allocate no memory. Each is a static method of ``(s, p)``: ``s``
    holds the `SIGNALS` and the effect's own ``memory``, ``p`` the parameters of the whole catalogue, neutral if their
    effect is off. Names of memory, constants and options begin with the effect's name: ``s.lugre_bent``,
    ``p.motor_gear_ratio``. An option with named choices is the index of the choice.

    | function | when it is called | it computes |
    |---|---|---|
    | ``prepare(p)`` | when parameters are set | ``constants`` of a step |
    | ``reset(s, p)`` | at the start | initial memory, zero by default |
    | ``sense(s, p)`` | whenever sensors are read | sensor readings; it may only change its own memory |
    | ``tick(s, p)`` | once per control period, when commands arrived | commands |
    | ``begin(s, p)`` | first in every step | memory for the joint's new state |
    | ``apply(s, p)`` | in every step, in order of stage and rank | the law |
    | ``finish(s, p)`` | last in every step | memory for the next step |
    | ``motor_side(s, p)`` | before ``report`` | the motor's velocity instead of the joint's |
    | ``report(s, p)`` | when a row of a log is read | reported values that do not influence the servo |
    | ``balance(s, p, torque, rests)`` | when a simulation starts from data | initial deflection of elastic elements |

    Position, velocity, load torque, bus voltage and target current may be changed during a step; afterwards they are
    restored. `balance` gets the torque by which the last step exceeds the torque of the measured motion [N m] and
    whether the joint rests, and returns the torque that it leaves to the effects nearer to the motor. An effect with a
    `depth` gets that many further numbers of memory, as the last argument of ``reset``, ``tick`` and ``apply``.

    Further class attributes are for the diagnosis. A *secant* is a finite change of parameters at which a prediction is
    compared with that of the unchanged model: an amount that is added to the parameter (to its neutral value if the
    effect is off), or the value itself if the parameter has no neutral value. It may change a parameter of another
    effect, if that is on. Effects that are not hypotheses (the motor, the controller) have no secants.

    Class attributes:
        name: identifier in ``model.yaml`` and in ``effect=[name]``.
        stage: when it acts.
        rank: order within the stage; effects of equal rank act in the order of their names.
        equation: the law in one line.
        source: reference of the law.
        parameters: parameters of the effect.
        memory: names of its memory.
        constants: names of the constants that `prepare` computes.
        edits: its changes to the MuJoCo model.
        reads: signals that simulations fill only if an effect lists them.
        commands: required inputs.
        secants: finite changes for screening, several where the effect is not local in its parameters.
        fingerprint: signature in the residual (measured minus predicted).
        confounders: other effects with similar signatures.
        separating_experiment: experiment that distinguishes it from them.
        scopes: possible scopes; always the whole robot for parameters that joints share.
        usual: usual values of parameters that every baseline fit includes.
        spread: standard deviation of a parameter between servos of one make, relative to its value.
        written: options with alternative forms of the same law, which are all tried; the name does not depend on the
            form.
        foreseeable: whether its influence in a short window can be predicted; that of lost packets cannot.
        free_base: whether only logs of a robot with a free base reveal it.
        both_sides: whether it is a difference between left and right, which logs of one side do not reveal.
        acts_in: name of the effect whose functions also compute this one.
        stiff: whether its dynamics take milliseconds, so that simulations must not use longer steps than usual.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    rank: ClassVar[int] = 0
    equation: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    memory: ClassVar[tuple[str, ...]] = ()
    constants: ClassVar[tuple[str, ...]] = ()
    edits: ClassVar[tuple[ModelEdit, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()
    commands: ClassVar[tuple[str, ...]] = ()
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ()
    fingerprint: ClassVar[str] = ""
    confounders: ClassVar[tuple[str, ...]] = ()
    separating_experiment: ClassVar[str] = ""
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")
    usual: ClassVar[Mapping[str, Usual]] = {}
    spread: ClassVar[Mapping[str, float]] = {}
    written: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    foreseeable: ClassVar[bool] = True
    free_base: ClassVar[bool] = False
    both_sides: ClassVar[bool] = False
    acts_in: ClassVar[str] = ""
    stiff: ClassVar[bool] = False

    def __post_init__(self):
        """Raise an error for options of the wrong type, because a misspelt form would select another law.

        Raises:
            ValueError: if an option is not one of its choices or not a finite number.
        """
        hints = type_hints(type(self))
        for option in self.options():
            value, hint = getattr(self, option), hints[option]
            if get_origin(hint) is Literal and value not in get_args(hint):
                choices = ", ".join(map(str, get_args(hint)))
                raise ValueError(f"effect {self.name!r}: {option} must be one of {choices}, got {value!r}")
            kinds = {float: (int, float), int: (int,)}.get(hint)
            if kinds and (not isinstance(value, kinds) or isinstance(value, bool) or not isfinite(value)):
                number = "finite" if hint is float else "whole"
                raise ValueError(f"effect {self.name!r}: {option} must be a {number} number, got {value!r}")

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        """All parameters of the model after the changes of this effect; raises an error if they are invalid.

        Args:
            values: parameters of all effects that are on, each ``[sim, joint]``.
            sides: +1 for joints on the left, -1 on the right, 0 in the middle, ``[joint]``.
        """
        del sides
        return values

    def depth(self, clock: Periods) -> int:
        """Further numbers of memory per joint."""
        del clock
        return 0

    def sense_trunk(self, trunk: Trunk, values: Mapping[str, Tensor]) -> None:
        """Change the readings of the trunk's IMU.

        Args:
            values: parameters of the model; parameters of the whole robot have the shape ``[sim, 1]``.
        """

    @classmethod
    def related(cls, names: Collection[str]) -> bool:
        """Whether this effect and any of the given effects are confounders."""
        return bool(set(names) & set(cls.confounders)) or any(
            cls.name in _CATALOGUE[name].confounders for name in names
        )

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Names of the constructor's keywords, constants that are not identified."""
        return tuple(field.name for field in fields(cls))  # type: ignore[arg-type]


_CATALOGUE: dict[str, type[Effect]] = {}


Registered = TypeVar("Registered", bound=type[Effect])


@dataclass_transform(frozen_default=True)
def register(effect: Registered) -> Registered:
    """Class decorator that makes an effect a frozen dataclass of its options, and adds it to the catalogue.

    Raises:
        ValueError: if its name, or the name of one of its parameters, is taken.
    """
    if effect.name in _CATALOGUE:
        raise ValueError(f"effect name {effect.name!r} is taken by {_CATALOGUE[effect.name].__name__}")
    taken = {parameter.name for other in _CATALOGUE.values() for parameter in other.parameters}
    clash = taken & {parameter.name for parameter in effect.parameters}
    if clash:
        raise ValueError(f"effect {effect.name!r}: parameter names {sorted(clash)} are taken by other effects")
    if effect.parameters and not any(parameter.per_joint for parameter in effect.parameters):
        effect.scopes = ("robot",)
    made = effect if is_dataclass(effect) else dataclass(frozen=True)(effect)
    _CATALOGUE[effect.name] = made
    return made


def catalogue() -> dict[str, type[Effect]]:
    """All effects by name, in the order of their stages."""
    return dict(sorted(_CATALOGUE.items(), key=lambda item: (item[1].stage, item[0])))


def effect_class(name: str) -> type[Effect]:
    """The effect of this name.

    Raises:
        ValueError: if the catalogue has none.
    """
    if name not in _CATALOGUE:
        raise ValueError(f"unknown effect {name!r}{nearest(name, catalogue())}")
    return _CATALOGUE[name]


def parameter(name: str) -> Parameter:
    """The catalogue's parameter of this name.

    Raises:
        ValueError: if no effect has it.
    """
    known = {p.name: p for effect in catalogue().values() for p in effect.parameters}
    if name not in known:
        raise ValueError(f"unknown parameter {name!r}{nearest(name, sorted(known))}")
    return known[name]


def in_stage_order(effects: Sequence[Effect]) -> list[Effect]:
    """Effects sorted by stage and rank; effects of equal rank keep their order.

    Raises:
        ValueError: if an effect appears twice.
    """
    names = [effect.name for effect in effects]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"effects listed twice: {', '.join(twice)}; list each once")
    return sorted(effects, key=lambda effect: (effect.stage, effect.rank))
