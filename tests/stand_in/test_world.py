"""Worlds: files, random draws, identities."""

import dataclasses

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from op3.motions import squat
from op3.scenes import build_scene
from op3.stand_in import BENCH_RANGES, RANDOM_RANGES, HiddenWorld, StandIn, world_names
from op3.stand_in.world import FORMS, read_ranges

TABLE_1 = {
    "torque_constant": (0.003, 0.009),
    "terminal_resistance": (4.0, 9.0),
    "armature": (0.0025, 0.011),
    "backward_efficiency": (0.6, 1.0),
    "coulomb_friction": (0.01, 0.25),
    "viscous_friction": (0.0025, 0.15),
    "static_friction_excess": (0.0, 0.25),
    "base_mass_offset": (0.0, 0.5),
    "base_com_offset_x": (-0.02, 0.02),
    "base_com_offset_z": (-0.02, 0.02),
}


@given(st.integers(0, 2**32))
def test_random_worlds_lie_in_table_1(seed):
    """A random world can be identified: the paper's ranges contain it, and its gear loses 20 to 40 %."""
    world = HiddenWorld.random(seed)
    for name, (low, high) in TABLE_1.items():
        assert low <= getattr(world, name) <= high
    assert 0.6 <= world.backward_efficiency <= 0.8
    assert world.forward_efficiency == 1.0


def test_every_range_is_used():
    """A random world differs from another in every quantity that is drawn."""
    a, b = HiddenWorld.random(1), HiddenWorld.random(2)
    assert all(getattr(a, name) != getattr(b, name) for name in RANDOM_RANGES)
    assert HiddenWorld.random(1) == a


@given(st.integers(0, 1000))
def test_a_file_gives_back_the_world(tmp_path_factory, seed):
    """Saving and loading loses nothing."""
    path = tmp_path_factory.mktemp("world") / "world.yaml"
    world = HiddenWorld.random(seed)
    assert HiddenWorld.load(world.save(path)) == world


@pytest.mark.parametrize("name", world_names())
def test_worlds_that_come_with_the_project(name):
    """Each loads, and lies in the paper's ranges; the gear of one lies beyond them, and that alone."""
    world = HiddenWorld.find(name)
    beyond = [key for key, (low, high) in TABLE_1.items() if not low <= getattr(world, key) <= high]
    assert beyond == (["backward_efficiency"] if name == "robot_7" else [])


def test_graded_worlds():
    """Three worlds are graded by their backward efficiency, and differ in more than that."""
    worlds = [HiddenWorld.find(f"eta_0{grade}0") for grade in (6, 7, 8)]
    assert [world.backward_efficiency for world in worlds] == [0.6, 0.7, 0.8]
    assert len({world.torque_constant for world in worlds}) == 3


def test_identity():
    """Equal worlds have one identity, whatever the type of their numbers; the smallest change gives another."""
    assert HiddenWorld(bus_voltage=12).identity == HiddenWorld(bus_voltage=12.0).identity
    identities = {
        HiddenWorld()
        .replace(**{field.name: getattr(HiddenWorld(), field.name) + (1 if field.name == "spread_seed" else 1e-9)})
        .identity
        for field in dataclasses.fields(HiddenWorld)
        if "efficiency" not in field.name and field.name not in (*FORMS, "timestep", "hidden")
    }
    assert len(identities) == len(dataclasses.fields(HiddenWorld)) - 2 - len(FORMS) - 2
    assert HiddenWorld().identity not in identities


