"""A robot is a file."""

import pickle
import re

import mujoco
import numpy as np
import pytest
from robots import ROBOTS, write_robot

from op3.common.assets import robot_files
from op3.robot import RobotEntity, load_robot, load_servo
from op3.robot.servo_make import servo_files
from op3.scenes import build_scene


def compiled(robot, **parameters):
    root = RobotEntity(robot, **parameters).mjcf_model
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


@pytest.mark.parametrize("name", [*robot_files(), *ROBOTS])
def test_any_robot_becomes_hinges_without_servos(name, tmp_path):
    """Nothing drives it, and no friction, damping or armature is left for a servo model to double."""
    robot = load_robot(name if name in robot_files() else write_robot(tmp_path, name))
    model = compiled(robot)
    assert (model.nq, model.nu, model.nkey) == (len(robot.joints), 0, 0)
    assert not np.any([model.dof_damping, model.dof_frictionloss, model.dof_armature])
    assert (robot.limits[:, 0] <= robot.home).all()
    assert (robot.home <= robot.limits[:, 1]).all()


def test_limbs_hang_on_the_base(tmp_path):
    """They come from the model's tree."""
    robot = load_robot(write_robot(tmp_path, "dog"))
    assert robot.limbs[1] == ("rf_hip", "rf_knee")
    assert robot.whole_limbs(["lh_knee"]) == ("lh_hip", "lh_knee")
    assert load_robot(write_robot(tmp_path, "base")).limbs == (("left",), ("right",))


def test_mirror_partners_and_signs(tmp_path):
    """The sign comes from the axes: y for both sides keeps it, the OP3's knees turn it; a robot may have none."""
    dog, op3 = load_robot(write_robot(tmp_path, "dog")), load_robot("op3")
    assert dog.mirror["rf_hip"] == ("lf_hip", 1)
    assert (op3.mirror["l_knee"], op3.mirror["head_pan"]) == (("r_knee", -1), ("head_pan", -1))
    rows = np.random.default_rng(0).normal(size=(3, 20))
    np.testing.assert_array_equal(op3.mirrored(op3.mirrored(rows)), rows)
    np.testing.assert_allclose(op3.mirrored(op3.home), op3.home)
    np.testing.assert_allclose(np.sort(op3.mirrored(op3.limits.T), axis=0), op3.limits.T)
    with pytest.raises(ValueError, match="four has no mirrored joints"):
        _ = load_robot(write_robot(tmp_path, "four")).mirror


def test_limits_default_to_the_model(tmp_path):
    """A wheel without a range may be commanded half a turn either way."""
    np.testing.assert_allclose(load_robot(write_robot(tmp_path, "base")).limits, [[-np.pi, np.pi]] * 2)
    np.testing.assert_allclose(load_robot(write_robot(tmp_path, "four")).limits, [[-1.5, 1.5]] * 4)


def test_the_bench_has_a_mass_and_a_length():
    """The pendulum is a robot like any other, with two numbers that differ from bench to bench."""
    model = compiled(load_robot("bench"), mass=0.2, length=0.1)
    assert model.body("pendulum").mass == pytest.approx(0.2)
    np.testing.assert_allclose(model.body("pendulum").ipos, [0, 0, -0.1])
    with pytest.raises(ValueError, match="bench has no parameter 'lenght'; it has mass, length"):
        RobotEntity(load_robot("bench"), lenght=0.1)


def test_a_urdf_is_read(tmp_path):
    """What MuJoCo reads as a URDF is a robot too."""
    inertia = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="{n}"><inertial><mass value="0.1"/>{inertia}</inertial></link>' for n in "ab")
    hinge = (
        '<parent link="a"/><child link="b"/><axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="1" velocity="1"/>'
    )
    (tmp_path / "one.urdf").write_text(
        f'<robot name="one">{links}<joint name="hinge" type="revolute">{hinge}</joint></robot>'
    )
    path = tmp_path / "one.yaml"
    text = "format: op3-robot/1\nname: one\nmodel: one.urdf\nservo: sts3215\njoints: {hinge: }\nbase: "
    path.write_text(f"{text}a\n")
    robot = load_robot(path)
    assert build_scene("stand", robot=robot).compile().body("one/a").mass == pytest.approx(0.1)
    np.testing.assert_allclose(robot.limits, [[-1, 2]])
    assert compiled(robot).nq == 1
    path.write_text(f"{text}world\n")
    with pytest.raises(ValueError, match="base names the body 'world', which does not exist; there are a, b"):
        load_robot(path)


