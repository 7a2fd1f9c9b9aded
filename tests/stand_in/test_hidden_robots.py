"""The hidden robots that come with the project."""

import re
from pathlib import Path

import numpy as np
import pytest

from op3.servo import parameter
from op3.sim import load_model
from op3.stand_in.world import HiddenWorld, world_names
from op3.tasks.randomisation import TABLE_I

DOCS = Path(__file__).resolve().parents[2] / "docs" / "sim2real.md"


def distance(name: str) -> float:
    """From the model that identification starts with, root mean square of shares of the ranges of Table I."""
    world, model = HiddenWorld.find(name), load_model("paper")
    known = [parameter(each) for each in TABLE_I]
    shares = [(getattr(world, one.name) - model.value(one.name)) / (one.high - one.low) for one in known]
    return float(np.sqrt(np.mean(np.square(shares))))


def test_the_docs_tell_how_far_each_robot_is():
    """Every robot is in the table, at the distance that it has."""
    told = dict(re.findall(r"^\| `(robot_\d)` \| (\d\.\d\d) \|", DOCS.read_text(encoding="utf-8"), re.MULTILINE))
    assert set(told) == {name for name in world_names() if name.startswith("robot_")}
    for name, value in told.items():
        assert distance(name) == pytest.approx(float(value), abs=0.005), name


def test_the_gears_are_graded():
    """One in the middle of Table I's range, one at its bound, one beyond."""
    bound = parameter("backward_efficiency").low
    assert HiddenWorld.find("robot_1").backward_efficiency > bound
    assert HiddenWorld.find("robot_4").backward_efficiency == bound
    assert HiddenWorld.find("robot_7").backward_efficiency < bound
