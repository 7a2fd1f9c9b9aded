"""result.yaml: what is written is read back, and nonsense is refused."""

import math

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from op3.report import read_result, write_result
from op3.report.result import flatten
from op3.servo import Estimate

LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
KEYS = st.text("abcdefgh_/", min_size=1)


@given(st.dictionaries(KEYS, LEAVES | st.lists(LEAVES, max_size=3) | st.dictionaries(KEYS, LEAVES, min_size=1)))
def test_results_read_back_as_they_were_written(tmp_path_factory, values):
    """Any nested plain data come back flat, equal in value and type."""
    path = write_result(tmp_path_factory.mktemp("run") / "result.yaml", values)
    wanted = flatten(values)
    found = read_result(path) if wanted else {}
    assert found == wanted
    assert [type(value) for value in found.values()] == [type(value) for value in wanted.values()]


def test_keys_are_flat_and_parameters_are_entries(tmp_path):
    """Nested and dotted keys meet in one flat form; an estimate is one entry with its interval."""
    values = {
        "loss": {"fit": np.float64(0.031)},
        "loss.heldout": None,
        "parameters": {"armature": Estimate(5e-3, 4e-3, 6e-3)},
    }
    content = yaml.safe_load(write_result(tmp_path / "result.yaml", values).read_text())
    armature = {"value": 0.005, "low": 0.004, "high": 0.006}
    assert content == {"loss.fit": 0.031, "loss.heldout": None, "parameters.armature": armature}


def test_small_floats_stay_floats(tmp_path):
    """1e-05 is read as a number, which YAML 1.1 does not do for every spelling."""
    values = read_result(write_result(tmp_path / "result.yaml", {"a": 1e-05, "b": 1e300, "c": torch.tensor(2.0)}))
    assert values == {"a": 1e-05, "b": 1e300, "c": 2.0}
    assert all(isinstance(value, float) for value in values.values())


def test_the_file_says_what_keys_mean_and_in_which_unit(tmp_path):
    """Groups have a comment, parameters their unit."""
    values = {"error_mrad.train": 11.0, "parameters.torque_constant": {"value": 0.006}, "steps.done": 3}
    text = write_result(tmp_path / "result.yaml", values, meanings={"steps": "policy steps"}).read_text()
    assert "# error_mrad: mean absolute joint position error [mrad]" in text
    assert "parameters.torque_constant: {value: 0.006}  # [N m/A] at the motor shaft" in text
    assert "# steps: policy steps" in text


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float64("nan"), torch.tensor(math.inf)])
@pytest.mark.parametrize("wrap", [lambda x: x, lambda x: [1.0, x], lambda x: {"value": 1.0, "low": x}])
def test_numbers_that_are_not_finite_are_refused(tmp_path, bad, wrap):
    """The error names the key, and the file that was there stays."""
    path = write_result(tmp_path / "result.yaml", {"loss.fit": 1.0})
    with pytest.raises(ValueError, match=r"result loss\.fit\S* is -?(nan|inf): write a finite number, or None"):
        write_result(path, {"loss": {"fit": wrap(bad)}})
    assert read_result(path) == {"loss.fit": 1.0}
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.yaml"]


def test_what_is_no_plain_data_is_refused(tmp_path):
    """Values must be plain data."""
    with pytest.raises(ValueError, match="result a is a object"):
        write_result(tmp_path / "result.yaml", {"a": object()})
