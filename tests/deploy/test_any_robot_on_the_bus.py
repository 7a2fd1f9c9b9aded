"""Robots that are not in the repository, from their file alone through the emulated bus."""

import sys
from pathlib import Path

import numpy as np
import pytest

from op3.deploy import Player
from op3.deploy.connection import connect
from op3.deploy.dynamixel_bus import Bus
from op3.deploy.emulator import EmulatedRobot, SimPhysics, VirtualPort
from op3.motions import multisine
from op3.robot import load_robot
from op3.scenes import build_scene
from op3.sim import servo_model

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robot"))
from robots import write_robot

CHANGES = {
    "four": {"servo: sts3215": "servo: xm430-w350", "{bus_id: 4}": "{bus_id: 40, peak_current: 1.0}"},
    "base": {},
    "dog": {"imu: imu": "imu: imu\nboard: opencr"},
}


@pytest.mark.parametrize("source", [{"model": "own"}, {"world": "default"}], ids=["model", "stand_in"])
@pytest.mark.parametrize("name", CHANGES)
def test_any_robot_is_recorded_through_the_bus(name, source, tmp_path):
    """Start checks, torque, motion, torque off; its IMU is in the log where its board is on the bus."""
    path = write_robot(tmp_path, name, CHANGES[name])
    robot, motion = load_robot(path), multisine(duration=1.5, robot=str(path))
    lines: list[str] = []
    player = Player("emulated", "stand", robot=path, folder=tmp_path / "ticks", report=lines.append, **source)
    log = player.play(motion, 4.0, 0.1).check()
    assert (log.robot.path, log.joints) == (path, robot.joints)
    assert ("imu/orientation" in log) == (robot.file.board is not None)
    count = len(robot.joints)
    assert f"torque off verified {count}/{count}" in lines
    assert np.abs(log.array("joint/position") - log.array("command/position")).max() < 0.3


def test_ids_and_limits_are_those_of_the_file(tmp_path):
    """Servos answer under the ids of the file, and no more current than it says is commanded."""
    known = load_robot(write_robot(tmp_path, "four", CHANGES["four"]))
    robot = EmulatedRobot(SimPhysics(servo_model(known), build_scene("stand", robot=known)))
    bus = Bus(VirtualPort(robot), robot.clock, known)
    assert bus.ping_all() == dict.fromkeys(known.joints, 1020)
    assert [servo.id for servo in robot.servos.values()] == [1, 2, 3, 40]
    assert np.floor(bus.units.peak).tolist() == [855, 855, 855, 371]


def test_a_robot_of_other_servos_is_refused(tmp_path):
    """In one sentence that says what to do with it."""
    path = write_robot(tmp_path, "four")
    with pytest.raises(ValueError, match=r"four: the bus supports only Dynamixel X .* but j0 has a sts3215 \(.*\)"):
        Player("emulated", "stand", robot=path, folder=tmp_path, model="own").play(multisine(robot=str(path)))


def test_a_robot_without_soles_is_not_put_on_the_floor(tmp_path):
    """It is refused before its servos are energised."""
    path = write_robot(tmp_path, "four", CHANGES["four"])
    with pytest.raises(ValueError, match="four cannot stand: the scene 'floor' needs soles"):
        connect("emulated", robot=path, model="own")