def test_a_model_brings_its_angles_and_leaves_its_world(tmp_path):
    """Degrees (MuJoCo's own default) are read as such; options of its own, and a floor under it, stay behind."""
    path = write_robot(tmp_path, "base")
    model = (tmp_path / "base.xml").read_text()
    tilted = model.replace('zaxis="0 1 0" mass="0.2"', 'euler="90 30 0" mass="0.2"')
    world = (
        '<option integrator="RK4" cone="elliptic"/><statistic extent="3"/><worldbody><geom type="plane" size="1 1 1"/>'
    )
    (tmp_path / "base.xml").write_text(tilted.replace("<worldbody>", world))
    robot = load_robot(path)
    model, own, inertia = build_scene("stand", robot=robot).compile(), robot.bare_model, []
    for one in (model, own):
        data, matrix = mujoco.MjData(one), np.zeros((2, 2))
        mujoco.mj_forward(one, data)
        mujoco.mj_fullM(one, data, matrix)
        inertia.append(matrix)
    np.testing.assert_allclose(*inertia, rtol=1e-6)
    assert (own.ngeom, model.opt.integrator) == (5, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert not any(model.geom(number).type == mujoco.mjtGeom.mjGEOM_PLANE for number in range(1, model.ngeom))


def test_a_base_on_the_stand_does_not_jam_its_first_joints(tmp_path):
    """Thighs that lie in the trunk's box pass through it, as they do while the trunk is free."""
    path = write_robot(tmp_path, "dog")
    wide = (tmp_path / "dog.xml").read_text().replace('contype="0" conaffinity="0"', "")
    (tmp_path / "dog.xml").write_text(wide.replace("0.12 0.05 0.03", "0.12 0.08 0.03"))
    model = build_scene("stand", robot=path).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_a_servo_of_ones_own_lies_beside_the_robot(tmp_path):
    """Its path is relative to the robot's file, and its file may say more than the makes that come with the project."""
    text = servo_files()["sts3215"].read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("name: sts3215", "name: mine").replace("value: 345", "value: 300"))
    robot = load_robot(write_robot(tmp_path, "four", {"servo: sts3215": "servo: mine.yaml"}))
    assert robot.servos[0].motor.gear_ratio.value == 300


def test_who_closes_the_loop_may_be_the_robots_choice(tmp_path):
    """A servo that regulates current in one robot runs its position law in another."""
    changes = {"servo: sts3215": "servo: sts3215\nloop: firmware", "{bus_id: 1}": "{bus_id: 1, servo: xm430-w210}"}
    assert {make.loop for make in load_robot(write_robot(tmp_path, "four", changes)).servos} == {"firmware"}
    assert load_servo("xm430-w210").loop == "current"


def test_servos_share_a_supply_if_they_stand_it(tmp_path):
    """XM430-W210 stand the 11.1 V of a W350; an XL330, which takes 6 V, has its 5 V from elsewhere."""
    changes = {"servo: xm430-w210": "servo: xm430-w350\nloop: firmware", "right:": "right: {servo: xl330-m288}"}
    mixed = load_robot(write_robot(tmp_path, "base", changes))
    np.testing.assert_allclose(mixed.supply_shares, [1, 5 / 11.1])
    assert mixed.supply is None
    (tmp_path / "base.yaml").write_text((tmp_path / "base.yaml").read_text().replace("xl330-m288", "xm430-w210"))
    assert load_robot(tmp_path / "base.yaml").supply == 11.1


