"""Joints without a servo, and what of a model acts beside servos: passive, coupled and held joints, effort limits."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from op3.motions import multisine
from op3.motions.motion_checks import motion_faults
from op3.replay import simulate_motion
from op3.report.robot_table import robot_table
from op3.robot import load_robot
from op3.robot.data_file import DataFileError
from op3.robot.robot import Robot
from op3.scenes.scene import build_scene
from op3.sim import model_for
from op3.stand_in.bodies import _Freedoms, limb_model

LINK = '<inertial pos="0 0 0.05" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>'
HEAD = "format: op3-robot/1\nname: hand\nmodel: hand.xml\nbase: base\nfixed: true\nservo: xm430-w350\njoints:\n"


def hand(folder: Path, joints: str, equality: str = "", more: str = "", limits: str = "") -> Robot:
    """An arm of two hinges that carries a finger, which may be of any kind."""
    folder.mkdir(exist_ok=True)
    (folder / "hand.xml").write_text(
        f"""<mujoco model="hand"><compiler angle="radian"/><worldbody><body name="base" gravcomp="1">
        {LINK.format(mass=1)}<body name="upper" pos="0 0 0.05">{LINK.format(mass=0.1)}
        <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" damping="3" stiffness="2" {limits}/>
        <body name="lower" pos="0 0 0.1">{LINK.format(mass=0.1)}<joint name="elbow" axis="0 1 0" range="-1.5 1.5"
        {limits}/><body name="tip" pos="0 0 0.1">{LINK.format(mass=0.05)}{more}</body></body></body></body></worldbody>
        <equality>{equality}</equality></mujoco>"""
    )
    (folder / "hand.yaml").write_text(HEAD + "  shoulder: {bus_id: 1}\n  elbow: {bus_id: 2}\n" + joints)
    return load_robot(folder / "hand.yaml")


HINGE = '<joint name="finger" axis="0 1 0" range="-1 1" stiffness="0.2" damping="0.01"/>'
SLIDE = '<joint name="finger" type="slide" axis="0 0 1" range="-0.05 0.05"/>'
MIMICKED = '<joint joint1="elbow" joint2="finger" polycoef="0.2 -2 0 0 0"/>'
MIMIC = '<joint joint1="finger" joint2="elbow" polycoef="0.1 -0.5 0 0 0"/>'


def test_a_servo_moves_a_slide_by_its_travel(tmp_path):
    """As a hinge of the slide's name, which the slide follows, and what follows the slide too; so in simulation."""
    other = '</body><body name="other">' + LINK.format(mass=0.02)
    other += '<joint name="finger_2" type="slide" axis="0 0 1" range="-0.03 0"/>'
    mimic = '<joint joint1="finger_2" joint2="finger" polycoef="0 -1 0 0 0"/>'
    slide = '<joint name="finger" type="slide" axis="0 0 1" range="0 0.03"/>'
    robot = hand(tmp_path, "  finger: {bus_id: 3, travel: 0.015}\n", mimic, slide + other)
    assert robot.joints == ("shoulder", "elbow", "finger")
    assert robot.limits[2] == pytest.approx([0, 2])
    assert robot.followed["finger_slide"] == ("finger", 0.015, 0.0)
    assert robot.followed["finger_2"] == ("finger", -0.015, 0.0)
    assert robot.gravity([0, 0, 1])[2] == pytest.approx((0.05 - 0.02) * 9.81 * 0.015)
    scene = build_scene("stand", robot=robot)
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(np.array([0, 0, 1.0]))
    places = {model.joint(n).name.rpartition("/")[2]: model.jnt_qposadr[n] for n in range(model.njnt)}
    assert data.qpos[[places["finger_slide"], places["finger_2"]]] == pytest.approx([0.015, -0.015])
    mujoco.mj_step(model, data, 40)
    fallen = data.qpos[places["finger"]]
    assert 0.1 < fallen < 0.99
    assert data.qpos[places["finger_slide"]] == pytest.approx(0.015 * fallen, abs=2e-4)


@pytest.mark.parametrize(
    ("joints", "equality", "finger", "followed"),
    [
        ("  finger: {passive: true}\n", "", HINGE, {}),
        (
            "  finger: {coupled: {joint: elbow, ratio: -0.5, offset: 0.1}}\n",
            "",
            HINGE,
            {"finger": ("elbow", -0.5, 0.1)},
        ),
        ("  finger: {coupled: {joint: elbow, ratio: 0.02}}\n", "", SLIDE, {"finger": ("elbow", 0.02, 0.0)}),
        ("  finger: {held: 0.02}\n", "", SLIDE, {"finger": (None, 0.0, 0.02)}),
        ("", MIMIC, HINGE, {"finger": ("elbow", -0.5, 0.1)}),
        ("", MIMICKED, HINGE, {"finger": ("elbow", -0.5, 0.1)}),
        ("", MIMIC.replace("finger", "1 x"), HINGE.replace("finger", "1 x"), {"joint_1_x": ("elbow", -0.5, 0.1)}),
    ],
    ids=["passive", "coupled", "slide", "held", "mimic", "mimicked", "renamed"],
)
def test_a_joint_without_a_servo_moves_as_its_kind(tmp_path, joints, equality, finger, followed):
    """In the model: no servo, no entry in logs; what follows another joint stays with it, under a name of letters."""
    robot = hand(tmp_path, joints, equality, finger)
    assert robot.joints == ("shoulder", "elbow")
    assert robot.followed == followed
    motion = multisine(duration=2.0, robot=robot.reference)
    assert not motion_faults(motion)
    log = simulate_motion(model_for(robot), motion, mount="stand")
    assert log.joints == robot.joints
    assert np.ptp(log.array("joint/position"), axis=0).min() > 0.2
    for name, (driver, ratio, offset) in followed.items():
        whole = robot.configuration([0.3, 0.4])
        assert whole[robot.bare_model.joint(name).id] == pytest.approx(offset + (ratio * 0.4 if driver else 0.0))


