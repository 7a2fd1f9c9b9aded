"""The stand-in robot below `play`: placing, commanding, reading, energy, gear, time step."""

import numpy as np
import pinocchio
import pytest

from op3.motions import squat
from op3.robot import pose
from op3.robot.register_units import (
    ACCELERATION_UNIT,
    ANGLE_UNIT,
    CURRENT_UNIT,
    GYRO_UNIT,
    POSITION_UNIT,
    VELOCITY_UNIT,
    VOLTAGE_UNIT,
)
from op3.scenes import build_bench, build_scene
from op3.stand_in import HiddenWorld, StandIn

QUIET = HiddenWorld(
    joint_spread=0.0,
    friction_drift=0.0,
    torque_noise=0.0,
    current_offset=0.0,
    current_noise=0.0,
    latency_jitter=0.0,
    placement=0.0,
)
FREE = QUIET.replace(coulomb_friction=0.0, static_friction_excess=0.0, viscous_friction=0.0, armature=1e-9)


def hold(robot: StandIn, target: np.ndarray, duration: float) -> None:
    for _ in range(round(duration / 0.008)):
        sensors = robot.read_sensors()
        robot.write_current(6.0 * (target - sensors.position) - 0.1 * sensors.velocity, 0.006)
        robot.advance(0.008)


def test_a_held_robot_stays_at_rest():
    """With the noises off, a robot that stands holds every joint and its trunk still to the last count."""
    robot = StandIn(QUIET.replace(gyro_noise=0.0, accelerometer_noise=0.0), build_scene("floor", "op3"))
    robot.reset(pose("stand", "op3"))
    hold(robot, pose("stand", "op3"), 1.5)
    before = robot.read_sensors()
    hold(robot, pose("stand", "op3"), 1.0)
    after = robot.read_sensors()
    assert after.position.tolist() == before.position.tolist()
    assert after.orientation is not None
    assert before.orientation is not None
    assert after.orientation.tolist() == before.orientation.tolist()
    assert not after.velocity.any()


def test_a_leaning_pose_stands_on_its_soles():
    """The trunk is tilted so that the soles are level: the squat's lean is found from its joint angles."""
    robot = StandIn(HiddenWorld(), build_scene("floor", "op3"))
    robot.reset(squat(lean=0.3).position[0])
    orientation = robot.read_sensors().orientation
    assert orientation is not None
    assert orientation == pytest.approx([0.0, 0.3, 0.0], abs=ANGLE_UNIT)


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_specific_force_in_the_stand(tilt):
    """At rest the accelerometer reads gravity upwards, turned into the tilted trunk."""
    robot = StandIn(QUIET.replace(accelerometer_noise=0.0), build_scene("stand", "op3", tilt_pitch=tilt))
    robot.reset(pose("stand", "op3"))
    robot.advance(0.1)
    force, orientation = robot.read_sensors().linear_acceleration, robot.read_sensors().orientation
    assert force is not None
    assert orientation is not None
    # Pitched forward by t the trunk's x axis points down: -g sin(t); its z axis leans: g cos(t).
    assert force == pytest.approx([-9.81 * np.sin(tilt), 0, 9.81 * np.cos(tilt)], abs=ACCELERATION_UNIT)
    assert orientation == pytest.approx([0, tilt, 0], abs=ANGLE_UNIT)


def test_readings_lie_on_the_registers_grids():
    """Every reading is a whole number of the register's units."""
    robot = StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=3)
    robot.reset(pose("stand", "op3"))
    hold(robot, pose("squat_low", "op3"), 0.08)
    sensors = robot.read_sensors()
    units = {
        "position": POSITION_UNIT,
        "velocity": VELOCITY_UNIT,
        "current": CURRENT_UNIT,
        "voltage": VOLTAGE_UNIT,
        "temperature": 1.0,
        "orientation": ANGLE_UNIT,
        "angular_velocity": GYRO_UNIT,
        "linear_acceleration": ACCELERATION_UNIT,
    }
    for name, unit in units.items():
        counts = getattr(sensors, name) / unit
        assert counts == pytest.approx(np.round(counts), abs=1e-6), name
        assert counts.any(), name


