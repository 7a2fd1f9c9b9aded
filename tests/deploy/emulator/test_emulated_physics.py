"""What stands behind the bus: the simulated robot and the stand-in, with motors that are off, regulated or driven."""

import numpy as np
import pytest
import torch
from wheels import Bench

from op3.deploy.emulator import Battery, SimPhysics, StandInPhysics
from op3.deploy.emulator.firmware import Drive
from op3.robot import build_scene, pose
from op3.sim import BatchSimulation, attach_servos, load_model
from op3.stand_in import StandIn, World
from tests.op3_table import JOINTS

KNEE = JOINTS.index("l_knee")


def drive(enabled=True, current=0.0, duty=0.0, voltage=False, count=20):
    return Drive(
        np.full(count, enabled),
        np.broadcast_to(np.asarray(current, dtype=float), count).copy(),
        np.full(count, duty),
        np.full(count, voltage),
        np.full(count, 3.2),
    )


def hanging(kind):
    return SimPhysics(load_model("paper"), "stand") if kind == "sim" else StandInPhysics(World(), "stand")


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_without_torque_the_goal_means_nothing(kind):
    """Joints that are off run free: whatever goal stands in the register, they move alike and carry no current."""
    first, second = hanging(kind), hanging(kind)
    first.drive(drive(enabled=False, current=1.0))
    second.drive(drive(enabled=False, duty=0.5, voltage=True))
    for physics in (first, second):
        physics.advance(0.5)
        assert np.abs(physics.read().current).max() < 0.02
    assert np.abs(first.position - second.position).max() < 0.005


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_off_is_free_and_a_duty_of_zero_brakes(kind):
    """A motor that is off slows its joint by friction alone; one shorted by a duty of 0 brakes it."""
    speeds = []
    for asked in (drive(enabled=False), drive(voltage=True)):
        physics = hanging(kind)
        physics.drive(drive(current=1.0))
        physics.advance(0.06)
        physics.drive(asked)
        physics.advance(0.008)
        speeds.append(abs(physics.velocity[KNEE]))
    assert speeds[0] > 1.2 * speeds[1]


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_a_goal_current_flows(kind):
    """A driver that regulates current reads the current that was asked for."""
    physics = hanging(kind)
    physics.drive(drive(current=0.2))
    physics.advance(0.02)
    assert physics.read().current == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_a_robot_in_position_mode_holds_its_pose(kind):
    """All servos in their factory mode hold the angles at which they were switched on."""
    bench = Bench(hanging(kind))
    for number in range(1, 21):
        assert bench.write(number, 64, 1, 1) == (0, 0)
    start = bench.physics.position.copy()
    bench.clock.sleep(1.0)
    assert np.abs(bench.physics.position - start).max() < 0.04


@pytest.mark.parametrize("kind", ["sim", "stand_in"])
def test_a_fall_shows_in_the_imu(kind):
    """Without torque the robot on the floor collapses: its accelerometer and attitude say so."""
    physics = SimPhysics(load_model("paper")) if kind == "sim" else StandInPhysics()
    physics.drive(drive(enabled=False))
    physics.advance(2.5)
    readings = physics.read()
    assert np.linalg.norm(readings.linear_acceleration) == pytest.approx(9.8, rel=0.2)
    assert np.abs(physics.position - pose("stand")).max() > 0.3


def test_the_simulation_behind_the_bus_is_the_simulation():
    """With goal currents of a constant PD command it moves as `BatchSimulation` moves without latency."""
    model = load_model("paper").without("latency")
    scene = build_scene("floor")
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
    stand = pose("stand")
    commands = {"position_target": torch.from_numpy(stand), "p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}
    direct.reset(scene.initial_qpos(stand), commands)
    physics = SimPhysics(model)
    for _ in range(200):
        current = 6.0 * (stand - physics.position) - 0.1 * physics.velocity
        physics.drive(drive(current=np.clip(current, -2.3, 2.3)))
        physics.advance(0.001)
        direct.advance()
    measured = direct.measure()["joint", "position"][0].numpy()
    assert np.abs(physics.position - measured).max() < 1e-9


def test_the_stand_in_behind_the_bus_is_the_stand_in():
    """The same currents move it as they move a stand-in of its own."""
    physics, direct = StandInPhysics(World(), seed=3), StandIn(World(), seed=3)
    direct.reset(pose("stand"))
    sensors = direct.read_sensors()  # a reading draws from the same random numbers as the servos do
    for number in range(50):
        current = 0.3 * np.sin(0.3 * number + np.arange(20))
        physics.drive(drive(current=current))
        direct.write_current(current)
        physics.advance(0.004)
        direct.advance(0.004)
        sensors = direct.read_sensors()
    assert (physics.position == sensors.position).all()


@pytest.mark.parametrize("scene", ["floor", "stand", "bench"])
def test_any_scene_will_do(scene):
    """Both physics take every scene; on the bench there is one servo and no IMU."""
    for physics in (
        SimPhysics(load_model("paper").without("payload", "com_offset"), scene),
        StandInPhysics(scene=scene),
    ):
        physics.advance(0.005)
        assert (physics.read().orientation is None) == (scene == "bench")
        assert len(physics.known.joints) == (1 if scene == "bench" else 20)


def test_a_battery_sags_and_runs_down():
    """Under load the voltage falls by resistance times current, and charge goes."""
    battery = Battery(charge=0.5)
    rest = battery.voltage
    battery.step(100.0, 1.0)
    assert rest - battery.voltage == pytest.approx(0.2 * 100 / rest, rel=0.05)
    assert battery.charge < 0.5
    for _ in range(100):
        battery.step(100.0, 10.0)
    assert battery.charge == 0
    with pytest.raises(ValueError, match="charge"):
        Battery(charge=2.0)


def test_motors_warm_up_with_their_losses():
    """Over a second: thermal resistance times the heat of R I^2 over the time constant of 240 s."""
    physics, heat = hanging("sim"), 0.0
    physics.drive(drive(current=1.0))
    for _ in range(100):
        physics.advance(0.01)
        heat += 0.01 * physics.parameters["terminal_resistance"][0].numpy() * physics.read().current ** 2
    assert physics.read().temperature - 28.0 == pytest.approx(12.9 * heat / 240.0, rel=0.05)


def test_low_supply_limits_the_current():
    """A brown-out leaves a driver too little voltage for the current that it shall regulate."""
    for physics in (hanging("sim"), hanging("stand_in")):
        physics.supply = 2.0
        physics.drive(drive(current=1.5))
        physics.advance(0.03)
        assert np.abs(physics.read().current).max() < 0.8
        assert physics.read().voltage == pytest.approx(2.0)


def test_a_model_driven_by_voltage_is_refused():
    """The emulated servos regulate current."""
    with pytest.raises(ValueError, match="voltage"):
        SimPhysics(load_model("sts3032"), "bench")
