"""The model against the published numbers of the robot."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from op3.robot import asset_path, pose, standing_height
from tests.op3_table import JOINTS, SERVO_IDS, SOFT_LIMITS, center_of_mass

FACTS_PATH = Path(__file__).resolve().parents[2] / ".." / "shared" / "robot" / "op3_facts.yaml"


@pytest.fixture(scope="module")
def facts() -> dict:
    """The published numbers; they are not part of the repository."""
    if not FACTS_PATH.is_file():
        pytest.skip(f"the robot's published numbers are not at {FACTS_PATH}")
    return yaml.safe_load(FACTS_PATH.read_text())


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The robot's file, compiled alone."""
    return mujoco.MjModel.from_xml_path(str(asset_path("op3/op3.xml")))


def full_inertia(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Inertia about the centre of mass in link axes: xx, yy, zz, xy, xz, yz."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body(body).iquat)
    rotation = rotation.reshape(3, 3)
    tensor = rotation @ np.diag(model.body(body).inertia) @ rotation.T
    return tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def test_links_and_their_parents(facts, model):
    """The bodies are the links, in order, each on its published parent."""
    links = {link["name"]: link["parent"] for link in facts["links"]}
    assert [model.body(i).name for i in range(1, model.nbody)] == list(links)
    for name, parent in links.items():
        expected = "world" if parent == "world(free)" else parent
        assert model.body(model.body(name).parentid[0]).name == expected


def test_masses_and_positions(facts, model):
    """Every mass, centre of mass and link position is the published one."""
    for link in facts["links"]:
        body = model.body(link["name"])
        assert body.mass[0] == pytest.approx(link["mass"], abs=1e-6)
        np.testing.assert_allclose(body.ipos, link["com"], atol=1e-6, err_msg=link["name"])
        np.testing.assert_allclose(body.pos, link["pos_in_parent"], atol=1e-6, err_msg=link["name"])


def test_inertias(facts, model):
    """Every inertia tensor is the published one."""
    for link in facts["links"]:
        expected = link["inertia_ixx_iyy_izz_ixy_ixz_iyz"]
        np.testing.assert_allclose(full_inertia(model, link["name"]), expected, atol=1e-10, err_msg=link["name"])


def test_joints(facts, model):
    """Every joint has its published place (the link's origin), axis and mechanical range."""
    for joint in facts["joints"]:
        compiled = model.joint(joint["name"])
        body = model.body(compiled.bodyid[0])
        assert body.name == joint["child"]
        assert compiled.limited[0] == 1
        np.testing.assert_allclose(compiled.pos, 0.0, atol=1e-12, err_msg=joint["name"])
        np.testing.assert_allclose(body.pos, joint["pos_in_parent"], atol=1e-6, err_msg=joint["name"])
        np.testing.assert_allclose(compiled.axis, joint["axis"], atol=1e-6, err_msg=joint["name"])
        np.testing.assert_allclose(compiled.range, joint["urdf_limit_rad"], atol=1e-6, err_msg=joint["name"])


def test_tables(facts, model):
    """Joint order, servo ids and soft limits of the robot's file are the published ones."""
    published = facts["joints"]
    assert tuple(joint["name"] for joint in published) == JOINTS
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    for joint in published:
        assert SERVO_IDS[joint["name"]] == joint["servo_id"]
        assert SOFT_LIMITS[joint["name"]] == pytest.approx(joint["soft_limit_rad_op3_kinematics"], abs=1e-6)


def test_soles(facts, model):
    """Each foot has the two published sole boxes."""
    for sole in facts["soles"]:
        side = sole["link"][0]
        for kind, box in zip(("long", "wide"), sole["boxes"], strict=True):
            geom = model.geom(f"{side}_sole_{kind}")
            assert model.body(geom.bodyid[0]).name == sole["link"]
            np.testing.assert_allclose(geom.pos, box["center"], atol=1e-6)
            np.testing.assert_allclose(geom.size, box["half"], atol=1e-6)


def test_stand_pose(facts):
    """The pose "stand" is the published one with bent knees, arms included."""
    expected = [joint["playground_stand_bent_knees_rad"] for joint in facts["joints"]]
    np.testing.assert_allclose(pose("stand", "op3"), expected, atol=1e-6)


@pytest.mark.parametrize(("name", "published"), [("zero", "zero_pose"), ("stand", "stand_bent_knees")])
def test_heights(facts, name, published):
    """Trunk and centre of mass of a standing robot are where the published model has them."""
    expected = facts["standing"][published]
    height = standing_height(pose(name, "op3"), "op3")
    com = center_of_mass(pose(name, "op3"))
    assert height == pytest.approx(expected["trunk_origin_height"], abs=1e-3)
    assert height + com[2] == pytest.approx(expected["com_height"], abs=1e-3)
    assert com[0] == pytest.approx(expected["com_x_rel_trunk"], abs=1e-3)
    assert com[1] == pytest.approx(expected["com_y"], abs=1e-3)


def test_ini_pose_height(facts):
    """A third pose, ROBOTIS' deep squat, stands at its published height too."""
    position = np.radians([joint["robotis_ini_pose_deg"] for joint in facts["joints"]])
    expected = facts["standing"]["robotis_ini_pose"]
    height = standing_height(position, "op3")
    assert height == pytest.approx(expected["trunk_origin_height"], abs=1e-3)
    assert height + center_of_mass(position)[2] == pytest.approx(expected["com_height"], abs=1e-3)


def test_head_is_as_tall_as_the_robot(facts, model):
    """The drawn robot is as tall as the real one: 0.511 m to the top of the head."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    head = model.body("head_tilt_link").id
    upright = [
        i for i in range(model.ngeom) if model.geom_bodyid[i] == head and np.allclose(model.geom_quat[i], [1, 0, 0, 0])
    ]
    top = max(data.geom_xpos[i, 2] + model.geom_aabb[i, 2] + model.geom_aabb[i, 5] for i in upright)
    height = top - data.body("body_link").xpos[2] + standing_height(pose("zero", "op3"), "op3")
    assert height == pytest.approx(facts["standing"]["zero_pose"]["overall_height"], abs=1e-3)
