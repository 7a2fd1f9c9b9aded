"""Checks of what is said beside the samples."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.errors import LogError, rename
from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.units import likely_unit, plausible_unit

_PLAUSIBLE = {"mass": ("kg", 1e-3, 50.0, 0.4), "length": ("m", 5e-3, 3.0, 0.12), "battery": ("V", 2.0, 60.0, 11.0)}
"""Unit, smallest, largest and a typical value of what a bench's sidecar says."""


_CHARGE = (0.7, 1.3)
"""Voltage over that of the battery: a cell of 3.7 V gives 3.0 to 4.2 V, and cables and load take some of it."""


@check("plausible metadata")
def plausible(view: View) -> Iterator[Finding]:
    """Mass, length or battery is far from that of any robot or bench, or from the voltage; the likely unit is named."""
    for name, (unit, least, most, typical) in _PLAUSIBLE.items():
        value = getattr(view.metadata, name)
        if value is None or least <= value <= most:
            continue
        likely = plausible_unit(value, unit, typical)
        guess = f"; {value:g} {likely[0]} would be {likely[1]:.4g} {unit}" if likely else ""
        remedy = f"write {name}: {likely[1]:.4g}" if likely else f"write {name} in {unit}"
        yield view.found(ERROR, f"field {name}", f"{value:g} {unit} cannot be{guess}", remedy)
    volts, battery = view.get(("joint", "voltage")), view.metadata.battery
    if battery and volts is not None and (median := float(np.median(volts))) > 2:
        unit = likely_unit(battery / median, "V", 0.3)
        if unit:
            problem = f"{battery:g} V does not fit the measured {median:.4g} V; it looks like {unit}"
            yield view.found(ERROR, "field battery", problem, f"write battery: {median:.3g}")


@check("wrong robot")
def robot(view: View) -> Iterator[Finding]:
    """The robot that the metadata name is not there, or joints of the log are none of its."""
    if view.metadata.robot_file is None:
        return
    try:
        known = view.log.robot
    except LogError as error:  # the log can be read all the same; who needs its robot refuses it
        yield view.found(WARNING, "field robot_file", error.problem, error.remedy)
        return
    odd = next((joint for joint in view.joints if joint not in known.joints), None)
    if odd is not None:
        remedy = rename(odd, known.joints, f"correct robot_file; {known.name} has {', '.join(known.joints)}")
        yield view.found(ERROR, "field joints", f"{odd} is no joint of {known.name}", remedy)


@check("firmware gain")
def firmware_gain(view: View) -> Iterator[Finding]:
    """The gain in the columns is not the one in the metadata."""
    key, said = ("command", "firmware_gain"), view.metadata.firmware_gain
    gains = view.get(key)
    if gains is None or said is None or (np.abs(gains - said) <= 1e-6 * max(1.0, said)).any():
        return
    problem = f"firmware_gain is {said:g} in the metadata and {gains[0, 0]:g} in the column"
    remedy = "correct one of them; without the column the metadata's counts for every row"
    yield view.found(ERROR, (key, 0), problem, remedy, 0)


@check("supply and temperature")
def supply(view: View) -> Iterator[Finding]:
    """Voltage is far from the battery's, or a temperature is none of a servo."""
    battery = view.metadata.battery
    for key, joint, column in view.columns(("joint", "voltage"), ("joint", "temperature")):
        median = float(np.median(column))
        if key[1] == "voltage" and battery and 0 < median <= 30 and not _CHARGE[0] < median / battery < _CHARGE[1]:
            problem = f"the median voltage {median:.4g} V does not fit the battery of {battery:g} V"
            yield view.found(WARNING, (key, joint), problem, "convert it to volts, or correct `battery`", aside=True)
        if key[1] == "temperature" and not -10 <= median <= 95 and median <= 150:  # beyond that its bound speaks
            problem = f"the median temperature {median:.4g} C is none of a working servo"
            yield view.found(WARNING, (key, joint), problem, "convert it to degrees Celsius", aside=True)
