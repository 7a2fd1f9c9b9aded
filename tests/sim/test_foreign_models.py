"""Models of other simulators: BAM's parameters come in and go out, and MuJoCo gets what it can express."""

from __future__ import annotations

import json
import re

import mujoco
import numpy as np
import pytest
import torch

from op3.robot import load_robot
from op3.sim import load_model, model_for
from op3.sim.foreign_models import expressed, to_bam, to_mjcf

M6 = {"kt": 0.3, "R": 2.4, "armature": 0.002, "q_offset": 0.02, "friction_base": 0.004, "friction_stribeck": 0.001}
M6 |= {"load_friction_motor": 0.28, "load_friction_external": 0.14, "load_friction_motor_stribeck": 0.01}
M6 |= {"load_friction_external_stribeck": 0.08, "load_friction_motor_quad": 0.005, "load_friction_external_quad": 0.009}
M6 |= {"dtheta_stribeck": 0.8, "alpha": 2.0, "friction_viscous": 0.008, "command_delay": 0.004}
NAMED = {"model": "m6", "actuator": "xl330-m288"}


def test_parameters_of_bam_come_in_and_go_out_as_they_were(tmp_path):
    """Of the highest rung; as a file that every command takes as a model."""
    path = tmp_path / "m6.json"
    path.write_text(json.dumps(M6 | NAMED))
    model = load_model(path)
    assert model.value("torque_constant") == 0.3
    assert model.value("external_square") == 0.009
    back = to_bam(model, "xl330-m288", "servo")
    assert {name: back[name] for name in NAMED} == NAMED
    assert {name: back[name] for name in M6} == pytest.approx(M6)
    assert expressed(model, "bam")[1] == ()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"R": None}, "'R' is None"),
        ({"actuator": "nobody"}, "is not a servo of assets/servos"),
        ({"kt": "x"}, "not a number"),
    ],
)
def test_parameters_of_bam_that_cannot_be_are_refused(tmp_path, changed, said):
    """In one sentence with the file."""
    path = tmp_path / "m6.json"
    path.write_text(json.dumps(M6 | NAMED | changed))
    with pytest.raises(ValueError, match=rf"m6\.json: .*{said}"):
        load_model(path)


def test_mujoco_s_position_actuator_is_the_servo_s_loop():
    """Its force at rest is the stall torque by duty, its damping that of back-EMF and viscous friction."""
    robot = load_robot("arm")
    servos = model_for(robot)
    model = mujoco.MjModel.from_xml_string(to_mjcf(servos, robot))
    make, law = robot.servos[0], robot.servos[0].position_law
    assert law is not None
    constant = make.output_constant
    stall = constant * make.supply.si / make.motor.terminal_resistance.si
    assert model.nu == len(robot.joints)
    assert model.actuator_gainprm[0, 0] == pytest.approx(stall * law.error_gain.si * law.gain.si, rel=1e-4)
    assert model.actuator_forcerange[0, 1] == pytest.approx(stall * law.max_duty.si, rel=1e-4)
    dof = model.joint("shoulder_pan").dofadr[0]
    back_emf = constant**2 / make.motor.terminal_resistance.si
    assert model.dof_damping[dof] == pytest.approx(back_emf + servos.value("viscous_friction"), rel=1e-4)
    data = mujoco.MjData(model)
    data.ctrl[:] = data.qpos + 0.2
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos - 0.2).max() < 0.1
    assert "dte" in expressed(servos, "mjcf")[1]


def pace_run(folder, joints, mean):
    """What PACE leaves: data at 400 Hz, and the mean of its last iterations."""
    time = torch.arange(8) * 0.0025
    torch.save({"bounds": torch.zeros(len(mean), 2), "joint_order": joints, "time": time}, folder / "config.pt")
    torch.save(torch.zeros(len(mean)), folder / "mean_090.pt")
    torch.save(torch.tensor(mean), folder / "mean_190.pt")
    return folder


def test_a_run_of_pace_is_a_model(tmp_path):
    """Its latest mean: four numbers of each joint and a delay in steps; what is measured is the angle less the bias."""
    robot = load_robot("arm")
    joints = [str(name) for name in robot.joints][::-1][:2]
    mean = [0.01, 0.02, 0.3, 0.4, 0.05, 0.06, 0.007, -0.008, 2.0]
    model = model_for(robot, pace_run(tmp_path, joints, mean))
    assert set(model.effect_names) == {"position_servo", "motor", "latency", "coulomb", "viscous", "encoder_offset"}
    assert model.value("command_latency") == pytest.approx(0.005)
    found = {name: values[0].tolist() for name, values in model.tensors(joints).items()}
    assert found["armature"] == pytest.approx(mean[:2])
    assert found["viscous_friction"] == pytest.approx(mean[2:4])
    assert found["coulomb_friction"] == pytest.approx(mean[4:6])
    assert found["encoder_offset"] == pytest.approx([-0.007, 0.008])
    assert model.value("torque_constant") == model_for(robot).value("torque_constant")


@pytest.mark.parametrize(
    ("joints", "mean", "said"),
    [
        (["nobody"], [0.1] * 5, "config.pt: arm has no joint 'nobody'"),
        (None, [0.1] * 5, "mean_190.pt: must contain 9 finite numbers, four for each of 2 joints"),
        (None, [0.1] * 8 + [np.nan], "mean_190.pt: must contain 9 finite numbers"),
        (None, None, "mean_<iteration>.pt: there is no such file"),
    ],
)
def test_a_run_of_pace_that_does_not_fit_is_refused(tmp_path, joints, mean, said):
    """In one sentence with the file."""
    robot = load_robot("arm")
    folder = pace_run(tmp_path, joints or list(robot.joints)[:2], mean or [0.1] * 9)
    for file in () if mean else folder.glob("mean_*"):
        file.unlink()
    with pytest.raises(ValueError, match=re.escape(said)):
        model_for(robot, folder)
