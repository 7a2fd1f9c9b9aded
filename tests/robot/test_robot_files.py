"""A robot is a file."""

import pickle

import mujoco
import numpy as np
import pytest
from robots import ROBOTS, write_robot

from op3.robot import RobotEntity, load_robot
from op3.robot.robot import robot_files


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
    with pytest.raises(ValueError, match="four has no left and right"):
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
    path.write_text("format: op3-robot/1\nname: one\nmodel: one.urdf\nservo: sts3215\njoints: {hinge: }\n")
    robot = load_robot(path)
    np.testing.assert_allclose(robot.limits, [[-1, 2]])
    assert compiled(robot).nq == 1


def test_robots_travel_between_processes(tmp_path):
    """A pickle is the path."""
    robot = load_robot(write_robot(tmp_path, "dog"))
    assert pickle.loads(pickle.dumps(robot)).joints == robot.joints
    assert (robot.reference, load_robot("op3").reference) == (str(tmp_path / "dog.yaml"), "op3")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"  j1:": "  j11:"}, r"line 9: joints.j11 names the joint 'j11', which there is not; the nearest is 'j1'"),
        ({"servo:": "law: papr\nservo:"}, r"line 6: law names the law 'papr'.* the nearest is 'paper'"),
        ({"sts3215": "sts321"}, r"line 6: servo names the servo 'sts321'.* the nearest is 'sts3215'"),
        ({"unit: count": "unit: conut"}, r"line 10: joints.j2.log.unit names the unit 'conut'.* nearest is 'count'"),
        ({"base: base": "base: bas"}, r"line 4: base names the body 'bas', which there is not; the nearest is 'base'"),
        ({"{bus_id: 2,": "{bus_id: 1,"}, r"line 9: joints.j1.bus_id is 1, as that of j0; give each its own"),
        ({"zero: 2048": "zero: .nan"}, r"line 10: joints.j2.log.zero must be a finite number, got nan"),
        ({"sign: -1": "sign: 2"}, r"line 10: joints.j2.log.sign must be one of 1 or -1, got 2"),
        ({"home: 0.4": "home: 4"}, r"line 9: joints.j1.home is 4 rad, outside its limits -1.5 to 1.5"),
        ({"home: 0.4": "hmoe: 4"}, r"line 9: joints.j1.hmoe is no field; the nearest is 'home'"),
        ({"four.xml": "for.xml"}, r"line 3: model names .*for.xml, where there is no file"),
        (
            {"fixed: true": "fixed: true\nimu: eye"},
            r"line 6: imu names the site 'eye', which there is not; there are ",
        ),
        (
            {"joints:": "joints:\n  j3: {bus_id: 9}", "\n  j3: {bus_id: 4}": ""},
            "write j0, j1, j2, j3",
        ),
        ({"joints:": "joints: ["}, r"is no valid YAML"),
        ({"{bus_id: 1}": "{bus_id: 200}", "servo:": "board: opencr\nservo:"}, r"bus_id is 200, as that of the opencr"),
        ({"{bus_id: 1}": "{home: 0}"}, r"line 8: joints.j0 has no bus_id, where other joints have one"),
        (
            {"servo:": "poses: {up: {j5: 1}}\nservo:"},
            r"line 6: poses.up.j5 names the joint 'j5', which there is not; there are j0",
        ),
        ({"servo:": "soles: [foot]\nservo:"}, r"line 6: soles.0 names the geom 'foot', which there is not"),
        ({"{bus_id: 1}": "{bus_id: 1, peak_current: 0}"}, r"line 8: joints.j0.peak_current must be above 0, got 0"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, change, sentence):
    """With file, line, and the nearest valid name."""
    with pytest.raises(ValueError, match=sentence) as refused:
        load_robot(write_robot(tmp_path, "four", change))
    assert "four.yaml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_unknown_robot_is_answered_with_the_nearest():
    """A slip of the pen, or a path that leads nowhere."""
    with pytest.raises(ValueError, match="there is no robot 'op4'; the nearest is 'op3', or give the path"):
        load_robot("op4")
    with pytest.raises(ValueError, match=r"there is no robot file nowhere/arn\.yaml; the nearest is 'arm'"):
        load_robot("nowhere/arn.yaml")


def test_unknown_joints_are_answered_with_the_nearest():
    """Whole robots are too long to list."""
    assert load_robot("op3").indices(["r_ank_roll", "head_pan", "l_knee"]).tolist() == [19, 0, 11]
    with pytest.raises(ValueError, match="unknown joint 'left_knee' of op3; the nearest is 'l_knee'"):
        load_robot("op3").indices(["l_knee", "left_knee"])