def test_robots_travel_between_processes(tmp_path):
    """A pickle is the path."""
    robot = load_robot(write_robot(tmp_path, "dog"))
    assert pickle.loads(pickle.dumps(robot)).joints == robot.joints
    assert (robot.reference, load_robot("op3").reference) == (str(tmp_path / "dog.yaml"), "op3")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"  j1:": "  j11:"}, r"line 9: joints.j11 names the joint 'j11', which does not exist; the nearest is 'j1'"),
        ({"servo:": "law: papr\nservo:"}, r"line 6: law names the law 'papr'.* the nearest is 'paper'"),
        ({"sts3215": "sts321"}, r"line 6: servo names the servo 'sts321'.* the nearest is 'sts3215'"),
        ({"sts3215": "mine.yaml"}, r"line 6: servo names .*mine.yaml, which does not exist; correct the path"),
        (
            {"{bus_id: 1}": "{bus_id: 1, servo: xm430-w350}"},
            r"joints.j1 has a servo with the loop 'firmware' \(sts3215\), but j0 has 'current' \(xm430-w350\): set",
        ),
        ({"unit: count": "unit: conut"}, r"line 10: joints.j2.log.unit names the unit 'conut'.* nearest is 'count'"),
        (
            {"base: base": "base: bas"},
            r"line 4: base names the body 'bas', which does not exist; the nearest is 'base'",
        ),
        ({"{bus_id: 2,": "{bus_id: 1,"}, r"line 9: joints.j1.bus_id is 1, which j0 also has; use another id"),
        ({"zero: 2048": "zero: .nan"}, r"line 10: joints.j2.log.zero must be a finite number, got nan"),
        ({"sign: -1": "sign: 2"}, r"line 10: joints.j2.log.sign must be one of 1 or -1, got 2"),
        ({"home: 0.4": "home: 4"}, r"line 9: joints.j1.home is 4 rad, outside its limits -1.5 to 1.5"),
        ({"home: 0.4": "hmoe: 4"}, r"line 9: joints.j1.hmoe is not a field; the nearest is 'home'"),
        ({"four.xml": "for.xml"}, r"line 3: model names .*for.xml, which does not exist; correct the path"),
        ({"four.xml": "f" * 400}, r"line 3: model names .*ffff, which does not exist; correct the path"),
        (
            {"fixed: true": "fixed: true\nimu: eye"},
            r"line 6: imu names the site 'eye', which does not exist; there are none",
        ),
        (
            {"joints:": "joints:\n  j3: {bus_id: 9}", "\n  j3: {bus_id: 4}": ""},
            "write them in the order j0, j1, j2, j3",
        ),
        ({"joints:": "joints: ["}, r"is not valid YAML"),
        (
            {"{bus_id: 1}": "{bus_id: 200}", "servo:": "board: opencr\nservo:"},
            r"bus_id is 200, which the opencr also has",
        ),
        ({"{bus_id: 1}": "{home: 0}"}, r"line 8: joints.j0 has no bus_id although other joints have one"),
        (
            {"servo:": "poses: {up: {j5: 1}}\nservo:"},
            r"line 6: poses.up.j5 names the joint 'j5', which does not exist; there are j0",
        ),
        ({"servo:": "soles: [foot]\nservo:"}, r"line 6: soles.0 names the geom 'foot', which does not exist"),
        ({"{bus_id: 1}": "{bus_id: true}"}, r"line 8: joints.j0.bus_id must be a whole number, got True"),
        ({"{bus_id: 1}": "servo"}, r"line 8: joints.j0 must be a mapping of its fields, got 'servo'"),
        ({"format: op3-robot/1\n": ""}, r"line 1: format is missing; add format: op3-robot/1"),
        ({"joints:": "joint:"}, r"line 7: joint is not a field; the nearest is 'joints'"),
        ({"name: four": "name: my robot"}, r"line 2: name must be text of the form .*, got 'my robot'"),
        ({"home: 0.4": "home: '0.4'"}, r"line 9: joints.j1.home must be a number, got '0.4'"),
        ({"home: 0.4": "limits: [1, -1]"}, r"line 9: joints.j1.limits go from 1 to -1: give the lower one first"),
        (
            {"home: 0.4": "limits: [-90, 90]"},
            r"line 9: joints.j1.limits go from -90 to 90 rad, beyond the model's .*; write radians: -90 deg is -1.571",
        ),
        (
            {"home: 0.4": "mirror: j1"},
            r"line 9: joints.j1.mirror names the joint itself; omit `mirror`",
        ),
        (
            {"{bus_id: 1}": "{bus_id: 1, mirror: j1}", "home: 0.4": "mirror: j2"},
            r"line 9: joints.j1.mirror is j2, but j1 already has the partner j0",
        ),
        ({"servo:": "controlled: []\nservo:"}, r"line 6: controlled must be a list of length 1 or more"),
        ({"servo:": "poses: {up: {j0: 2}}\nservo:"}, r"line 6: poses.up.j0 is 2 rad, outside its limits -1.5 to 1.5"),
        ({"servo:": "poses: {zero: {j0: 1}}\nservo:"}, r"line 6: poses.zero is a pose that every robot has"),
        (
            {"servo:": "parameters: {load: {default: -1, unit: kg, body: link3, sets: mass}}\nservo:"},
            r"line 6: parameters.load makes a mass of -1 kg",
        ),
        ({"{bus_id: 1}": "{bus_id: 1, peak_current: 0}"}, r"line 8: joints.j0.peak_current must be above 0, got 0"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, change, sentence):
    """With file, line, and the nearest valid name."""
    with pytest.raises(ValueError, match=sentence) as refused:
        load_robot(write_robot(tmp_path, "four", change))
    assert "four.yaml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_joint_without_a_name_is_told(tmp_path):
    """It cannot be listed."""
    path = write_robot(tmp_path, "four")
    (tmp_path / "four.xml").write_text((tmp_path / "four.xml").read_text().replace('name="j1"', ""))
    with pytest.raises(ValueError, match="line 3: model has no name for its joint number 2: give it one"):
        load_robot(path)


