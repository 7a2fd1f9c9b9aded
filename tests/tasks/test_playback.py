"""Composer tasks, and their agreement with the batched simulation."""

import numpy as np
import pytest
import torch

from op3.robot import hold, pose, squat
from op3.servo import RobotModel, catalogue
from op3.servo.effects import (
    CentreOfMassOffset,
    Coulomb,
    CurrentPD,
    DirectionalEfficiency,
    Latency,
    Motor,
    Payload,
    Stribeck,
    Viscous,
)
from op3.tasks import Setup, play, squat_task
from tests.op3_table import JOINTS


def middle_of_table_1(form: str = "passive") -> RobotModel:
    """The paper's model with every parameter in the middle of its range in Table I."""
    model = RobotModel(
        (
            CurrentPD(),
            Latency(),
            Motor(),
            DirectionalEfficiency(form=form),
            Coulomb(),
            Stribeck(),
            Viscous(),
            Payload(),
            CentreOfMassOffset(),
        )
    )
    ranges = {
        name: (p.low + p.high) / 2
        for name, p in model.parameters().items()
        if name not in ("forward_efficiency", "command_latency", "stribeck_velocity")
    }
    return model.with_values(ranges)


@pytest.mark.parametrize(("mount", "form"), [("floor", "passive"), ("floor", "printed"), ("stand", "passive")])
def test_composer_and_batch_give_the_same_trajectory(mount, form):
    """Two seconds of squat through composer hooks and through the batch agree within 1e-9, contact included."""
    model, motion = middle_of_table_1(form), squat(duration=2.0)
    log = play(squat_task(model, motion, mount=mount, settle=0.0))
    setup = Setup.of_mount(mount)
    simulation = setup.simulation(model, [log], 3)
    qpos = setup.scene.initial_qpos(motion.position[0])
    simulation.reset(qpos, {"position_target": torch.from_numpy(motion.position[0]), "p_gain": 6.0, "d_gain": 0.1})
    position, current = [], []
    for target in motion.position:
        row = simulation.measure()
        position.append(row[("joint", "position")][1])
        current.append(row[("joint", "current")][1])
        simulation.command(position_target=torch.from_numpy(target))
        simulation.advance()
    assert not simulation.failed.any()
    np.testing.assert_allclose(torch.stack(position), log.array("joint/position"), atol=1e-9)
    np.testing.assert_allclose(torch.stack(current), log.array("joint/current"), atol=1e-9)


MORE = {
    "backlash_half_gap": 0.003,
    "gear_compliance": 0.004,
    "bristle_compliance": 0.005,
    "cogging_amplitude": 0.02,
    "cable_stiffness": 0.1,
    "position_friction": 0.03,
    "asymmetric_friction": 0.02,
    "quadratic_drag": 0.005,
    "friction_drift": 0.3,
    "friction_asymmetry": 0.2,
    "torque_constant_error": 0.05,
    "terminal_resistance_error": -0.1,
    "supply_resistance": 0.2,
    "current_time_constant": 0.002,
    "current_offset": 0.01,
    "drop_probability": 0.1,
    "velocity_time_constant": 0.004,
    "encoder_nonlinearity": 0.01,
    "imu_pitch": 0.02,
    "gyro_bias_y": 0.01,
    "link_mass_offset": 0.01,
    "link_com_offset_x": 0.002,
    "foot_friction_error": -0.2,
    "contact_time_added": 0.002,
    "ground_pitch": 0.01,
}
"""Sizes at which effects beyond the paper's show within a second."""


def test_composer_and_batch_agree_with_the_catalogue_switched_on():
    """The same with two dozen more effects on at once, and what the trunk's IMU reads."""
    model = middle_of_table_1()
    for effect in catalogue().values():
        if any(known.name in MORE for known in effect.parameters):
            model = model.with_effect(effect())
    model = model.with_values(MORE)
    assert len(model.effects) == 9 + len(MORE)
    motion = squat(duration=1.0)
    log = play(squat_task(model, motion, settle=0.0))
    setup = Setup.of_mount("floor")
    simulation = setup.simulation(model, [log], 2)
    qpos = setup.scene.initial_qpos(motion.position[0])
    simulation.reset(qpos, {"position_target": torch.from_numpy(motion.position[0]), "p_gain": 6.0, "d_gain": 0.1})
    rows = []
    for target in motion.position:
        rows.append(simulation.measure())
        simulation.command(position_target=torch.from_numpy(target))
        simulation.advance()
    assert not simulation.failed.any()
    for channel in rows[0]:  # contacts of loose gears let rounding grow
        ours = torch.stack([row[channel][1] for row in rows])
        np.testing.assert_allclose(ours, log.array("/".join(channel)), atol=1e-7, err_msg=str(channel))


def test_the_squat_squats():
    """On the floor the knees follow the motion within what Kp 6 allows, and the robot stays on its feet."""
    motion = squat()
    log = play(squat_task(middle_of_table_1(), motion))
    knee = JOINTS.index("l_knee")
    error = log.array("joint/position")[:, knee] - motion.position[:, knee]
    assert np.abs(error).max() < 0.2
    assert log.array("joint/position")[:, knee].max() > 1.4
    assert log.metadata.mount == "floor"
    assert log.metadata.rate == pytest.approx(125)


def test_stands_for_ten_seconds():
    """Knees bent, Kp 6, middle of Table I: once it has sunk into its gains the trunk drifts by millimetres."""
    stand = pose("stand")
    setup = Setup.of_mount("floor")
    log = play(squat_task(middle_of_table_1(), hold(stand, 0.1), settle=0.0))
    simulation = setup.simulation(middle_of_table_1(), [log], 1)
    simulation.reset(
        setup.scene.initial_qpos(stand), {"position_target": torch.from_numpy(stand), "p_gain": 6.0, "d_gain": 0.1}
    )
    trunk = simulation.batch.bind("qpos")[:, :3]
    places = []
    for _ in range(1250):
        simulation.advance()
        places.append(trunk[0].copy())
    drift = np.linalg.norm(np.array(places)[125:] - places[125], axis=1)
    assert drift.max() < 0.01
    assert places[-1][2] > 0.22
