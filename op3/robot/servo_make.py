"""Servo makes as data, read from ``assets/servos/<make>.yaml``. A new make is one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from math import pi
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from op3.common.assets import asset_path
from op3.common.settings import nearest
from op3.robot.data_file import DataFile, DataFileError, Real, Record, among

TO_SI: Mapping[str, tuple[str, Callable[[float], float]]] = {
    "rpm": ("rad/s", lambda value: value * 2 * pi / 60),
    "mA": ("A", lambda value: value / 1000),
    "kg cm": ("N m", lambda value: value * 9.80665 / 100),
    "s/60deg": ("rad/s", lambda value: pi / 3 / value),
    "%": ("", lambda value: value / 100),
    **{
        unit: (unit, lambda value: value)
        for unit in (
            "",
            "rad/s",
            "A",
            "V",
            "ohm",
            "N m",
            "N m/A",
            "kg m^2",
            "C",
            "K/W",
            "1/rad",
            "counts",
            "counts/turn",
        )
    },
}
"""Units of servo files, the SI unit of each, and the factor to it."""

Loop = Literal["current", "firmware"]


class Figure(Record):
    """A number with its unit and source.

    Attributes:
        value: positive value in `unit`.
        unit: one of `TO_SI`.
        source: key of the file's `sources`.
        at: supply voltage at which the value is valid [V], if it depends on the voltage.
    """

    value: Annotated[Real, Field(gt=0)]
    source: str
    unit: Annotated[str, among("unit", TO_SI)] = ""
    at: Annotated[Real, Field(gt=0)] | None = None

    @property
    def si(self) -> float:
        """The number in SI units."""
        return TO_SI[self.unit][1](self.value)


def _in(unit: str) -> AfterValidator:
    """Validator that a number has this SI unit or a unit that converts to it."""
    known = [name for name, (of, _) in TO_SI.items() if of == unit]

    def check(figure: Figure) -> Figure:
        if figure.unit not in known:
            raise ValueError(
                f"is in {figure.unit or 'no unit'}, not in {' or '.join(name or 'none' for name in known)}"
            )
        return figure

    return AfterValidator(check)


class MotorData(Record):
    """The motor and its gear.

    Attributes:
        gear_ratio: motor turns per output turn.
        torque_constant: torque constant at the motor's shaft [N m/A].
        terminal_resistance: terminal resistance [ohm].
        armature: rotor's inertia at the output [kg m^2].
    """

    gear_ratio: Annotated[Figure, _in("")]
    torque_constant: Annotated[Figure, _in("N m/A")]
    terminal_resistance: Annotated[Figure, _in("ohm")]
    armature: Annotated[Figure, _in("kg m^2")]


class Counts(Record):
    """Units of the registers.

    Attributes:
        position: counts per turn of the encoder.
        zero: encoder reading in the middle of its turn.
        velocity: one unit of velocity.
        current: one unit of current, if the servo measures it.
        voltage: one unit of voltage.
        temperature: one unit of temperature, if the servo measures it.
        duty: units of full duty, if the servo reports it.
    """

    position: Annotated[Figure, _in("counts/turn")]
    zero: Annotated[Figure, _in("counts")]
    velocity: Annotated[Figure, _in("rad/s")]
    voltage: Annotated[Figure, _in("V")]
    current: Annotated[Figure, _in("A")] | None = None
    temperature: Annotated[Figure, _in("C")] | None = None
    duty: Annotated[Figure, _in("counts")] | None = None


class ServoRatings(Record):
    """Limits of the servo.

    Attributes:
        stall_torque: stall torque at the voltage `at` [N m].
        no_load_speed: no-load speed at the voltage `at` [rad/s].
        current: largest current [A].
        continuous_current: continuous rating [A].
        low_voltage: lowest supply voltage [V].
        high_voltage: highest supply voltage [V].
        temperature: temperature at which the servo switches off [C].
        thermal_resistance: thermal resistance from windings to air [K/W].
    """

    stall_torque: Annotated[Figure, _in("N m")]
    no_load_speed: Annotated[Figure, _in("rad/s")]
    low_voltage: Annotated[Figure, _in("V")]
    high_voltage: Annotated[Figure, _in("V")]
    temperature: Annotated[Figure, _in("C")]
    current: Annotated[Figure, _in("A")] | None = None
    continuous_current: Annotated[Figure, _in("A")] | None = None
    thermal_resistance: Annotated[Figure, _in("K/W")] | None = None


class PositionLaw(Record):
    """The firmware's position loop: duty = clip(gain * error_gain * error, +-max_duty).

    Attributes:
        error_gain: duty per rad of error and unit of the gain's register.
        max_duty: largest commanded duty.
        goal_speed: largest speed of the followed goal [rad/s].
        gain: factory value of the register, or the usual one.
    """

    error_gain: Annotated[Figure, _in("1/rad")]
    max_duty: Annotated[Figure, _in("")]
    goal_speed: Annotated[Figure, _in("rad/s")]
    gain: Annotated[Figure, _in("")]


class ServoMake(Record):
    """A make of servo, see ``docs/your_robot.md``.

    Attributes:
        format: version of the file format.
        name: name, the same as the file's.
        maker: manufacturer.
        sources: sources of the numbers, by key.
        loop: position loop in op3: `current` (an external PD commands currents) or `firmware` (the servo's law).
        supply: nominal supply voltage [V].
        motor: the motor and its gear.
        counts: units of the registers.
        limits: limits of the servo.
        position_law: position law of the firmware.
        model_number: answer to a ping, if known.
        bus: register table with which `op3.deploy` drives and emulates it, if supported.
        aliases: other names that recordings give it.
        recorded: channels of servo-bench recordings that were really measured, in addition to position, speed and
            voltage; None without such recordings.
    """

    format: Literal["op3-servo/1"]
    name: str
    maker: str
    sources: Mapping[str, str]
    loop: Loop
    supply: Annotated[Figure, _in("V")]
    motor: MotorData
    counts: Counts
    limits: ServoRatings
    position_law: PositionLaw | None = None
    model_number: int | None = None
    bus: Literal["dynamixel-x"] | None = None
    aliases: tuple[str, ...] = ()
    recorded: tuple[Literal["load", "temp"], ...] | None = None

    @property
    def position_unit(self) -> float:
        """One count of the encoder [rad]."""
        return 2 * pi / self.counts.position.value

    def unit(self, register: str) -> float:
        """Size of a register unit of `Counts` in SI units.

        Raises:
            ValueError: if the servo does not measure it.
        """
        figure = getattr(self.counts, register)
        if figure is None:
            raise ValueError(f"the {self.name} does not measure {register}")
        return figure.si

    @property
    def peak_current(self) -> float:
        """Largest current [A]; if the file gives none, the current of the stalled motor at its supply."""
        limits = self.limits
        return limits.current.si if limits.current else self.supply.si / self.motor.terminal_resistance.si

    @property
    def continuous_current(self) -> float:
        """Continuous current rating [A]; a fifth of the largest current if its file gives none."""
        limits = self.limits
        return 0.2 * self.peak_current if limits.continuous_current is None else limits.continuous_current.si

    @property
    def thermal_resistance(self) -> float:
        """Thermal resistance from windings to air [K/W].

        If its file gives none: the largest value that allows `continuous_current` continuously, in air of 25 C.
        """
        limits = self.limits
        if limits.thermal_resistance is not None:
            return limits.thermal_resistance.si
        return (limits.temperature.si - 25.0) / (self.motor.terminal_resistance.si * self.continuous_current**2)

    @property
    def output_constant(self) -> float:
        """Output torque per current [N m/A]."""
        return self.motor.gear_ratio.si * self.motor.torque_constant.si

    def ideal_stall_torque(self, voltage: float | None = None) -> float:
        """Torque at standstill under full duty, without losses [N m], at a supply voltage [V] or the nominal one."""
        return self.output_constant * (voltage or self.supply.si) / self.motor.terminal_resistance.si

    def stiffness(self, voltage: float | None = None) -> float:
        """Torque per angle and unit of gain of the position loop, at a supply voltage [V] or the nominal one."""
        if self.loop == "current":
            return self.output_constant
        assert self.position_law is not None
        return self.position_law.error_gain.si * self.ideal_stall_torque(voltage)

    def stands(self, voltage: float) -> bool:
        """Whether a supply voltage [V] is within its limits."""
        return self.limits.low_voltage.si <= voltage <= self.limits.high_voltage.si


def supply_shares(makes: Sequence[ServoMake]) -> NDArray[np.float64]:
    """Supply voltage of each servo relative to the first [joint]; equal for all whose limits allow it."""
    first = makes[0].supply.si
    return np.array([1.0 if make.stands(first) else make.supply.si / first for make in makes])


@lru_cache(maxsize=1)
def servo_files() -> dict[str, Path]:
    """The files of all makes of the project, by name."""
    return {path.stem: path for path in sorted(asset_path("servos").glob("*.yaml"))}


@lru_cache(maxsize=64)
def load_servo(name: str | Path) -> ServoMake:
    """A make of servo.

    Args:
        name: name of a file in ``assets/servos``, case-insensitive, or a path.

    Raises:
        DataFileError: if there is no such servo, or its file is invalid.
    """
    known = servo_files()
    path = known.get(str(name).lower()) or Path(name)
    if path.suffix != ".yaml":
        raise DataFileError(f"there is no servo {str(name)!r}{nearest(str(name).lower(), known)}")
    file = DataFile(path)
    make = file.read(ServoMake)
    if make.name != path.stem:
        raise file.fault(("name",), f"is {make.name!r}, but the file is called {path.name!r}")
    if make.loop == "firmware" and make.position_law is None:
        raise file.fault(("loop",), "is 'firmware', so the file needs a position_law")
    low, high = make.limits.low_voltage.si, make.limits.high_voltage.si
    if not low <= make.supply.si <= high:
        raise file.fault(("supply",), f"is {make.supply.si:g} V, outside its limits {low:g} to {high:g} V")
    for place, figure in _figures(make):
        if figure.source not in make.sources:
            raise file.unknown((*place, "source"), "source", figure.source, make.sources)
    return make


def find_servo(name: str | None) -> ServoMake | None:
    """The make named in a recording, possibly by an alias or without its variant; None if unknown."""
    wanted = _plain(name or "")
    makes = [load_servo(known) for known in servo_files()] if wanted else []
    exact = [make for make in makes if wanted in map(_plain, (make.name, *make.aliases))]
    close = [make for make in makes if _plain(make.name).startswith(wanted)]
    return next(iter(exact + close), None)


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _figures(record: Record, place: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Figure]]:
    """All numbers of a record with their paths."""
    found = []
    for name in type(record).model_fields:
        value = getattr(record, name)
        if isinstance(value, Figure):
            found.append(((*place, name), value))
        elif isinstance(value, Record):
            found += _figures(value, (*place, name))
    return found