@pytest.mark.parametrize("kind", ["coupled: {joint: elbow, ratio: -0.5, offset: 0.1}", "held: 0.3"])
def test_a_stand_in_moves_what_follows_as_one_body(tmp_path, kind):
    """Its inertia on the free joints is that which MuJoCo gives with the joints moved together."""
    robot = hand(tmp_path, f"  finger: {{{kind}}}\n", "", HINGE)
    model = build_scene("stand", robot=robot).compile()
    names = [model.joint(number).name for number in range(model.njnt)]
    freedoms = _Freedoms(model, names, 0)
    assert [name.rpartition("/")[2] for name in freedoms.names] == ["shoulder", "elbow"]
    limbs, _ = limb_model(model)
    pose = np.array([0.3, 0.4])
    inverse, _ = freedoms.dynamics(limbs, limbs.createData(), pose, np.zeros(2))
    data, columns = mujoco.MjData(model), []
    data.qpos[:] = freedoms.all(pose)
    mujoco.mj_forward(model, data)
    for column in freedoms.spread.T:
        mujoco.mj_mulM(model, data, inertia := np.zeros(model.nv), column)
        columns.append(inertia)
    assert np.linalg.inv(inverse) == pytest.approx(freedoms.spread.T @ np.stack(columns, axis=1), rel=1e-6)


def test_what_drives_a_joint_in_the_model_does_not_beside_a_servo(tmp_path, caplog):
    """Effort limits are placeholders, springs and compensated gravity are told: the joint moves as without them."""
    plain = hand(tmp_path / "plain", "  finger: {held: 0.0}\n", "", HINGE)
    limited = hand(tmp_path / "limited", "  finger: {held: 0.0}\n", "", HINGE, limits='actuatorfrcrange="-0.01 0.01"')
    swings = []
    for robot in (plain, limited):
        log = simulate_motion(model_for(robot), multisine(duration=2.0, robot=robot.reference), mount="stand")
        swings.append(np.ptp(log.array("joint/position"), axis=0))
    assert swings[0] == pytest.approx(swings[1], rel=1e-9)
    assert "springs of shoulder: ignored" in caplog.text
    assert "compensation of gravity of base: ignored" in caplog.text
    assert "effort limits of shoulder, elbow: replaced by the servo model" in robot_table(limited)


def test_a_servo_on_a_joint_that_mimics_another_is_told(tmp_path, caplog):
    """It may have one; the model's equality is then not used."""
    robot = hand(tmp_path, "  finger: {bus_id: 3}\n", MIMIC, HINGE)
    assert robot.joints == ("shoulder", "elbow", "finger")
    assert "coupling of finger to elbow: ignored: the joint has its own servo" in caplog.text


@pytest.mark.parametrize(
    ("joints", "finger", "said"),
    [
        ("", HINGE, r"omit the model's joint 'finger': list it with its servo, or as `finger: {passive: true}`"),
        ("  finger: {bus_id: 3}\n", SLIDE, r"is not a hinge in the model: .*`held: 0.0` if it stays"),
        ("  finger: {passive: true, held: 0.1}\n", HINGE, r"line \d+: joints.finger must have one of passive"),
        ("  finger: {held: 5}\n", HINGE, r"joints.finger.held is 5, beyond the model's"),
        (
            "  finger: {coupled: {joint: elbo}}\n",
            HINGE,
            "joints.finger.coupled names the joint with a servo 'elbo', which",
        ),
        ("  fingr: {passive: true}\n", HINGE, "names the joint 'fingr', which does not exist"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, joints, finger, said):
    """In one sentence with the remedy."""
    with pytest.raises(DataFileError, match=said):
        hand(tmp_path, joints, "", finger)


def test_meshes_of_a_package_are_looked_for_around_the_model(tmp_path):
    """And where they are missing, it says what to put where."""
    robot = tmp_path / "arm_description" / "urdf"
    (robot.parent / "meshes").mkdir(parents=True)
    robot.mkdir()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.05
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    mesh = robot.parent / "meshes" / "base.obj"
    mesh.write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
        + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)
    )
    link = (
        '<inertial><origin xyz="0 0 .05"/><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0"'
    )
    link += ' iyz="0"/></inertial>'
    shape = '<collision><geometry><mesh filename="package://arm_description/meshes/base.obj"/></geometry></collision>'
    (robot / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base">{link}{shape}</link><link name="a">{link}</link><joint name="shoulder" '
        'type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" '
        'effort="10" velocity="5"/></joint></robot>'
    )
    file = HEAD.replace("hand.xml", "arm.urdf") + "  shoulder: {bus_id: 1}\n"
    (robot / "arm.yaml").write_text(file)
    assert build_scene("stand", robot=load_robot(robot / "arm.yaml")).compile().nmesh == 1
    mesh.unlink()
    (robot / "arm.yaml").write_text(file + "source: changed\n")
    with pytest.raises(DataFileError, match=r"mesh package://arm_description/.* was not found: put the folder"):
        load_robot(robot / "arm.yaml")
