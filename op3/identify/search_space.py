"""The search space: which config keys an identification varies, and over which values.

A range is written in Hydra's own override grammar, as text:

=====================================  ==================================================
``interval(0.003, 0.009)``             any real number between the two, ends included
``tag(log, interval(1e-3, 1.0))``      the same, sampled evenly in the logarithm
``int(interval(1, 8))``                an integer, ends included
``range(0, 10, step=2)``               0, 2, 4, 6, 8: the end is left out, as in Python
``choice(dte, dte_passive)``           one of the listed values
=====================================  ==================================================

Source of the grammar: https://hydra.cc/docs/advanced/override_grammar/extended/
"""

import json
import math
from collections.abc import Mapping
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, QuotedString, RangeSweep
from hydra.errors import HydraException
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    distribution_to_json,
)

SearchSpace = dict[str, BaseDistribution]
"""Config key -> the values it may take."""

_REMEDY = (
    "write interval(low, high), tag(log, interval(low, high)), int(interval(low, high)), "
    "range(start, stop) or choice(a, b)"
)


class StudyError(ValueError):
    """A study that cannot be, or cannot go on; the message says why, and what to write instead."""


def parse_search_space(params: Mapping[str, Any] | None) -> SearchSpace:
    """Read the ranges of all parameters.

    Args:
        params: config key -> range in Hydra's grammar. A nested mapping `{"motor": {"kt": ...}}`
            means the dotted key `motor.kt`, because that is what a command line override makes. A range of
            null takes the key out of the search.

    Returns:
        The Optuna distribution of every key, in the order given.

    Raises:
        StudyError: if there is no parameter, or a range is not one.
    """
    flat = {key: text for key, text in _flatten(params or {}).items() if text is not None}
    if not flat:
        raise StudyError(
            "There is nothing to search: add at least one `<config key>: interval(low, high)` to hydra.sweeper.params."
        )
    return {key: parse_range(key, text) for key, text in flat.items()}


def parse_range(key: str, text: Any) -> BaseDistribution:
    """Read one range, such as `interval(0.003, 0.009)`, of the config key `key`."""
    try:
        # The key is checked against the config elsewhere; a fixed name keeps odd keys out of the grammar.
        sweep = OverridesParser.create().parse_override(f"x={text}")._value if isinstance(text, str) else text
        return _distribution(sweep)
    except (HydraException, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise StudyError(f"{key}: {reason}, and so {text!r} is not a range: {_REMEDY}.") from error


def check_nominal(search_space: Mapping[str, BaseDistribution], nominal: Mapping[str, Any]) -> dict[str, Any]:
    """Check that the nominal value of every parameter lies in its range.

    The nominal trial is the baseline every other trial is compared with, so it must be one the
    samplers can learn from.

    Returns:
        The nominal values, in the order of the search space.
    """
    checked = {}
    for key, distribution in search_space.items():
        if nominal.get(key) is None:
            raise StudyError(
                f"{key}: the config gives no nominal value: set `{key}` in the config, "
                "or start without one by nominal=false."
            )
        value = nominal[key]
        try:
            inside = distribution._contains(distribution.to_internal_repr(value))
        except (TypeError, ValueError):
            inside = False
        if not inside:
            raise StudyError(
                f"{key}: the nominal value {value!r} lies outside {_ends(distribution)}: widen the range, "
                "change the nominal value, or start without one by nominal=false."
            )
        # An integer such as 1 in a float range would make the stored trial differ in type from its peers.
        checked[key] = float(value) if isinstance(distribution, FloatDistribution) else value
    return checked


def search_space_to_json(search_space: Mapping[str, BaseDistribution]) -> str:
    """Write a search space as text, so that a resumed study can be compared with its first run."""
    return json.dumps({key: distribution_to_json(search_space[key]) for key in sorted(search_space)})


def _flatten(params: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in params.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(_flatten(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def _ends(distribution: BaseDistribution) -> str:
    if isinstance(distribution, FloatDistribution | IntDistribution):
        return f"interval({distribution.low:g}, {distribution.high:g})"
    return str(distribution)


def _distribution(sweep: Any) -> BaseDistribution:
    """The distribution that a parsed range means.

    Raises:
        ValueError: if it is none.
    """
    tags = set(getattr(sweep, "tags", ()))
    if tags - ({"log"} if isinstance(sweep, IntervalSweep) else set()):
        raise ValueError(f"of tags only `log` of an interval is known, not {', '.join(sorted(tags))}")
    if isinstance(sweep, IntervalSweep):
        return _interval(sweep.start, sweep.end, "log" in tags)
    if isinstance(sweep, RangeSweep):
        values = list(sweep.range()) if sweep.step else []
        if len(values) < 2 or sweep.step < 0:
            raise ValueError(f"it holds {len(values)} values and needs at least two, counted upwards")
        if all(isinstance(value, int) for value in values):
            return IntDistribution(int(values[0]), int(values[-1]), step=int(sweep.step))
        return FloatDistribution(float(values[0]), float(values[-1]), step=float(sweep.step))
    if isinstance(sweep, ChoiceSweep):
        choices: list[Any] = [item.text if isinstance(item, QuotedString) else item for item in sweep.list]
        if not all(isinstance(choice, bool | int | float | str) for choice in choices):
            raise ValueError("a choice is a number, a text or a boolean; sweep over lists on the command line")
        return CategoricalDistribution(choices)
    raise ValueError("it is a value, not a range")


def _interval(low: Any, high: Any, log: bool) -> BaseDistribution:
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError("the ends must be finite numbers")
    if low >= high:
        raise ValueError(f"the lower end {low:g} is not below the upper end {high:g}")
    if log and low <= 0:
        raise ValueError(f"a logarithm needs a lower end above 0, not {low:g}")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log)
    return FloatDistribution(float(low), float(high), log=log)
