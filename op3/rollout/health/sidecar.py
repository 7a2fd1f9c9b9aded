"""Checks of the metadata."""

from __future__ import annotations

import numpy as np

from op3.robot.servo_make import load_servo, servo_files
from op3.rollout.errors import LogError, rename
from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import D_GAIN, FIRMWARE_GAIN, P_GAIN, TEMPERATURE, VOLTAGE
from op3.rollout.match import OVERLAP, fitted
from op3.rollout.units import likely_unit, plausible_unit

_PLAUSIBLE = {"mass": ("kg", 1e-3, 50.0, 0.4), "length": ("m", 5e-3, 3.0, 0.12), "battery": ("V", 2.0, 60.0, 11.0)}
"""Unit, smallest, largest and typical value of a bench's metadata."""

_CHARGE = (0.7, 1.3)  # plausible voltage relative to the battery's: cells of 3.7 V give 3.0 to 4.2 V, less cable losses
_FULL = 1.25  # largest ratio of supply to a servo's limit: full batteries, overdriven small servos (1.22)
_HOTTEST = 95.0  # highest plausible temperature [C]: no servo file allows more
_WEIGHS = (0.7, 4.0)  # plausible ratio of servo torque to pendulum weight: 0.86 to 2.7 in 108 recordings


@check("plausible metadata")
def plausible(view: View) -> Found:
    """Mass, length or battery is implausible, or the battery does not fit the voltage; the likely unit is named."""
    for name, (unit, least, most, typical) in _PLAUSIBLE.items():
        value = getattr(view.metadata, name)
        if value is None or least <= value <= most:
            continue
        problem, remedy = f"{value:g} {unit} is impossible", f"write {name} in {unit}"
        likely = plausible_unit(value, unit, typical)
        if likely and least <= likely[1] <= most:
            problem += f"; {value:g} {likely[0]} would be {likely[1]:.4g} {unit}"
            remedy = f"write {name}: {likely[1]:.4g}"
        yield view.found(f"field {name}", problem, remedy, error=True)
    median, battery = view.supply() or 0.0, view.metadata.battery
    if battery and median > 2 and (unit := likely_unit(battery / median, "V", 0.3)):
        problem = f"{battery:g} V does not fit the measured {median:.4g} V; it looks like {unit}"
        yield view.found("field battery", problem, f"write battery: {median:.3g}", error=True)


@check("spelling of joints")
def spelling(view: View) -> Found:
    """Two joint names differ only in capital letters and probably mean the same joint."""
    first: dict[str, str] = {}
    for joint in view.joints:
        if (other := first.setdefault(joint.lower(), joint)) != joint:
            problem = f"{other} and {joint} differ only in capital letters"
            yield view.found("field joints", problem, "use one name if they are the same joint")


@check("wrong robot")
def robot(view: View) -> Found:
    """The robot in the metadata does not exist, or does not have the joints of the log."""
    if view.metadata.robot_file is None:
        return
    try:
        known = view.log.named_robot
    except LogError as error:  # the log can still be read; commands that need its robot reject it
        yield view.found("field robot_file", error.problem, error.remedy)
        return
    for odd in [joint for joint in view.joints if joint not in known.joints][:1]:
        remedy = rename(odd, known.joints, f"correct robot_file; {known.name} has {', '.join(known.joints)}")
        yield view.found("field joints", f"{odd} is not a joint of {known.name}", remedy, error=True)


@check("unknown servo")
def servo(view: View) -> Found:
    """The servo in the metadata has no file, so its law and units are unknown, or the robot has other servos."""
    if (name := view.metadata.servo) is None:
        return
    makes = {make.name for make in view.log.servos if make is not None} if view.metadata.robot_file else set()
    if view.make is None:
        known = {alias: make for make in servo_files() for alias in (make, *load_servo(make).aliases)}
        there = f"use one of {', '.join(servo_files())}, or add a file for a new servo in assets/servos"
        remedy = rename(name, known, there)
        yield view.found("field servo", f"there is no servo {name!r}", remedy)
    elif makes and view.make.name not in makes:
        problem = f"the servo is {name} in the metadata, and {view.metadata.robot_file} has {', '.join(sorted(makes))}"
        yield view.found("field servo", problem, "correct one of them")