def test_spread():
    """Servos differ by no more than the spread, and are the same servos each time."""
    world = HiddenWorld(joint_spread=0.03)
    values = world.per_joint(20)
    for name, row in values.items():
        ratio = row / getattr(world, name)
        assert ratio.std() > 0.005
        assert abs(ratio - 1).max() <= 0.03
        assert (world.per_joint(20)[name] == row).all()
    assert (world.replace(spread_seed=1).per_joint(20)["torque_constant"] != values["torque_constant"]).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"torque_konstant": 0.005}, "torque_konstant.*the nearest is 'torque_constant'"),
        ({"wings": 2}, "wings is not a field; there are torque_constant"),
        ({"armature": 0.0}, "armature must be above 0, got 0.0"),
        ({"coulomb_friction": -0.1}, "coulomb_friction must be at least 0"),
        ({"backward_efficiency": 1.2}, "backward_efficiency must be at most 1"),
        ({"armature": "heavy"}, "armature must be a number, got 'heavy'"),
        ({"armature": float("nan")}, "armature must be a finite number"),
        ({"spread_seed": 1.5}, "spread_seed must be a whole number"),
        ({"loss_form": "magic"}, "loss_form must be one of 'power', 'near_rest', 'light_load', 'mesh' or 'concave'"),
        ([1, 2], "one `name: value` per line"),
        ({"draw": "many"}, "the seed of a random world must be an integer"),
        ({"hidden": [{"name": "backlsh", "size": 1}]}, "'backlsh' cannot be hidden"),
        ({"hidden": [{"name": "backlash"}]}, "size"),
        ({"hidden": [{"name": "backlash", "size": 1, "joint": "l_knee"}]}, "joint"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(tmp_path, content, message):
    """The message names the file, the entry and what is wrong."""
    path = tmp_path / "world.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as error:
        HiddenWorld.load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_world():
    """A name that nothing has is refused with the names there are."""
    with pytest.raises(ValueError, match="no world 'utopia'; choose random, default, eta_060"):
        HiddenWorld.find("utopia")
    with pytest.raises(ValueError, match="seed of a random world"):
        HiddenWorld.find("random", -1)


def test_a_file_may_start_from_a_random_world(tmp_path):
    """`draw: 7` is the random world of seed 7; further lines change it."""
    path = tmp_path / "robot.yaml"
    path.write_text("draw: 7\nbus_resistance: 0.9\n")
    assert HiddenWorld.load(path) == HiddenWorld.random(7).replace(bus_resistance=0.9)


def test_a_bench_robot_is_drawn_in_everything():
    """Two robots of the bench differ in every number, and over many every law is met."""
    one, other = HiddenWorld.random(1, BENCH_RANGES), HiddenWorld.random(2, BENCH_RANGES)
    fields = [field.name for field in dataclasses.fields(HiddenWorld)]
    alike = [name for name in fields if name not in FORMS and getattr(one, name) == getattr(other, name)]
    assert set(alike) <= {"forward_efficiency", "timestep", "hidden"}
    drawn = [HiddenWorld.random(seed, BENCH_RANGES) for seed in range(40)]
    for name, laws in FORMS.items():
        assert {getattr(world, name) for world in drawn} == set(laws)


def test_ranges_can_be_replaced(tmp_path):
    """A file's ranges take the place of the project's, the others stay; a wrong one is refused by name."""
    path = tmp_path / "ranges.yaml"
    path.write_text("velocity_lag: [0.03, 0.04]\nfade_form: [lorentz]\n")
    ranges = read_ranges(path)
    world = HiddenWorld.random(5, ranges)
    assert 0.03 <= world.velocity_lag <= 0.04
    assert world.fade_form == "lorentz"
    assert ranges["armature"] == BENCH_RANGES["armature"]
    path.write_text("velocity_lags: [0.03, 0.04]\n")
    with pytest.raises(ValueError, match="a world has no 'velocity_lags'; the nearest is 'velocity_lag'"):
        read_ranges(path)
    path.write_text("velocity_lag: 0.03\n")
    with pytest.raises(ValueError, match=r"the range of velocity_lag is 0\.03: write \[low, high\]"):
        read_ranges(path)


def test_a_file_may_hide_effects_of_the_bench(tmp_path):
    """A robot with one is told apart, comes back as it was, and plays otherwise than without."""
    path = tmp_path / "world.yaml"
    path.write_text("draw: 7\nhidden: [{name: backlash, size: 0.01, joints: [l_knee, r_knee]}]\n")
    world = HiddenWorld.load(path)
    assert world.hidden[0].form == "dead_zone"
    assert HiddenWorld.load(world.save(tmp_path / "again.yaml")) == world
    assert world.identity != HiddenWorld.random(7).identity
    logs = [
        StandIn(one, build_scene("stand", "op3")).play(squat(frequency=2.0, knee_high=1.2, duration=0.5), 6.0, 0.1)
        for one in (world, HiddenWorld.random(7))
    ]
    knee = logs[0].joints.index("l_knee")
    assert np.abs(logs[0].array("joint/position") - logs[1].array("joint/position"))[:, knee].max() > 0.005
