"""What stands behind the bus: the simulated robot and the stand-in, with motors that are off, regulated or driven."""

import numpy as np
import pytest
import torch

from op3.deploy.emulator import SimPhysics, StandInPhysics
from op3.robot import pose
from op3.scenes import build_scene
from op3.sim import BatchSimulation, attach_servos, load_model
from op3.stand_in import HiddenWorld
from tests.op3_table import JOINTS

KNEE = JOINTS.index("l_knee")


def drive(physics, current=0.0, enabled=True):
    physics.drive(np.full(20, enabled), np.broadcast_to(np.asarray(current, dtype=float), 20).copy())


def hanging(kind):
    return (
        SimPhysics(load_model("paper"), build_scene("stand", "op3"))
        if kind == "sim"
        else StandInPhysics(HiddenWorld(), build_scene("stand", "op3"))
    )


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_without_torque_the_goal_means_nothing(kind):
    """Joints that are off run free: whatever goal stands in the register, they move alike and carry no current."""
    first, second = hanging(kind), hanging(kind)
    drive(first, current=1.0, enabled=False)
    drive(second, enabled=False)
    for physics in (first, second):
        physics.advance(0.5)
        assert np.abs(physics.read().current).max() < 0.02
    assert np.abs(first.position - second.position).max() < 0.005


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_a_goal_current_flows(kind):
    """A driver that regulates current reads the current that was asked for."""
    physics = hanging(kind)
    drive(physics, current=0.2)
    physics.advance(0.02)
    assert physics.read().current == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_a_fall_shows_in_the_imu(kind):
    """Without torque the robot on the floor collapses: its accelerometer and attitude say so."""
    physics = (
        SimPhysics(load_model("paper"), build_scene("floor", "op3"))
        if kind == "sim"
        else StandInPhysics(HiddenWorld(), build_scene("floor", "op3"))
    )
    drive(physics, enabled=False)
    physics.advance(2.5)
    readings = physics.read()
    assert np.linalg.norm(readings.linear_acceleration) == pytest.approx(9.8, rel=0.2)
    assert np.abs(physics.position - pose("stand", "op3")).max() > 0.3


def test_the_simulation_behind_the_bus_is_the_simulation():
    """With goal currents of a constant PD command it moves as `BatchSimulation` moves without latency."""
    model = load_model("paper").without("latency")
    scene = build_scene("floor", "op3")
    attach_servos(scene.joints)
    direct = BatchSimulation(
        scene.compile(),
        scene.joint_names,
        model,
        1,
        control_period=0.001,
        base_body="op3/body_link",
        joint_names=JOINTS,
    )
    stand = pose("stand", "op3")
    commands = {"position_target": torch.from_numpy(stand), "p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}
    direct.reset(scene.initial_qpos(stand), commands)
    physics = SimPhysics(model, build_scene("floor", "op3"))
    for _ in range(200):
        current = 6.0 * (stand - physics.position) - 0.1 * physics.read().velocity
        drive(physics, np.clip(current, -2.3, 2.3))
        physics.advance(0.001)
        direct.advance()
    measured = direct.measure()["joint", "position"][0].numpy()
    assert np.abs(physics.position - measured).max() < 1e-9


@pytest.mark.parametrize("scene", ["floor", "stand", "bench"])
def test_any_scene_will_do(scene):
    """Both physics take every scene; on the bench there is one servo and no IMU."""
    for physics in (
        SimPhysics(
            load_model("paper").without("payload", "com_offset"),
            build_scene(scene, "bench" if scene == "bench" else "op3"),
        ),
        StandInPhysics(HiddenWorld(), build_scene(scene, "bench" if scene == "bench" else "op3")),
    ):
        physics.advance(0.005)
        assert (physics.read().orientation is None) == (scene == "bench")
        assert len(physics.known.joints) == (1 if scene == "bench" else 20)


def test_motors_warm_up_with_their_losses():
    """Over a second: thermal resistance times the heat of R I^2 over the time constant of 240 s."""
    physics, heat = hanging("sim"), 0.0
    drive(physics, 1.0)
    for _ in range(100):
        physics.advance(0.01)
        heat += 0.01 * physics.parameters["terminal_resistance"][0].numpy() * physics.read().current ** 2
    assert physics.read().temperature - 28.0 == pytest.approx(12.9 * heat / 240.0, rel=0.05)


def test_low_supply_limits_the_current():
    """A brown-out leaves a driver too little voltage for the current that it shall regulate."""
    for physics in (hanging("sim"), hanging("stand_in")):
        physics.supply = 2.0
        drive(physics, 1.5)
        physics.advance(0.03)
        assert np.abs(physics.read().current).max() < 0.8
        assert physics.read().voltage == pytest.approx(2.0)


def test_a_model_driven_by_voltage_is_refused():
    """The emulated servos regulate current."""
    with pytest.raises(ValueError, match="voltage"):
        SimPhysics(load_model("sts3032"), build_scene("bench", "bench"))