def test_a_mass_that_differs_may_be_that_of_geoms(tmp_path):
    """A body whose geoms make its inertia keeps all of it but the mass."""
    load = "parameters: {load: {default: 0.3, unit: kg, body: link3, sets: mass}}\nservo:"
    robot = load_robot(write_robot(tmp_path, "four", {"servo:": load}))
    model, plain = compiled(robot).body("link3"), robot.bare_model.body("link3")
    assert (model.mass, plain.mass) == (pytest.approx(0.3), pytest.approx(0.1))
    np.testing.assert_allclose([model.ipos, model.inertia], [plain.ipos, plain.inertia])


def test_an_unknown_robot_is_answered_with_the_nearest(tmp_path):
    """A slip of the pen, a path that leads nowhere, or another file beside it."""
    (tmp_path / "my_arm.yaml").touch()
    with pytest.raises(ValueError, match=r"my_arms\.yaml; the nearest is '.*my_arm\.yaml'; correct the path"):
        load_robot(str(tmp_path / "my_arms.yaml"))
    with pytest.raises(ValueError, match="there is no robot 'op4'; the nearest is 'op3'; give a name or a path"):
        load_robot("op4")
    with pytest.raises(ValueError, match=r"there is no robot file nowhere/arn\.yaml; the nearest is 'arm'"):
        load_robot("nowhere/arn.yaml")
    with pytest.raises(
        ValueError, match=r"arm\.xml is a model; a robot file is .* with format: op3-robot/1, .* arm\.xml"
    ):
        load_robot("arm.xml")


def test_angles_in_degrees_are_noticed_where_the_model_has_no_range(tmp_path):
    """Nothing else would contradict them."""
    path = write_robot(tmp_path, "four", {"home: 0.4": "limits: [-90, 90]"})
    model = tmp_path / "four.xml"
    model.write_text(re.sub(r' range="[^"]*"', "", model.read_text()))
    with pytest.raises(ValueError, match=r"beyond a turn either way .* write radians: -90 deg is -1\.571"):
        load_robot(path)


def test_unknown_joints_are_answered_with_the_nearest():
    """Whole robots are too long to list."""
    assert load_robot("op3").indices(["r_ank_roll", "head_pan", "l_knee"]).tolist() == [19, 0, 11]
    with pytest.raises(ValueError, match="unknown joint 'left_knee' of op3; the nearest is 'l_knee'"):
        load_robot("op3").indices(["l_knee", "left_knee"])
