"""How numbers are written, and the tables of parameters and loss terms."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.report.tables import loss_table, number, parameter_table, span
from op3.servo import Estimate, RobotModel
from op3.servo.effects import DirectionalEfficiency, Motor


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.25, "0.25"), (0.0123456, "0.01235"), (9.99996, "10.00"), (123456, "123456"), (-3, "−3"), (0.0, "0"),
     (3.2e-7, "3.200e-07"), (1.5, "1.5"), (-0.5, "−0.5"), (12345.6, "12346")],
)  # fmt: skip
def test_numbers_are_written_as_people_write_them(value, text):
    """Four significant digits, no padding of exact values, a true minus, integers whole."""
    assert number(value) == text


@given(st.floats(1e-9, 1e9), st.integers(2, 6))
def test_a_written_number_is_near_the_number(value, digits):
    """Reading back loses no more than half a unit of the last digit."""
    assert float(number(value, digits)) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits))


def test_a_value_stands_with_its_interval_where_there_is_one():
    """An estimate or three numbers; without an interval the value alone, without a value nothing."""
    assert span(Estimate(0.7, 0.6512, 0.75)) == span((0.7, 0.6512, 0.75)) == "0.700 (0.651 to 0.750)"
    assert (span((1.5, float("nan"), float("nan"))), span(None)) == ("1.5", None)


@pytest.mark.parametrize(
    ("values", "text"),
    [((0.6494, 0.5331, 0.7652), "0.65 (0.53 to 0.77)"), ((97.46, 20.7, 100.0), "97 (21 to 100)"),
     ((5.312e-5, 5.06e-5, 5.54e-5), "5.31e-05 (5.06e-05 to 5.54e-05)"), ((-0.01, -0.3, 0.3), "−0.01 (−0.30 to 0.30)")],
)  # fmt: skip
def test_a_value_has_at_most_one_digit_more_than_its_interval(values, text):
    """The second digit of the interval's width is the last one of all three numbers."""
    assert span(values) == text


def test_parameters_stand_with_unit_range_and_interval():
    """A parameter's row has its catalogue range, and no number under a model that lacks it."""
    found = RobotModel((Motor(), DirectionalEfficiency()), {"backward_efficiency": Estimate(0.7, 0.65, 0.75)})
    header, rows = parameter_table({"with": found, "without": RobotModel((Motor(),))})
    assert header == ["parameter", "unit", "range from", "to", "start", "with", "90 % from", "to", "without"]
    assert rows[-1] == ["backward efficiency", "-", 0.6, 1.0, 0.8, 0.7, 0.65, 0.75, None]


def test_loss_terms_stand_with_their_squared_units_and_gaps():
    """Channels come with units, a channel absent from one set of logs leaves a gap, and the total is last."""
    terms = {
        "fit": {"with": {"total": 3.0, "joint/position": 1.0, "joint/current": 2.0}},
        "held out": {"with": {("joint", "position"): 4.0, "total": 4.0}},
    }
    header, rows = loss_table(terms, total="total")
    assert header == ["mean square of", "unit", "fit, with", "held out, with"]
    assert rows == [["joint position", "rad²", 1.0, 4.0], ["joint current", "A²", 2.0, None], ["total", "", 3.0, 4.0]]
