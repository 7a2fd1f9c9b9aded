"""The choice of motions, on information matrices made by hand, and one real motion."""

from itertools import pairwise

import numpy as np
import pytest

from op3.identify.design import PlannedRecording, check_choice, choose, information, widths
from op3.motions import chirp, hold, triangle
from op3.robot import pose
from op3.sim import load_model
from tests.op3_table import CONTROLLED_JOINTS

NAMES = ("friction", "gear", "mass")


def candidate(name: str, mount: str, duration: float, *diagonal: float) -> PlannedRecording:
    """A motion that tells each parameter alone."""
    return PlannedRecording(name, mount, duration, np.diag(diagonal))


FRICTION = candidate("slow", "floor", 10.0, 1e4, 0.0, 0.0)
GEAR = candidate("push", "floor", 10.0, 0.0, 1e4, 0.0)
MASS = candidate("swing", "stand", 10.0, 0.0, 0.0, 1e6)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_only_wanted_parameters_count(criterion):
    """The motion that tells most of all is not taken where its parameter is not wanted."""
    steps = choose([MASS, FRICTION, GEAR], NAMES, ["friction", "gear"], criterion=criterion, seconds=35.0, repeats=1)
    assert {step.name for step in steps} == {"slow", "push"}
    assert steps[-1].widths["mass"] == pytest.approx(2 * 1.6449 / np.sqrt(12.0))


def test_moving_the_robot_costs_time():
    """A change of mount is paid for: with little time the plan stays on one mount."""
    everything = dict(names=NAMES, wanted=["friction", "mass"], overhead=0.0, repeats=3)
    short = choose([FRICTION, MASS], seconds=40.0, mount_change=60.0, **everything)
    assert len({step.mount for step in short}) == 1
    long = choose([FRICTION, MASS], seconds=200.0, mount_change=60.0, **everything)
    assert len({step.mount for step in long}) == 2
    assert long[-1].seconds <= 200.0
    assert all(a.seconds < b.seconds for a, b in pairwise(long))


def test_a_trade_off_is_broken_by_the_motion_that_breaks_it():
    """Two parameters seen only as a sum: what tells them apart is worth more than more of the same."""
    together = np.zeros((3, 3))
    together[:2, :2] = 1e4
    same = PlannedRecording("same", "floor", 10.0, together)
    apart = candidate("apart", "floor", 10.0, 1e3, 0.0, 0.0)
    steps = choose([same, apart], NAMES, ["gear"], seconds=31.0, repeats=2)
    assert [step.name for step in steps][:2] in (["same", "apart"], ["apart", "same"])


def test_wrong_arguments_are_named():
    """An unknown parameter or criterion is said."""
    with pytest.raises(ValueError, match="unknown parameter 'colour'"):
        check_choice(NAMES, ["colour"], "D")
    with pytest.raises(ValueError, match="D or A"):
        check_choice(NAMES, ["gear"], "E")


def test_moving_tells_friction_and_standing_still_does_not():
    """On the stand a slow triangle tells viscous friction far better than a hold, and a quick chirp better still."""
    bounds = {"viscous_friction": (0.0, 0.5), "coulomb_friction": (0.0, 0.3)}
    model = load_model("paper")
    motions = [
        hold(pose("stand", "op3"), 0.8, robot="op3"),
        triangle({"l_knee": 0.1}, speed=0.5, cycles=1, robot="op3"),
        chirp({"l_knee": 0.2}, low=1.0, high=3.0, duration=1.0, robot="op3"),
    ]
    told = [information(model, motion, "stand", bounds, joints=CONTROLLED_JOINTS)[0, 0] for motion in motions]
    assert told[0] < 0.1 * told[1] < told[2]
    assert set(widths(np.diag([1e4, 1e4]), list(bounds)).values()) == {2 * 1.6449 / 100}
