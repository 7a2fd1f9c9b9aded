"""What an effect does beside a joint's load and the sensors."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from op3.diagnose.coordinates import Coordinate, base_coordinates, with_chain
from op3.diagnose.judge_settings import Settings
from op3.diagnose.relevance import gear_coordinates, relevance
from op3.servo.effects import Coulomb, LoadFriction
from op3.sim import load_model

NAMED = Coordinate("load_friction", None, 0.0, 1.0, 0.0, 0.0, 1.0, "add")
OF_BASE = Coordinate("backward_efficiency", None, 0.5, 1.0, 1.0, 1.0, 0.3, "value")


def does(torque: float, current: float, unread: bool = False, relative: float | None = None, kind: Coordinate = NAMED):
    """An effect of two joints in three windows; noise of 1 in every reading, a load of 50 units of 0.01 N m. A relative
    that was named before, or that the base has, makes its torque in the same joint."""
    made = np.zeros((2, 2, 3, 6))
    made[0, 0, :, 0], made[0, 0, :, 2], made[1, 0, :, 0] = torque, current, relative or 0.0
    variance = np.ones((2, 3, 6))
    variance[0, 0, 0] = np.inf  # a window in which a joint sticks says nothing of its torque
    variance[..., 4:] = np.inf if unread else 1.0
    engine = SimpleNamespace(joints=("knee", "ankle"))
    reduction: Any = SimpleNamespace(
        kinds=np.arange(6),
        torque_unit=0.01,
        loads=np.array([0.5, 0.5]),
        joint_indices=np.array([0, 1]),
        engine=engine,
        settings=Settings(),
    )
    point = np.array([1.0, 1.0 if kind.kind == "add" else 0.0])
    linear, coordinates = SimpleNamespace(jacobian=made), SimpleNamespace(entries=(NAMED, kind))
    base: Any = SimpleNamespace(linear=linear, point=point, coordinates=coordinates)
    rows: Any = SimpleNamespace(variance=variance)
    return relevance(reduction, base, 0, rows, () if relative is None else (1,))


def test_a_torque_matters_beside_the_load_and_the_sensors():
    """Turned rows of 4 units are a mean of 2, 0.02 N m of 0.5; a hundredth of that is too little for both."""
    large = does(4.0, 0.0, unread=True)
    assert large.torque == {"knee": pytest.approx(0.02)}
    assert (large.load, large.floor) == (pytest.approx(0.04), pytest.approx(4.0))
    assert large.matters
    assert not does(0.04, 0.0).matters


def test_what_only_sensors_show_matters_by_their_noise():
    """A current that is read wrong makes no torque."""
    assert does(0.0, 1.0).matters
    assert not does(0.0, 0.1).matters


@pytest.mark.parametrize("kind", [NAMED, OF_BASE])
def test_what_repairs_the_form_of_another_effect_is_no_finding(kind):
    """A fifth of 30 units is what the form of such a law may be off by: 4 units are within it, 7 are not. The losses of
    the base's gear count from an efficiency of 1 on."""
    assert not does(4.0, 0.0, relative=30.0, kind=kind).matters
    assert does(7.0, 0.0, relative=30.0, kind=kind).matters


def test_only_another_law_of_the_gear_repairs_that_of_the_base():
    """Load friction may look like directional efficiency; Coulomb friction is a law of its own."""
    model = with_chain(load_model("paper"))
    base: Any = SimpleNamespace(coordinates=base_coordinates(model, ("knee", "ankle")))
    assert "backward_efficiency" in {entry.parameter for entry in gear_coordinates(LoadFriction, base)}
    assert gear_coordinates(Coulomb, base) == []
