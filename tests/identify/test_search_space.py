"""The search space: ranges in Hydra's grammar become Optuna distributions, or one clear sentence."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.distributions import FloatDistribution

from op3.identify.search_space import StudyError, check_nominal, parse_range, parse_search_space

finite = st.floats(min_value=-1e12, max_value=1e12, allow_nan=False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("interval(0.003, 0.009)", FloatDistribution(0.003, 0.009)),
        ("interval(0, 1)", FloatDistribution(0.0, 1.0)),
        ("tag(log, interval(1e-3, 1))", FloatDistribution(1e-3, 1.0, log=True)),
    ],
)
def test_a_range_is_read_as_hydra_writes_it(text, expected):
    """Every documented form gives its distribution."""
    assert parse_range("servo.kt", text) == expected


@given(low=finite, high=finite)
def test_an_interval_keeps_its_ends_exactly_or_is_refused(low, high):
    """Two numbers in order give those very ends; otherwise the message names the key."""
    text = f"interval({low!r}, {high!r})"
    if low < high:
        distribution = parse_range("servo.kt", text)
        assert (distribution.low, distribution.high) == (low, high)
    else:
        with pytest.raises(StudyError, match=r"servo\.kt.*not below"):
            parse_range("servo.kt", text)


@given(st.text(max_size=40))
def test_any_text_is_a_range_or_one_sentence(text):
    """No text escapes as another kind of exception."""
    with contextlib.suppress(StudyError):
        parse_range("servo.kt", text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("tag(log, interval(0, 1))", "above 0"),
        ("interval(nan, 1)", "finite"),
        ("interval(0, inf)", "finite"),
        ("tag(cubic, interval(0, 1))", "cubic"),
        ("int(interval(1, 8))", "finite numbers"),
        ("choice(1, 2)", "not an interval"),
        ("interval(1", "not a valid range"),
        ("between(0, 1)", "not a valid range"),
        ("0.5", "not an interval"),
        (None, "not an interval"),
    ],
)
def test_a_wrong_range_says_which_key_and_what_to_write(text, reason):
    """The message names the key and the reason."""
    with pytest.raises(StudyError, match=reason) as caught:
        parse_range("servo.kt", text)
    assert "servo.kt" in str(caught.value)


def test_nested_params_mean_dotted_keys_and_null_is_not_searched():
    """`hydra.sweeper.params.servo.kt=...` makes a nested mapping; null takes a key out of the search of a config."""
    nested = parse_search_space({"servo": {"motor": {"kt": "interval(0, 1)"}}, "kp": "interval(0, 6)", "kd": None})
    assert nested == {"servo.motor.kt": FloatDistribution(0, 1), "kp": FloatDistribution(0, 6)}


@pytest.mark.parametrize("params", [None, {}, {"servo": {}}, {"kp": None}])
def test_an_empty_search_space_is_refused(params):
    """A study without parameters is a mistake in the config."""
    with pytest.raises(StudyError, match=r"hydra\.sweeper\.params"):
        parse_search_space(params)


@pytest.mark.parametrize(
    ("nominal", "reason"),
    [({"kt": 2.0}, "outside"), ({}, "no nominal"), ({"kt": None}, "no nominal"), ({"kt": "big"}, "outside")],
)
def test_a_nominal_value_outside_its_range_is_refused(nominal, reason):
    """The baseline must be a point of the search space, in which 1 is 1.0."""
    with pytest.raises(StudyError, match=reason):
        check_nominal({"kt": FloatDistribution(0, 1)}, nominal)
    assert check_nominal({"kt": FloatDistribution(0, 1)}, {"kt": 1, "other": 3}) == {"kt": 1.0}