@check("weight of the pendulum", rows=100, unless="two clocks")
def weight(view: View) -> Found:
    """The servo's torque does not match the weight of its pendulum: mass, length, gain or supply is wrong."""
    about, make, gain = view.metadata, view.make, view.duty_gain
    if about.mount != "pendulum" or make is None or gain is None:
        return
    assert make.position_law is not None
    most, angle, speed = make.position_law.max_duty.si / gain[:, 0], view.position[:, 0], view.speed[:, 0]
    torque, span = view.stiffness[0] * np.clip(-view.error[:, 0], -most, most), view.windows[2]
    used = view.turned(np.cumsum(~view.driven[:, 0])) == 0
    mean = view.summed(np.stack([torque, np.sin(angle), speed, np.tanh(speed / 0.2)], axis=1))[used] / span
    if len(mean) < 10 * OVERLAP:
        return
    # the weight depends on the angle, damping on the speed, friction on its direction, and inertia
    causes = np.column_stack([mean[:, 1:], view.turned(speed)[used]])
    pushed = float(fitted(causes, mean[:, 0])[0]) / (9.81 * (about.mass or 0.0) * (about.length or 0.0))
    if np.ptp(mean[:, 1]) > 0.3 and not _WEIGHS[0] < pushed < _WEIGHS[1]:
        problem = f"the servo's torque is {pushed:.2g} times the weight of {about.mass:g} kg at {about.length:g} m, by "
        gain, volts = np.median(view.log.array(FIRMWARE_GAIN)), view.supply() or make.supply.si
        problem += f"a gain of {gain:g} at {volts:g} V"
        yield view.found("field mass", problem, "check mass, length, firmware_gain, battery and servo")


@check("few rows")
def few(view: View) -> Found:
    """There are too few rows for most checks."""
    if len(view.time) < 20:
        yield view.found("time", f"{len(view.time)} rows are too few for the checks", "record a longer log")


@check("gains")
def gains(view: View) -> Found:
    """A gain in a column differs from the metadata, or P and D gains were swapped."""
    for name in ("firmware_gain", "p_gain", "d_gain"):
        column, said = view.get(("command", name)), getattr(view.metadata, name)
        if column is None or said is None or (np.abs(column - said) <= 1e-6 * max(1.0, said)).any():
            continue
        problem = f"{name} is {said:g} in the metadata but {column[0, 0]:g} in the column"
        remedy = "correct one of them, or remove the column to use the metadata for every row"
        yield view.found((("command", name), 0), problem, remedy, 0, error=True)
    p, d = (0.0 if (gain := view.get(key)) is None else np.median(gain) for key in (P_GAIN, D_GAIN))
    if 0 < p < d:
        problem = f"the D gains (median {d:g} A s/rad) are above the P gains ({p:g} A/rad): a joint would need over a "
        problem += "second to follow; the columns may be swapped"
        yield view.found((P_GAIN, 0), problem, "swap the columns, or convert the gains to SI")


@check("supply and temperature")
def supply(view: View) -> Found:
    """A voltage does not fit the battery, or a temperature is impossible for a working servo."""
    servos, battery, shares = view.log.servos, view.metadata.battery or 0.0, dict[str, float]()
    makes = {make.name: make for make in (view.make, *servos) if make is not None}
    for make in makes.values() if len(makes) == 1 else ():
        read, low, high = view.supply() or 0.0, make.limits.low_voltage.si, make.limits.high_voltage.si
        if 1 < read < 60 and not low / _FULL < read < high * _FULL:
            problem = f"the supply is {read:.3g} V, but the servo file {make.name} is valid from {low:g} to "
            problem += f"{high:g} V: this must be another variant of the {make.name} with another motor and gear"
            remedy = f"write the variant's name or file under `servo:`; the constants of {make.name} do not apply to it"
            yield view.found("field servo", problem, remedy)
    if any(servos) and view.metadata.mount != "pendulum":  # a small servo has a separate converter
        known = view.log.named_robot
        shares = dict(zip(known.joints, known.supply_shares.tolist(), strict=True))
    for key, joint, column in view.columns(VOLTAGE):
        median, full = float(np.median(column)), battery * shares.get(view.joints[joint], 1.0)
        if full and 0 < median <= 30 and not _CHARGE[0] < median / full < _CHARGE[1]:
            problem = f"the median voltage {median:.4g} V does not fit the battery of {full:.3g} V"
            yield view.found((key, joint), problem, "convert it to volts, or correct `battery`", aside=True)
        if median > 1 and (gone := column < 0.3 * median).any():
            problem = f"{gone.sum()} rows contain {column[gone].min():.3g} V, at which no servo can answer"
            yield view.found((key, joint), problem, "remove these rows", gone.argmax(), aside=True)
    for key, joint, column in view.columns(TEMPERATURE):
        median, make = float(np.median(column)), servos[joint]
        hottest, celsius = _HOTTEST if make is None else make.limits.temperature.si, (median - 32) / 1.8
        if not -10 <= median <= hottest and median <= 150:  # beyond 150 the bound reports it
            unit = f", but {median:.4g} F would be {celsius:.3g} C" if -10 <= celsius <= hottest else ""
            problem = f"the median temperature {median:.4g} C is impossible for a working servo{unit}"
            yield view.found((key, joint), problem, "convert it to degrees Celsius", aside=True)
