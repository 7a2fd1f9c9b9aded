"""What an effect does beside a joint's load and the sensors."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from op3.diagnose.judge_settings import Settings
from op3.diagnose.relevance import relevance


def does(torque: float, current: float, unread: bool = False, relative: float | None = None):
    """An effect of two joints in three windows; noise of 1 in every reading, a load of 50 units of 0.01 N m. A relative
    that was named before makes its torque in the same joint."""
    made = np.zeros((2, 2, 3, 6))
    made[0, 0, :, 0], made[0, 0, :, 2], made[1, 0, :, 0] = torque, current, relative or 0.0
    variance = np.ones((2, 3, 6))
    variance[0, 0, 0] = np.inf  # a window in which a joint sticks says nothing of its torque
    variance[..., 4:] = np.inf if unread else 1.0
    engine = SimpleNamespace(joints=("knee", "ankle"))
    reduction: Any = SimpleNamespace(
        kinds=np.arange(6), unit=0.01, loads=np.array([0.5, 0.5]), judged=np.array([0, 1]), engine=engine
    )
    base: Any = SimpleNamespace(linear=SimpleNamespace(base=made), point=np.array([1.0, 1.0]))
    rows: Any = SimpleNamespace(variance=variance)
    return relevance(reduction, base, 0, rows, Settings(), () if relative is None else (1,))


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


def test_what_repairs_the_form_of_a_named_effect_is_no_finding():
    """A fifth of 30 units is what the form of such a law may be off by: 4 units are within it, 7 are not."""
    assert not does(4.0, 0.0, relative=30.0).matters
    assert does(7.0, 0.0, relative=30.0).matters
