"""Parts of the robot stop each other, in every simulator; distances are measured apart from contacts and sensors."""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from op3.deploy.emulator import Physics, SimPhysics, StandInPhysics
from op3.robot import load_robot, pose
from op3.scenes import build_scene
from op3.sim import load_model
from op3.stand_in import HiddenWorld
from tests.op3_table import JOINTS, OP3
from tests.self_collision import PartDistances

STALL_TORQUE, STALL_CURRENT = 4.1, 2.3
"""Of an XM430-W350 at 12 V [N m], [A]; ROBOTIS e-Manual."""

ARMATURE = 0.01
"""A little less than that of the servo at its output [kg m^2]."""

LEFT, RIGHT = JOINTS.index("l_hip_roll"), JOINTS.index("r_hip_roll")


@pytest.fixture(scope="module")
def distances() -> PartDistances:
    """Of the parts of the robot."""
    return PartDistances()


def in_the_air(distances: PartDistances, joint_position: np.ndarray) -> mujoco.MjData:
    """A pose far above the floor, with its contacts."""
    data = mujoco.MjData(distances.model)
    data.qpos[2], data.qpos[7:27] = 2.0, joint_position
    mujoco.mj_forward(distances.model, data)
    return data


def test_what_overlaps_has_a_contact(distances):
    """In 200 poses within the limits: a contact for each pair that is 0.1 mm inside each other, and for no other."""
    rng, low, high = np.random.default_rng(0), *OP3.limits.T
    touched = set()
    for position in rng.uniform(low, high, (200, len(JOINTS))):
        found = {
            tuple(sorted(contact.geom.tolist())): contact.dist for contact in in_the_air(distances, position).contact
        }
        distances.least(position, distances.pairs[:1])
        deep = {pair for pair in distances.pairs if distances.between(*pair) < -1e-4}
        assert deep <= set(found)
        assert set(found) <= set(distances.pairs)
        touched |= {frozenset(map(distances.name, pair)) for pair in deep}
    for left in ("hip", "thigh", "shin", "ankle", "sole_wide"):
        for right in ("hip", "thigh", "shin", "ankle", "sole_wide"):
            assert frozenset((f"l_{left}", f"r_{right}")) in touched


def test_the_box_of_the_head_would_touch_the_trunk(distances):
    """Tilted within its limits the head's box enters the trunk's by more than 5 mm, and no contact comes of it."""
    tilt = JOINTS.index("head_tilt")
    head, trunk = (distances.model.geom(f"op3/{name}").id for name in ("head", "trunk"))
    deepest = 0.0
    for angle in np.linspace(*OP3.limits[tilt], 50):
        position = pose("stand", "op3")
        position[tilt] = angle
        distances.least(position, distances.pairs[:1])
        deepest = min(deepest, distances.between(head, trunk))
        assert in_the_air(distances, position).ncon == 0
    assert deepest < -0.005


def test_friction_between_parts_is_their_own(distances):
    """0.3 between two parts, and between a sole and the floor that of the floor."""
    crossed = pose("stand", "op3")
    crossed[LEFT] = 0.3
    between_parts = in_the_air(distances, crossed).contact.friction[:, 0]
    assert len(between_parts) > 0
    assert (between_parts == 0.3).all()
    data = mujoco.MjData(distances.model)
    data.qpos[:] = build_scene("floor", "op3").initial_qpos(pose("stand", "op3"))
    data.qpos[2] -= 1e-4
    mujoco.mj_forward(distances.model, data)
    assert data.ncon > 0
    assert (data.contact.friction[:, 0] == 0.8).all()


def pressed(distances: PartDistances, collide: bool) -> np.ndarray:
    """Distance of the legs [m], step by step, while both hip rolls press inwards with stall torque in the air."""
    model = build_scene("floor", "op3").compile(visual=False)
    model.opt.gravity[:] = 0.0
    model.dof_armature[6:], model.dof_damping[6:] = ARMATURE, 0.1
    if not collide:
        model.geom_contype[model.geom_bodyid > 0] = 0
    data, held = mujoco.MjData(model), pose("stand", "op3")
    data.qpos[2], data.qpos[7:27] = 2.0, held
    gaps = []
    for _ in range(1000):
        torque = 200.0 * (held - data.qpos[7:27]) - 2.0 * data.qvel[6:]
        torque[LEFT], torque[RIGHT] = STALL_TORQUE, -STALL_TORQUE
        data.qfrc_applied[6:] = torque
        mujoco.mj_step(model, data)
        gaps.append(distances.least(data.qpos[7:27], distances.legs))
    return np.array(gaps)


def test_legs_pressed_with_stall_torque_stay_outside_each_other(distances):
    """They meet and stay within 0.1 mm of touching; without contacts they end more than 10 mm inside."""
    gaps = pressed(distances, collide=True)
    assert gaps[0] > 0.01
    assert np.abs(gaps[-500:]).max() < 1e-4
    assert pressed(distances, collide=False)[-500:].min() < -0.01


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: SimPhysics(load_model("paper"), build_scene("floor", "op3")), id="model"),
        pytest.param(lambda: StandInPhysics(HiddenWorld(), build_scene("floor", "op3")), id="stand-in"),
    ],
)
def test_legs_of_an_emulated_robot_stop_each_other(distances, make: Callable[[], Physics]):
    """On the floor, driven inwards at stall current for 0.5 s, they meet and enter each other by less than 1 mm."""
    physics, held, gaps = make(), load_robot("op3").home, []
    for _ in range(500):
        now = physics.read()
        current = np.clip(6.0 * (held - now.position) - 0.1 * now.velocity, -STALL_CURRENT, STALL_CURRENT)
        current[LEFT], current[RIGHT] = STALL_CURRENT, -STALL_CURRENT
        physics.drive(np.ones(len(JOINTS), dtype=bool), current)
        physics.advance(0.001)
        gaps.append(distances.least(physics.read().position, distances.legs))
    assert gaps[0] > 0.01
    assert min(gaps) > -1e-3
    assert max(gaps[-100:]) < 2e-3