def test_a_command_takes_its_time():
    """A current written with a delay starts after it."""
    robot = StandIn(QUIET.replace(current_lag=1e-6), build_scene("stand", "op3"))
    robot.reset(pose("zero", "op3"))
    robot.write_current(np.full(20, 0.269), 0.005)
    robot.advance(0.005)
    assert not robot.read_sensors().current.any()
    robot.advance(0.00025)
    assert robot.read_sensors().current == pytest.approx(np.full(20, 0.269))


def test_current_limit():
    """A servo holds no goal beyond 2.3 A."""
    robot = StandIn(QUIET, build_scene("stand", "op3"))
    robot.reset(pose("zero", "op3"))
    robot.write_current(np.full(20, 5.0))
    robot.advance(0.005)
    assert robot.read_sensors().current.max() <= 2.3 + CURRENT_UNIT / 2


def test_advance_carries_parts_of_a_step():
    """Many short advances add up to one long one."""
    robot = StandIn(HiddenWorld(), build_scene("stand", "op3"))
    for _ in range(1000):
        robot.advance(0.0001)
    assert robot.time == pytest.approx(0.1)


def test_bad_currents_are_refused():
    """Currents that are no numbers, too few, or would overtake others are refused."""
    robot = StandIn(HiddenWorld(), build_scene("stand", "op3"))
    with pytest.raises(ValueError, match="20 finite numbers"):
        robot.write_current(np.zeros(3))
    with pytest.raises(ValueError, match="20 finite numbers"):
        robot.write_current(np.full(20, np.nan))
    robot.write_current(np.zeros(20), 0.006)
    with pytest.raises(ValueError, match="cannot arrive"):
        robot.write_current(np.zeros(20), 0.001)


@pytest.mark.parametrize(("asked", "made"), [(0.0003, 0.001 / 3), (0.002, 0.00025), (0.00011, 0.001 / 9)])
def test_a_step_meets_every_millisecond(asked, made):
    """Filters and noise run at 1 kHz, so the step is made a whole part of it, a quarter at most."""
    assert HiddenWorld(timestep=asked).timestep == pytest.approx(min(made, 0.00025))


def swing(world: HiddenWorld, angle: float, duration: float) -> list[float]:
    """Energy of the released pendulum of the bench, every 10 ms [J]."""
    robot = StandIn(world, build_bench(mass=0.5, length=0.15))
    robot.reset(np.array([angle]))
    energies = []
    for _ in range(round(duration / 0.01)):
        robot.advance(0.01)
        position, velocity = float(robot.servos.states["position"][0]), float(robot.servos.states["velocity"][0])
        inertia = 0.5 * 0.15**2 + world.armature
        energies.append(0.5 * inertia * velocity**2 + 0.5 * 9.81 * 0.15 * (1 - np.cos(position)))
    return energies


def test_a_frictionless_pendulum_keeps_its_energy():
    """Without friction the energy of a pendulum swings by less than 0.3 % and does not drift: 0.02 % in 4 s.

    The motor is so weak that its back-EMF, which above the bus voltage would brake, stays below it.
    """
    energies = swing(FREE.replace(torque_constant=1e-4), 1.5, 4.0)
    assert np.ptp(energies) < 3e-3 * energies[0]
    assert np.mean(energies[:200]) == pytest.approx(np.mean(energies[200:]), rel=2e-4)


def test_friction_stops_a_pendulum():
    """With the motor off the pendulum only loses energy, and stops within Coulomb's angle."""
    energies = swing(QUIET.replace(coulomb_friction=0.05), 1.5, 4.0)
    # Strained teeth give back at most bound^2 / (2 stiffness) = 0.15^2 / 800 J.
    assert max(np.diff(energies)) < 3e-5
    assert energies[-1] < 0.1 * energies[0]
    assert np.ptp(energies[-20:]) < 1e-5


def test_a_dead_robot_loses_energy():
    """Legs let go from a bent pose in the stand never gain mechanical energy and come to rest."""
    robot = StandIn(QUIET, build_scene("stand", "op3"))
    robot.reset(pose("squat_low", "op3"))
    limbs, energies = robot._bodies, []
    for _ in range(300):
        robot.advance(0.01)
        energies.append(pinocchio.computeMechanicalEnergy(limbs.model, limbs.data, limbs.position, limbs.velocity))
    # Each of 20 servos may give back what its strained teeth hold, 0.15^2 / 800 J.
    assert max(np.diff(energies)) < 20 * 0.15**2 / 800
    assert energies[-1] < energies[0]
    assert np.abs(robot.servos.states["velocity"]).max() < 1e-3


