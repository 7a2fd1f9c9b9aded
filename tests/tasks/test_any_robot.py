"""Robots that are not in the repository: from their file to logs, predictions and parameters."""

import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from op3.identify.design import information
from op3.identify.identification import Identification
from op3.identify.prediction_score import predict_logs
from op3.motions import check_motion, multisine
from op3.replay import ModelRobot
from op3.robot import load_robot
from op3.rollout import Rollout, read_log
from op3.scenes import build_scene
from op3.sim import servo_model
from op3.stand_in import HiddenWorld, StandIn

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robot"))
from robots import ROBOTS, write_robot


def recorded(path: Path) -> Rollout:
    motion = multisine(duration=1.5, robot=str(path))
    check_motion(motion, "stand")
    return ModelRobot(str(path)).play(motion, 6.0, 0.1, recording="one")


@pytest.mark.parametrize("name", ROBOTS)
def test_any_robot_is_recorded_and_predicted(name, tmp_path):
    """Its own model predicts its log to the sensors' noise: a count is 1.5 mrad, noise 1 and rounding 0.3 of it."""
    path = write_robot(tmp_path, name)
    log = Rollout.load(recorded(path).save(tmp_path / "log"))
    robot = load_robot(path)
    assert (log.robot.path, log.joints) == (path, robot.joints)
    score = predict_logs(servo_model(robot), [log])
    assert 1.0 < score.error_mrad.value < 2.0
    assert ("imu/orientation" in log) == (robot.file.imu is not None)


def test_friction_of_another_robot_is_found(tmp_path):
    """The loss is least where the friction is that of the robot."""
    path = write_robot(tmp_path, "base")
    model = servo_model(load_robot(path))
    true = model.value("coulomb_friction")
    problem = Identification(model, [recorded(path)], [], ["coulomb_friction"])
    values = np.array([0.3, 1.0, 3.0]) * true
    losses = [o.values for o in problem.evaluate([{"parameters.coulomb_friction": v} for v in values.tolist()])]
    assert np.argmin(losses) == 1


def test_a_motion_of_another_robot_is_judged(tmp_path):
    """What a motion tells about friction is a number for any robot, and more of it tells more."""
    path = write_robot(tmp_path, "dog")
    told = [
        information(
            servo_model(load_robot(path)),
            multisine(duration=seconds, robot=str(path)),
            "stand",
            {"coulomb_friction": (0.0, 0.3)},
        )[0, 0]
        for seconds in (1.0, 2.0)
    ]
    assert 0 < told[0] < told[1]


def test_a_foreign_table_is_read_in_the_robots_terms(tmp_path):
    """Names, order, signs, zeros and counts are those of the robot's file: (1024 - 2048) counts times -1 are pi / 2."""
    path = write_robot(tmp_path, "four", {"{bus_id: 2, home: 0.4}": "{bus_id: 2, home: 0.4, log: {name: lift}}"})
    header = "time," + ",".join(f"{joint}.{what}" for what in ("target", "position") for joint in ("j2", "lift"))
    (tmp_path / "run.csv").write_text(f"{header}\n0,2048,0.1,1024,0.2\n0.02,2048,0.1,1024,0.2\n")
    about = {"joints": ["j2", "lift"], "robot": "real", "mount": "stand", "rate": 50.0}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(about))
    log = read_log(tmp_path / "run.csv", robot=path)
    assert log.joints == ("j1", "j2")
    np.testing.assert_allclose(log.array("joint/position"), [[0.2, np.pi / 2]] * 2)
    np.testing.assert_allclose(log.array("command/position"), [[0.1, 0.0]] * 2)
    with pytest.raises(ValueError, match="unknown joint"):
        read_log(tmp_path / "run.csv", robot="arm")


def test_what_needs_feet_says_so(tmp_path):
    """In one sentence."""
    path = write_robot(tmp_path, "dog")
    sentence = "dog cannot stand: the scene 'floor' needs soles, .* add feet: .* for an arm, choose task=reach"
    with pytest.raises(ValueError, match=sentence):
        ModelRobot(str(path), mount="floor").play(multisine(duration=1.0, robot=str(path)), 6.0, 0.1)


@pytest.mark.parametrize(("played_by", "most"), [("model", 2.0), ("stand_in", 8.0)])
def test_servos_of_other_supplies_and_gains_are_played_and_predicted(played_by, most, tmp_path):
    """Each gets its own voltage, and is predicted with its own gain: a log without both columns says as much.

    Its own model errs by the sensors' noise (1.3 mrad), and one of unidentified servos beside the stand-in by 6 or 7.
    """
    path = write_robot(tmp_path, "four", {"{bus_id: 4}": "{bus_id: 4, servo: xl330-m288}"})
    motion = multisine(duration=1.5, robot=str(path))
    player = (
        StandIn(HiddenWorld(), build_scene("stand", robot=path)) if played_by == "stand_in" else ModelRobot(str(path))
    )
    log = player.play(motion, 6.0, 0.1)
    assert log.array("joint/voltage")[0, [0, 3]] == pytest.approx([7.4, 5.0], rel=0.08)
    model = servo_model(load_robot(path))
    arrays = {key: log.array(key) for key in log.channels}
    del arrays["joint", "voltage"], arrays["command", "firmware_gain"]
    bare = Rollout.from_arrays(arrays, log.metadata)
    assert max(predict_logs(model, [one]).error_mrad.value for one in (log, bare)) < most


def test_makes_may_differ_from_joint_to_joint(tmp_path):
    """Constants are values per joint, in terms of the first one's gear."""
    path = write_robot(tmp_path, "base", {"left: {mirror: right}": "left: {servo: xm430-w350, mirror: right}"})
    model = servo_model(load_robot(path))
    constant = model.estimate("torque_constant")
    # 212.6 * 0.007 / 353.5
    assert constant.joints["right"] == pytest.approx(0.00421, abs=1e-5)
    assert constant.value == pytest.approx(0.00702)
