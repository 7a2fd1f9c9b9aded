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


class SearchSpaceError(ValueError):
    """A range that cannot be searched; the message names the key and says how to write it."""


def parse_search_space(params: Mapping[str, Any] | None) -> SearchSpace:
    """Read the ranges of all parameters.

    Args:
        params: config key -> range in Hydra's grammar. A nested mapping `{"motor": {"kt": ...}}`
            means the dotted key `motor.kt`, because that is what a command line override makes. A range of
            null takes the key out of the search.

    Returns:
        The Optuna distribution of every key, in the order given.

    Raises:
        SearchSpaceError: if there is no parameter, or a range is not one.
    """
    flat = {key: text for key, text in _flatten(params or {}).items() if text is not None}
    if not flat:
        raise SearchSpaceError(
            "There is nothing to search: add at least one `<config key>: interval(low, high)` to hydra.sweeper.params."
        )
    return {key: parse_range(key, text) for key, text in flat.items()}


def parse_range(key: str, text: Any) -> BaseDistribution:
    """Read one range, such as `interval(0.003, 0.009)`, of the config key `key`."""
    if not isinstance(text, str):
        raise SearchSpaceError(f"{key}: {text!r} is a value, not a range: {_REMEDY}.")
    try:
        # The key is checked against the config elsewhere; a fixed name keeps odd keys out of the grammar.
        value = OverridesParser.create().parse_override(f"x={text}")._value
    except HydraException as error:
        reason = str(error).strip().splitlines()[0]
        raise SearchSpaceError(f"{key}: {text!r} is not a range ({reason}): {_REMEDY}.") from error
    if isinstance(value, IntervalSweep):
        return _interval(key, text, value)
    if isinstance(value, RangeSweep):
        return _range(key, text, value)
    if isinstance(value, ChoiceSweep):
        return _choice(key, text, value)
    raise SearchSpaceError(f"{key}: {text!r} is a value, not a range: {_REMEDY}.")


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
            raise SearchSpaceError(
                f"{key}: the config gives no nominal value: set `{key}` in the config, "
                "or start without one by nominal=false."
            )
        value = nominal[key]
        try:
            inside = distribution._contains(distribution.to_internal_repr(value))
        except (TypeError, ValueError):
            inside = False
        if not inside:
            raise SearchSpaceError(
                f"{key}: the nominal value {value!r} lies outside {describe(distribution)}: widen the range, "
                "change the nominal value, or start without one by nominal=false."
            )
        # An integer such as 1 in a float range would make the stored trial differ in type from its peers.
        checked[key] = float(value) if isinstance(distribution, FloatDistribution) else value
    return checked


def describe(distribution: BaseDistribution) -> str:
    """Write a distribution the way the user wrote it."""
    if isinstance(distribution, CategoricalDistribution):
        return f"choice({', '.join(str(choice) for choice in distribution.choices)})"
    if not isinstance(distribution, FloatDistribution | IntDistribution):
        return str(distribution)
    text = f"interval({distribution.low:g}, {distribution.high:g})"
    text = f"tag(log, {text})" if distribution.log else text
    return f"int({text})" if isinstance(distribution, IntDistribution) else text


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


def _interval(key: str, text: str, sweep: IntervalSweep) -> BaseDistribution:
    low, high = sweep.start, sweep.end
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        raise SearchSpaceError(f"{key}: the ends of {text!r} must be finite numbers.")
    log = _log_tag(key, text, sweep.tags)
    if low >= high:
        raise SearchSpaceError(
            f"{key}: the lower end {low:g} of {text!r} is not below the upper end {high:g}: swap or widen them."
        )
    if log and low <= 0:
        raise SearchSpaceError(
            f"{key}: {text!r} is sampled in the logarithm, so its lower end must be above 0, not {low:g}."
        )
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log)
    return FloatDistribution(float(low), float(high), log=log)


def _range(key: str, text: str, sweep: RangeSweep) -> BaseDistribution:
    _log_tag(key, text, sweep.tags, allowed=False)
    values = list(sweep.range()) if sweep.step else []
    if len(values) < 2 or sweep.step < 0:
        raise SearchSpaceError(f"{key}: {text!r} holds {len(values)} values, it needs at least two, counted upwards.")
    if all(isinstance(value, int) for value in values):
        return IntDistribution(int(values[0]), int(values[-1]), step=int(sweep.step))
    return FloatDistribution(float(values[0]), float(values[-1]), step=float(sweep.step))


def _choice(key: str, text: str, sweep: ChoiceSweep) -> BaseDistribution:
    _log_tag(key, text, sweep.tags, allowed=False)
    choices: list[bool | int | float | str] = []
    for item in sweep.list:
        value = item.text if isinstance(item, QuotedString) else item
        if not isinstance(value, bool | int | float | str):
            raise SearchSpaceError(
                f"{key}: {text!r} offers {value!r}; a choice must be a number, a text or a boolean. "
                "To compare lists or groups, sweep over them on the command line: one study each."
            )
        choices.append(value)
    return CategoricalDistribution(choices)


def _log_tag(key: str, text: str, tags: set[str], allowed: bool = True) -> bool:
    known = {"log"} if allowed else set()
    unknown = sorted(tags - known)
    if unknown:
        hint = "only `log` is known" if allowed else "tags belong to intervals"
        raise SearchSpaceError(f"{key}: {text!r} has the tag {unknown[0]!r}; {hint}.")
    return "log" in tags
