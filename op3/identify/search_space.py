"""The search space: the config keys that an identification varies, and their ranges.

A range is written in Hydra's override grammar: ``interval(0.003, 0.009)`` means any number between the two ends
inclusive, and ``tag(log, interval(1e-3, 1.0))`` is sampled uniformly in the logarithm.
"""

import json
import math
from collections.abc import Mapping
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import HydraException
from optuna.distributions import FloatDistribution, distribution_to_json

SearchSpace = dict[str, FloatDistribution]
"""Config key -> range of values."""


class StudyError(ValueError):
    """A study that cannot start or continue; the message states the reason and the remedy."""


def parse_search_space(params: Mapping[str, Any] | None) -> SearchSpace:
    """Read the ranges of all parameters.

    Args:
        params: config key -> range in Hydra's grammar. A nested mapping `{"motor": {"kt": ...}}` means the dotted key
            `motor.kt`, because overrides create nested mappings. A range of null removes the key from the search.

    Raises:
        StudyError: if there are no parameters, or a range is invalid.
    """
    flat = {key: text for key, text in _flatten(params or {}).items() if text is not None}
    if not flat:
        raise StudyError(
            "There is nothing to search: add at least one `<config key>: interval(low, high)` to hydra.sweeper.params."
        )
    return {key: parse_range(key, text) for key, text in flat.items()}


def parse_range(key: str, text: Any) -> FloatDistribution:
    """Read one range, such as `interval(0.003, 0.009)`, of the config key `key`."""
    try:
        # The key is checked against the config elsewhere; a fixed name keeps odd keys out of the grammar.
        sweep = OverridesParser.create().parse_override(f"x={text}")._value if isinstance(text, str) else text
        if not isinstance(sweep, IntervalSweep):
            raise ValueError("it is not an interval")
        if sweep.tags - {"log"}:
            raise ValueError(f"the only tag is `log`, got {', '.join(sorted(sweep.tags))}")
        low, high, log = sweep.start, sweep.end, "log" in sweep.tags
        if not (isinstance(low, float) and isinstance(high, float) and math.isfinite(low) and math.isfinite(high)):
            raise ValueError("its bounds are not finite numbers")
        if low >= high:
            raise ValueError(f"its lower bound {low:g} is not below its upper bound {high:g}")
        if log and low <= 0:
            raise ValueError(f"a logarithmic range needs a lower bound above 0, got {low:g}")
        return FloatDistribution(low, high, log=log)
    except (HydraException, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise StudyError(
            f"{key}: {reason}, so {text!r} is not a valid range: write interval(low, high) or"
            " tag(log, interval(low, high))."
        ) from error


def check_nominal(search_space: SearchSpace, nominal: Mapping[str, Any]) -> dict[str, float]:
    """The nominal value of every parameter, in the order of the search space.

    The nominal trial is compared with every other trial, so the samplers must be able to learn from it.

    Raises:
        StudyError: if a value is missing or outside its range.
    """
    checked = {}
    for key, known in search_space.items():
        value = nominal.get(key)
        if value is None:
            raise StudyError(
                f"{key}: the config gives no nominal value: set `{key}` in the config, "
                "or disable the nominal trial with nominal=false."
            )
        if not isinstance(value, int | float) or not known.low <= value <= known.high:
            raise StudyError(
                f"{key}: the nominal value {value!r} is outside interval({known.low:g}, {known.high:g}): widen the "
                "range, change the nominal value, or disable the nominal trial with nominal=false."
            )
        checked[key] = float(value)
    return checked


def search_space_to_json(search_space: SearchSpace) -> str:
    """Write a search space as text, so that a resumed study can be compared with its first run."""
    return json.dumps({key: distribution_to_json(search_space[key]) for key in sorted(search_space)})


def _flatten(params: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in params.items():
        name = f"{prefix}{key}"
        flat |= _flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat
