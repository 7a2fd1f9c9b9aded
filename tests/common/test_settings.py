"""Settings are checked, and a fault is one sentence that names the field, what it must be and what was given."""

import dataclasses
from typing import Literal

import numpy as np
import pytest
from omegaconf import OmegaConf

from op3.common.settings import Count, Listed, Named, Number, Positive, Some, Text, Whole, read_yaml, settings


@settings("motor")
class Motor:
    voltage: Positive = 12.0
    steps: Whole = 3
    name: Text | None = None
    mode: Literal["current", "pwm"] = "current"
    units: Some[Count] = (1,)
    joints: Listed[str] = ()
    gains: Named[Positive] = dataclasses.field(default_factory=dict)
    offset: Number = 0.0
    on: bool = True

    def __post_init__(self):
        if self.offset > self.voltage:
            raise ValueError("motor: the offset lies above the voltage")


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"voltage": -1}, "motor: voltage must be above 0, got -1"),
        ({"voltage": True}, "motor: voltage must be a number, got True"),
        ({"voltage": "12"}, "motor: voltage must be a number, got '12'"),
        ({"offset": float("nan")}, "motor: offset must be a finite number, got nan"),
        ({"steps": 1.5}, "motor: steps must be a whole number, got 1.5"),
        ({"name": ""}, "motor: name must be text that is not empty, got ''"),
        ({"mode": "torque"}, "motor: mode must be one of 'current' or 'pwm', got 'torque'"),
        ({"units": []}, r"motor: units must be a list of length 1 or more, got \[\]"),
        ({"joints": "knee"}, "motor: joints must be a list, got 'knee'"),
        ({"gains": {"p": 0}}, "motor: gains.p must be above 0, got 0"),
        ({"on": 1}, "motor: on must be true or false, got 1"),
        ({"voltag": 1}, "motor: voltag is not a field; the nearest is 'voltage'"),
        ({"offset": 13}, "motor: the offset lies above the voltage"),
    ],
)
def test_a_fault_is_one_sentence(given, sentence):
    """Field, what it must be, what it was."""
    with pytest.raises(ValueError, match=f"^{sentence}$"):
        Motor(**given)


def test_what_configs_write_is_understood():
    """1e6 is a whole number, lists become tuples, Hydra's containers and numpy's scalars are plain."""
    motor = Motor(steps=1e6, joints=OmegaConf.create(["knee"]), voltage=np.float32(3), gains=OmegaConf.create({"p": 2}))
    assert (motor.steps, motor.joints, motor.voltage, motor.gains) == (1_000_000, ("knee",), 3.0, {"p": 2.0})
    assert isinstance(motor.steps, int)
    with pytest.raises(dataclasses.FrozenInstanceError):
        motor.steps = 2


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"a: [1\nb: 2", "line 2 is not valid YAML"),
        (b"steps: !!int three", "is not valid YAML"),
        (b"- 1", "is a list, not a mapping"),
        (b"1: 2", "the key 1 is not text"),
        (b"a: 1\nb: 2\na: 3", "field a: the key is on line 1 and again on line 3"),
        (b"", "is empty, not a mapping"),
        (b"\xff\xfe\xff", "is not UTF-8 text"),
    ],
)
def test_a_file_that_is_no_mapping_is_refused(tmp_path, content, sentence):
    """With the file's name and the line."""
    path = tmp_path / "some.yaml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"some.yaml.*{sentence}"):
        read_yaml(path)


def test_a_file_is_read_as_people_write_it(tmp_path):
    """1e-3 is a number, `no` a name and a date a text; a byte order mark does not matter."""
    path = tmp_path / "some.yaml"
    path.write_bytes("\ufeffa: 1e-3\nb: no\nc: 2026-01-15".encode())
    assert read_yaml(path) == {"a": 1e-3, "b": "no", "c": "2026-01-15"}
