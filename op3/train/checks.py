"""Checks that the groups of settings share: a config writes 1e6 for a million, and a word where a number belongs."""

from typing import Any


def whole(settings: Any, least: int, *names: str) -> None:
    """Make these fields of a frozen dataclass whole numbers; a float without a fraction, such as 1e6, becomes one.

    Raises:
        ValueError: if one is no whole number of at least `least`.
    """
    for name in names:
        value = getattr(settings, name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or value < least or not float(value).is_integer():
            raise ValueError(f"{name} must be at least {least} and a whole number, got {value!r}")
        object.__setattr__(settings, name, int(value))


def numbers(settings: Any, *names: str) -> None:
    """Check that these fields are numbers.

    Raises:
        ValueError: if one is not.
    """
    for name in names:
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} must be a number, got {value!r}")
