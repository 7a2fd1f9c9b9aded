"""Checks of what is said beside the samples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.robot.servo_make import load_servo, servo_files
from op3.rollout.errors import LogError, rename
from op3.rollout.health.finding import ERROR, WARNING, LogFinding, View, check
from op3.rollout.health.match import fitted, integral, windows
from op3.rollout.units import likely_unit, plausible_unit

_PLAUSIBLE = {"mass": ("kg", 1e-3, 50.0, 0.4), "length": ("m", 5e-3, 3.0, 0.12), "battery": ("V", 2.0, 60.0, 11.0)}
"""Unit, smallest, largest and a typical value of what a bench's sidecar says."""


_CHARGE = (0.7, 1.3)
"""Voltage over that of the battery: a cell of 3.7 V gives 3.0 to 4.2 V, and cables and load take some of it."""

_FULL = 1.35
"""By so much supplies exceed a servo's limits at most: a battery is full, or a bench runs a small servo hard (1.22)."""

_HOTTEST = 95.0
"""No servo works at such a temperature [C]: the files of makes let none get hotter."""


@check("plausible metadata")
def plausible(view: View) -> Iterator[LogFinding]:
    """Mass, length or battery is far from that of any robot or bench, or from the voltage; the likely unit is named."""
    for name, (unit, least, most, typical) in _PLAUSIBLE.items():
        value = getattr(view.metadata, name)
        if value is None or least <= value <= most:
            continue
        likely = plausible_unit(value, unit, typical)
        likely = likely if likely and least <= likely[1] <= most else None
        guess = f"; {value:g} {likely[0]} would be {likely[1]:.4g} {unit}" if likely else ""
        remedy = f"write {name}: {likely[1]:.4g}" if likely else f"write {name} in {unit}"
        yield view.found(ERROR, f"field {name}", f"{value:g} {unit} cannot be{guess}", remedy)
    volts, battery = view.get(("joint", "voltage")), view.metadata.battery
    if battery and volts is not None and (median := float(np.median(volts))) > 2:
        unit = likely_unit(battery / median, "V", 0.3)
        if unit:
            problem = f"{battery:g} V does not fit the measured {median:.4g} V; it looks like {unit}"
            yield view.found(ERROR, "field battery", problem, f"write battery: {median:.3g}")


@check("spelling of joints")
def spelling(view: View) -> Iterator[LogFinding]:
    """Two joints differ in capital letters only: one joint that is spelled in two ways."""
    lower = [joint.lower() for joint in view.joints]
    for one, other in ((a, b) for i, a in enumerate(lower) for b in range(i + 1, len(lower)) if lower[b] == a):
        problem = f"{view.joints[lower.index(one)]} and {view.joints[other]} differ in capital letters only"
        yield view.found(WARNING, "field joints", problem, "give them one name if they are one joint")


@check("wrong robot")
def robot(view: View) -> Iterator[LogFinding]:
    """The robot that the metadata name is not there, or joints of the log are none of its."""
    if view.metadata.robot_file is None:
        return
    try:
        known = view.log.named_robot
    except LogError as error:  # the log can be read all the same; who needs its robot refuses it
        yield view.found(WARNING, "field robot_file", error.problem, error.remedy)
        return
    odd = next((joint for joint in view.joints if joint not in known.joints), None)
    if odd is not None:
        remedy = rename(odd, known.joints, f"correct robot_file; {known.name} has {', '.join(known.joints)}")
        yield view.found(ERROR, "field joints", f"{odd} is not a joint of {known.name}", remedy)


@check("unknown servo")
def servo(view: View) -> Iterator[LogFinding]:
    """The servo that the metadata name has no file, so that nothing is known of its law and its units, or is none of
    those of the robot that they name."""
    if (name := view.metadata.servo) is None:
        return
    if view.make is not None:
        own = {make.name for make in view.log.servos if make is not None}
        if view.metadata.robot_file is not None and own and view.make.name not in own:
            problem = (
                f"the servo is {name} in the metadata, and {view.metadata.robot_file} has {', '.join(sorted(own))}"
            )
            yield view.found(WARNING, "field servo", problem, "correct one of them")
        return
    known = {alias: make for make in servo_files() for alias in (make, *load_servo(make).aliases)}
    remedy = rename(name, known, f"known are {', '.join(servo_files())}, and a new one is one file in assets/servos")
    yield view.found(WARNING, "field servo", f"nothing is known of a servo {name!r}", remedy)


_LOAD = (0.7, 4.0)
"""What a servo pushes with over what its pendulum weighs, by its constants: 0.86 to 2.7 in 108 recordings of two makes,
as friction and the arm come to the mass."""


