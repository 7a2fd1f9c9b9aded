"""What a model's parameters are at a secant of an effect."""

from collections.abc import Mapping

from op3.servo import parameter


def secant_values(secant: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    """Values moved by the secant from what they are or are neutral at, kept within what physics allows."""
    start = {
        name: 0.0 if parameter(name).neutral is None else values.get(name, parameter(name).neutral) for name in secant
    }
    return {
        name: min(max(start[name] + change, parameter(name).least), parameter(name).most)
        for name, change in secant.items()
    }
