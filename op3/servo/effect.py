"""What an effect is: one physical thing a servo, body, sensor or floor does, as a small class.

A robot model is a list of effects with parameter values. The same class serves simulation, identification,
diagnosis and training; adding an effect is one class here, one file in ``conf/effect/`` and one test.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from math import inf, isfinite
from typing import ClassVar, Literal, get_args, get_origin, get_type_hints

import torch
from torch import Tensor


class Stage(IntEnum):
    """Where in a simulation step an effect acts; effects run in this order."""

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


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: unique over the whole catalogue.
        unit: SI unit, ``-`` for a ratio.
        low: smallest plausible value.
        high: largest plausible value.
        nominal: a sensible first guess.
        neutral: value at which the effect changes nothing; None where there is no such value.
        per_joint: whether joints may differ; False for a quantity of the whole robot.
        least: smallest value that physics allows, whatever the plausible range.
        most: largest value that physics allows.
        text: what it is, in a sentence.
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


@dataclass(frozen=True)
class ModelEdit:
    """A change to a MuJoCo model, declared as data and carried out by the simulation.

    Attributes:
        field: name of the ``mjModel`` array, for example ``dof_armature``.
        target: which rows: the servo joints' degrees of freedom, the bodies that they move, the robot's base body, the
            colliding geoms of its feet, those of the ground, or the one row of an option such as ``opt.gravity``. A
            scene without feet or ground has none of these rows, and the edit changes nothing there.
        operation: whether the parameter replaces the compiled value, adds to it, or scales it by ``1 + parameter``; or
            ``turn``, which expresses a vector in a frame that is turned by the parameter [rad] about axis `column`.
        parameter: name of the parameter whose value is written.
        column: second index of the field, for example 0 for x of ``body_ipos``; None writes all columns.
        per: name of a second array, whose rows multiply the value, for example ``body_mass``.
    """

    field: str
    target: Literal["joint_dof", "joint_body", "base_body", "foot_geom", "ground_geom", "option"]
    operation: Literal["set", "add", "scale", "turn"]
    parameter: str
    column: int | None = None
    per: str | None = None


@dataclass
class Signals:
    """What flows through the servo law in one step. Every tensor is ``[sim, joint]`` unless stated.

    The simulation fills the inputs, the effects fill the rest in the order of their stages, and the
    simulation hands the last three to MuJoCo.
    """

    # inputs: the true state of the joint, and what the output transmitted to its link in the last step
    position: Tensor  # [rad]
    velocity: Tensor  # [rad/s]
    speed: Tensor  # |velocity| [rad/s]
    load_torque: Tensor  # tau_a [N m]
    radial_force: Tensor  # across the output shaft [N]; filled only where an effect reads it
    # commands, held until the next tick
    position_target: Tensor  # [rad]
    p_gain: Tensor  # [A/rad]
    d_gain: Tensor  # [A s/rad]
    firmware_gain: Tensor  # kp of the servo's own position loop [firmware units]
    torque_enable: Tensor  # 1 or 0
    packet: Tensor  # whether that of this tick arrived, where it is known: 1, -1 where it was lost; 0 elsewhere
    bus_voltage: Tensor  # [V]
    temperature: Tensor  # of the servo, as it measures it [C]
    time: Tensor  # since the start [s]; filled only where an effect reads it
    phase: int | Tensor  # simulation steps since the last tick; ``[1]`` in a step that is translated
    # sensing stage: what the servo's encoder says
    measured_position: Tensor  # [rad]
    measured_velocity: Tensor  # [rad/s]
    # what reaches the servo, and what its driver applies
    target_current: Tensor  # [A]
    goal: Tensor  # of the servo's own position loop [rad]
    duty: Tensor  # what the PWM register says, -1 to 1
    voltage: Tensor  # [V]
    # motor stage
    current: Tensor  # [A]
    motor_torque: Tensor  # tau_m at the old velocity [N m]
    measured_current: Tensor  # what the servo says of it [A]; filled when sensors are read for a log
    # friction stage
    fade: Tensor  # share of the friction near rest that is left at this speed; 1 without a Stribeck effect
    # to MuJoCo
    applied_torque: Tensor  # at the old velocity [N m]
    damping: Tensor  # minus its derivative by velocity, to be integrated implicitly [N m s/rad]
    friction_bound: Tensor  # [N m]
    # memory of effects that have one, by effect name
    state: dict[str, Tensor]
    # factors on the motor's parameters that change in time, by parameter name; none where no effect sets one
    factors: dict[str, Tensor]

    @classmethod
    def zeros(
        cls,
        num_sims: int,
        num_joints: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> "Signals":
        """Signals of a servo at rest without command."""
        made = {
            field.name: torch.zeros(num_sims, num_joints, dtype=dtype, device=device)
            for field in fields(cls)
            if field.name not in ("phase", "state", "factors")
        }
        return cls(**made, phase=0, state={}, factors={})


Prepared = Mapping[str, Tensor]


@dataclass
class Trunk:
    """What the trunk's IMU says.

    Attributes:
        quaternion: orientation, ``[sim, 4]``, w first.
        angular_velocity: in the frame of the body [rad/s], ``[sim, 3]``.
    """

    quaternion: Tensor
    angular_velocity: Tensor


@dataclass(frozen=True)
class Clock:
    """The two rhythms of the law.

    Attributes:
        timestep: simulation step [s].
        period: time between ticks, at which commands are computed and sent [s].
    """

    timestep: float
    period: float


Scope = Literal["robot", "shared", "joint", "side"]
"""Who has an effect: the whole robot, all joints alike, one joint, or the joints of one side."""


class Effect:
    """Base class of everything in the catalogue; subclasses are frozen dataclasses of their options.

    What the diagnosis needs to find an effect stands beside the law. A *secant* is one finite change of parameters at
    which a prediction is compared with that of the model without it: an amount that is added to what the parameter is
    (its neutral value where the effect is off), or the value itself where a parameter has no neutral value. It may
    change a parameter of another effect, if that is on. Effects that are no hypothesis (the motor, the controller) have
    no secants.

    Class attributes:
        name: identifier in ``model.yaml`` and ``conf/effect/``.
        stage: when it acts.
        rank: place within the stage; effects of one rank keep the order of the model.
        equation: the law in one line.
        source: where the law comes from.
        parameters: its numbers.
        edits: what it changes in the MuJoCo model.
        reads: signals that simulations fill only where an effect asks for them.
        commands: inputs of `Signals` without which it cannot act.
        borrows: parameters of other effects that `prepare` is given too, where those effects are on.
        size: name of the parameter that says how strong the effect is.
        smallest: smallest size that matters, as a distance from neutral in that parameter's unit.
        secants: finite changes for screening, several where the effect is not local in its parameters.
        fingerprint: how it shows in the residual, measured minus predicted.
        confounders: other effects that may look like it.
        separating_experiment: what tells it from them.
        alias_class: effects of one class cannot be told apart without a special experiment.
        scopes: who can have it.
        stiff: whether it moves within milliseconds, so that no simulation of it may take longer steps than usual.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    rank: ClassVar[int] = 0
    equation: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    edits: ClassVar[tuple[ModelEdit, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()
    commands: ClassVar[tuple[str, ...]] = ()
    borrows: ClassVar[tuple[str, ...]] = ()
    size: ClassVar[str] = ""
    smallest: ClassVar[float] = 0.0
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ()
    fingerprint: ClassVar[str] = ""
    confounders: ClassVar[tuple[str, ...]] = ()
    separating_experiment: ClassVar[str] = ""
    alias_class: ClassVar[str] = ""
    scopes: ClassVar[tuple[Scope, ...]] = ()
    stiff: ClassVar[bool] = False

    def __post_init__(self):
        """Refuse options of the wrong kind: a misspelt form would choose another law.

        Raises:
            ValueError: if an option is none of its choices, or not a finite number where one belongs.
        """
        hints = get_type_hints(type(self))
        for option in self.options():
            value, hint = getattr(self, option), hints[option]
            if get_origin(hint) is Literal and value not in get_args(hint):
                choices = ", ".join(map(str, get_args(hint)))
                raise ValueError(f"effect {self.name!r}: {option} must be one of {choices}, got {value!r}")
            number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
            if hint is float and not number:
                raise ValueError(f"effect {self.name!r}: {option} must be a finite number, got {value!r}")

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        """All parameters of the model as this effect leaves them, before any constants are computed from them.

        Args:
            values: parameters of all effects that are on, each ``[sim, joint]``.
            sides: +1 for joints on the left, -1 on the right, 0 in the middle, ``[joint]``.
        """
        del sides
        return values

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Constants of a step, computed once whenever parameters change.

        Args:
            values: this effect's parameters, and those that it borrows, each ``[sim, joint]``.
            clock: simulation step and control period.
        """
        del clock
        return values

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """Create the effect's memory in ``signals.state``, given the commands and state at the start."""

    def balance(self, signals: Signals, prepared: Prepared, torque: Tensor, rests: Tensor) -> Tensor:
        """Bend elastic elements so that the joint does what was measured, where a simulation starts from data.

        Args:
            signals: after a step of the law.
            prepared: see `prepare`.
            torque: by which what the law gave in that step exceeds what the measured motion asks for [N m].
            rests: where the joint rests: there all is in balance.

        Returns:
            The torque that is left to the effects nearer to the motor.
        """
        del signals, prepared, rests
        return torque

    def tick(self, signals: Signals, prepared: Prepared) -> None:
        """Act once per control period, right after new commands arrived."""

    def begin(self, signals: Signals, prepared: Prepared) -> None:
        """Look at the joint's new state once per simulation step, before any effect acts.

        An effect may put other values in place of the joint's position, velocity and load torque for this step.
        """

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Act once per simulation step; effects on sensors act whenever these are read, and keep no memory there."""

    def finish(self, signals: Signals, prepared: Prepared) -> None:
        """Keep what must be remembered of the joint's state, once per simulation step, after all effects acted."""

    def motor_side(self, signals: Signals, prepared: Prepared) -> None:
        """Put the motor's velocity in place of the joint's while the servo reports of itself, where they differ."""

    def report(self, signals: Signals, prepared: Prepared) -> None:
        """Change what the servo says of itself in a log and does not act on."""

    def sense_trunk(self, trunk: Trunk, prepared: Prepared) -> None:
        """Change what the trunk's IMU says."""

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Names of the constructor's keywords: constants that are not identified."""
        return tuple(field.name for field in fields(cls))  # type: ignore[arg-type]


_CATALOGUE: dict[str, type[Effect]] = {}


def register(effect: type[Effect]) -> type[Effect]:
    """Class decorator that puts an effect into the catalogue.

    Raises:
        ValueError: if its name, or the name of one of its parameters, is taken.
    """
    if effect.name in _CATALOGUE:
        raise ValueError(f"effect name {effect.name!r} is taken by {_CATALOGUE[effect.name].__name__}")
    taken = {parameter.name for other in _CATALOGUE.values() for parameter in other.parameters}
    clash = taken & {parameter.name for parameter in effect.parameters}
    if clash:
        raise ValueError(f"effect {effect.name!r}: parameter names {sorted(clash)} are taken by other effects")
    _CATALOGUE[effect.name] = effect
    return effect


def catalogue() -> dict[str, type[Effect]]:
    """All effects by name, in the order of their stages."""
    return dict(sorted(_CATALOGUE.items(), key=lambda item: (item[1].stage, item[0])))


def effect_class(name: str) -> type[Effect]:
    """The effect of this name.

    Raises:
        ValueError: if the catalogue has none.
    """
    if name not in _CATALOGUE:
        raise ValueError(f"unknown effect {name!r}; the catalogue has {', '.join(catalogue())}")
    return _CATALOGUE[name]


def parameter(name: str) -> Parameter:
    """The catalogue's parameter of this name.

    Raises:
        ValueError: if no effect has it.
    """
    known = {p.name: p for effect in catalogue().values() for p in effect.parameters}
    if name not in known:
        raise ValueError(f"unknown parameter {name!r}; the catalogue has {', '.join(sorted(known))}")
    return known[name]


def secant_values(secant: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    """Parameter values at a secant, kept within what physics allows.

    Args:
        secant: one of `Effect.secants`.
        values: what parameters are now; those missing have their neutral value, and parameters of effects that are
            off may be left out.
    """
    moved = {}
    for name, change in secant.items():
        known = parameter(name)
        start = 0.0 if known.neutral is None else values.get(name, known.neutral)
        moved[name] = min(max(start + change, known.least), known.most)
    return moved


def in_stage_order(effects: Sequence[Effect]) -> list[Effect]:
    """Effects sorted by stage and rank; those of one rank keep their order.

    Raises:
        ValueError: if an effect appears twice.
    """
    names = [effect.name for effect in effects]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"effects listed twice: {', '.join(twice)}; list each once")
    return sorted(effects, key=lambda effect: (effect.stage, effect.rank))