@check("weight of the pendulum", unless=("two clocks",))
def weight(view: View) -> Iterator[LogFinding]:
    """A servo pushes with far less or more than its pendulum weighs: mass, length, gain or supply are others."""
    about, gain, make = view.metadata, view.duty_gain, view.make
    if about.mount != "pendulum" or gain is None or make is None or len(view.time) < 100:
        return
    assert make.position_law is not None
    most, angle = make.position_law.max_duty.si, view.position[:, 0]
    volts = view.get(("joint", "voltage"))
    supply = float(np.median(volts)) if volts is not None and volts.any() else about.battery or make.supply.si
    stall = make.output_constant * supply / make.motor.terminal_resistance.si
    torque = stall * np.clip(gain[:, 0] * (view.command[:, 0] - angle), -most, most)
    speed = np.gradient(angle, view.time)
    first, last, span = windows(view.time)
    off = np.cumsum(~view.driven[:, 0])
    used = off[first] == off[last]
    first, last = first[used], last[used]
    if len(first) < 20:
        return
    summed = integral(view.time, np.stack([torque, np.sin(angle), speed, np.tanh(speed / 0.2)], axis=1))
    mean = (summed[last] - summed[first]) / span
    # what it weighs goes with the angle, damping with the speed, friction with its direction, and inertia
    causes = np.column_stack([mean[:, 1:], speed[last] - speed[first]])
    pushed = float(fitted(causes, mean[:, 0])[0]) / (9.81 * (about.mass or 0.0) * (about.length or 0.0))
    if np.ptp(mean[:, 1]) > 0.3 and not _LOAD[0] < pushed < _LOAD[1]:
        problem = f"the servo pushes with {pushed:.2g} times what {about.mass:g} kg at {about.length:g} m weigh, by a "
        problem += f"gain of {np.median(view.log.array(('command', 'firmware_gain'))):g} at {supply:g} V"
        yield view.found(WARNING, "field mass", problem, "look at mass, length, firmware_gain, battery and servo")


@check("few rows")
def few(view: View) -> Iterator[LogFinding]:
    """So few rows that most checks say nothing."""
    if len(view.time) < 20:
        yield view.found(WARNING, "time", f"{len(view.time)} rows are too few to be checked", "record for longer")


@check("gains")
def gains(view: View) -> Iterator[LogFinding]:
    """A gain in the columns is not the one in the metadata, or P and D gains were exchanged."""
    for name in ("firmware_gain", "p_gain", "d_gain"):
        key, said = ("command", name), getattr(view.metadata, name)
        column = view.get(key)
        if column is None or said is None or (np.abs(column - said) <= 1e-6 * max(1.0, said)).any():
            continue
        problem = f"{name} is {said:g} in the metadata and {column[0, 0]:g} in the column"
        remedy = "correct one of them; without the column the metadata's counts for every row"
        yield view.found(ERROR, (key, 0), problem, remedy, 0)
    p, d = view.get(("command", "p_gain")), view.get(("command", "d_gain"))
    if p is not None and d is not None and (0 < np.median(p) < np.median(d)):
        problem = (
            f"the D gains (median {np.median(d):g} A s/rad) are above the P gains ({np.median(p):g} A/rad): a joint "
        )
        problem += "would take over a second to follow; as if the columns were exchanged"
        yield view.found(WARNING, (("command", "p_gain"), 0), problem, "swap the columns, or convert the gains to SI")


@check("supply and temperature")
def supply(view: View) -> Iterator[LogFinding]:
    """Voltage is far from the battery's, or a temperature is none of a servo that works."""
    servos, told, shares = view.log.servos, view.metadata.battery, dict[str, float]()
    volts = view.get(("joint", "voltage"))
    makes = {make.name: make for make in (view.make, *servos) if make is not None}
    for make in makes.values() if len(makes) == 1 else ():
        median = 0.0 if volts is None else float(np.median(volts))
        read = median if 1 < median < 60 else told if view.metadata.mount == "pendulum" else None
        low, high = make.limits.low_voltage.si, make.limits.high_voltage.si
        if read and not low / _FULL < read < high * _FULL:
            problem = f"{read:.3g} V supply a {make.name}, whose file holds from {low:g} to {high:g} V: it is another "
            problem += f"variant of the {make.name}, with another motor and gear"
            remedy = f"name its own make or file under `servo:`; the constants of {make.name} are wrong for it"
            yield view.found(WARNING, "field servo", problem, remedy)
    if any(servos) and view.metadata.mount != "pendulum":  # a small servo has a converter of its own
        known = view.log.named_robot
        shares = dict(zip(known.joints, known.supply_shares.tolist(), strict=True))
    for key, joint, column in view.columns(("joint", "voltage"), ("joint", "temperature")):
        median, make = float(np.median(column)), servos[joint]
        battery = (told or 0.0) * shares.get(view.joints[joint], 1.0)
        if key[1] == "voltage" and battery and 0 < median <= 30 and not _CHARGE[0] < median / battery < _CHARGE[1]:
            problem = f"the median voltage {median:.4g} V does not fit the battery of {battery:.3g} V"
            yield view.found(WARNING, (key, joint), problem, "convert it to volts, or correct `battery`", aside=True)
        if key[1] == "voltage" and median > 1 and (gone := column < 0.3 * median).any():
            problem = f"{gone.sum()} rows read {column[gone].min():.3g} V, at which no servo answers"
            yield view.found(WARNING, (key, joint), problem, "leave these rows out", gone.argmax(), aside=True)
        hottest = _HOTTEST if make is None else make.limits.temperature.si
        if key[1] == "temperature" and not -10 <= median <= hottest and median <= 150:  # beyond it its bound speaks
            fahrenheit = (median - 32) / 1.8
            unit = f", but {median:.4g} F would be {fahrenheit:.3g} C" if -10 <= fahrenheit <= hottest else ""
            problem = f"the median temperature {median:.4g} C is none of a working servo{unit}"
            yield view.found(WARNING, (key, joint), problem, "convert it to degrees Celsius", aside=True)