@pytest.mark.parametrize("efficiency", [0.6, 0.8])
def test_lifting_and_lowering(efficiency):
    """Slowly lowering a weight takes eta_fw eta_bw of the current that lifting takes, friction aside."""
    world = FREE.replace(forward_efficiency=0.9, backward_efficiency=efficiency, armature=0.005)
    robot = StandIn(world, build_bench(mass=0.5, length=0.15))
    robot.reset(np.array([0.8]))
    times = np.arange(0, 8, 0.001)
    angle, target_speed = 1.2 - 0.4 * np.cos(2 * np.pi * times / 4), 0.4 * 2 * np.pi / 4 * np.sin(2 * np.pi * times / 4)
    rows = []
    for target, speed in zip(angle, target_speed, strict=True):
        position, velocity = float(robot.servos.states["position"][0]), float(robot.servos.states["velocity"][0])
        robot.write_current([20 * (target - position) + 0.5 * (speed - velocity)])
        robot.advance(0.001)
        rows.append((position, velocity, float(robot.servos.states["current"][0])))
    position, velocity, current = np.array(rows)[4000:].T
    near = np.abs(position - 1.2) < 0.1
    lifting, lowering = current[near & (velocity > 0.3)].mean(), current[near & (velocity < -0.3)].mean()
    assert near.sum() > 200
    assert lowering / lifting == pytest.approx(0.9 * efficiency, rel=0.01)
    torque = 0.5 * 9.81 * 0.15 * np.sin(1.2)
    assert lifting == pytest.approx(torque / (0.9 * 353.5 * world.torque_constant), rel=0.01)


def test_converges_with_the_time_step():
    """The step's error halves with the step, and at the default is below an encoder count.

    All joints swing for 0.8 s, most by more than 1 rad. The loop is open: quantised feedback turns any
    difference into another sequence of counts.
    """

    def final(timestep: float) -> np.ndarray:
        robot = StandIn(QUIET.replace(timestep=timestep), build_scene("stand", "op3"))
        robot.reset(pose("stand", "op3"))
        positions = []
        for tick in range(100):
            robot.write_current(0.25 * np.sin(2 * np.pi * tick * 0.008 * np.linspace(1, 3, 20)), 0.006)
            robot.advance(0.008)
            positions.append(robot.servos.states["position"].copy())
        return np.array(positions)

    reference = final(0.001 / 40)
    errors = [np.sqrt(((final(step) - reference) ** 2).mean()) for step in (0.00025, 0.000125)]
    assert np.median(np.ptp(reference, axis=0)) > 1.0
    assert errors[0] < POSITION_UNIT
    assert errors[1] < 0.7 * errors[0]


def test_divergence_is_an_error():
    """Physics that blow up are reported, not logged."""
    robot = StandIn(QUIET, build_scene("stand", "op3"))
    robot._bodies.velocity[:] = 1e200
    with pytest.raises(RuntimeError, match="diverged at"):
        robot.advance(0.01)


def test_the_body_is_the_worlds():
    """Mass, centre of mass, armature and ground of the compiled model are the world's, on top of the public model."""
    world = HiddenWorld(base_mass_offset=0.3, base_com_offset_x=0.01, base_com_offset_z=-0.02, foot_friction=0.65)
    robot, public = StandIn(world, build_scene("floor", "op3")), build_scene("floor", "op3").compile()
    hidden, trunk = robot._model, robot._model.body("op3/body_link").id
    assert hidden.body_subtreemass[0] - public.body_subtreemass[0] == pytest.approx(0.3)
    assert hidden.body_ipos[trunk] - public.body_ipos[trunk] == pytest.approx([0.01, 0, -0.02])
    assert hidden.dof_armature[6:] == pytest.approx(np.full(20, world.armature))
    assert hidden.geom("floor").friction[0] == 0.65
