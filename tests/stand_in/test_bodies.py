"""Limbs by Pinocchio, against energy and against MuJoCo, which shares none of their algorithms."""

import mujoco
import numpy as np
import pinocchio
import pytest

from op3.motions import robot_suite
from op3.robot import pose
from op3.scenes import build_bench, build_scene
from op3.stand_in import HiddenWorld, StandIn
from op3.stand_in.bodies import Floor, limb_model

FREE = HiddenWorld(
    torque_constant=1e-6, coulomb_friction=0.0, viscous_friction=0.0, static_friction_excess=0.0, bristle_damping=0.0,
    bristle_stiffness=1e-6, backward_efficiency=1.0, torque_noise=0.0, base_mass_offset=0.0, base_com_offset_x=0.0,
    base_com_offset_z=0.0, armature=0.004, timestep=1e-4,
)  # fmt: skip
"""Limbs that swing freely."""


def positions(robot: StandIn) -> np.ndarray:
    return robot.servos.states["position"].copy()


def test_the_models_weigh_alike():
    """Joint-space inertia and gravity torques of the whole robot agree with MuJoCo's to 1e-9, in any pose."""
    model = build_scene("stand", "op3").compile()
    made, names = limb_model(model)
    assert [f"op3/{name.split('/')[1]}" for name in names] == [model.joint(i).name for i in range(model.njnt)]
    data, ours = mujoco.MjData(model), made.createData()
    data.qpos[:] = np.random.default_rng(0).uniform(-1, 1, model.nq)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    upper = np.triu(pinocchio.crba(made, ours, data.qpos))
    np.testing.assert_allclose(upper, np.triu(inertia), atol=1e-9)
    gravity = pinocchio.computeGeneralizedGravity(made, ours, data.qpos)
    np.testing.assert_allclose(gravity, data.qfrc_bias, atol=1e-9)


def test_a_passive_swing_agrees_with_mujoco():
    """Twenty free joints let go 0.3 rad from the pose agree for a quarter of a second to 0.1 mrad."""
    robot = StandIn(FREE, build_scene("stand", "op3"))
    start = pose("stand", "op3") + 0.3
    robot.reset(start)
    model = robot.scene.compile()
    model.opt.timestep, model.opt.integrator = FREE.timestep, mujoco.mjtIntegrator.mjINT_EULER
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.dof_armature[:] = FREE.armature
    data = mujoco.MjData(model)
    data.qpos[:] = start
    for _ in range(25):
        robot.advance(0.01)
        for _ in range(100):
            mujoco.mj_step(model, data)
        assert np.abs(positions(robot) - data.qpos).max() < 1e-4
    assert np.abs(positions(robot) - start).max() > 0.3


def test_a_passive_swing_keeps_its_energy():
    """Twenty free joints lose less than 0.02 % of their energy in a second of large swings."""
    robot = StandIn(FREE, build_scene("stand", "op3"))
    robot.reset(pose("stand", "op3") + 0.3)
    limbs = robot._bodies
    model, data, energies = limbs.model, limbs.data, []
    for _ in range(100):
        robot.advance(0.01)
        inertia = np.triu(pinocchio.crba(model, data, limbs.position))
        inertia += np.triu(inertia, 1).T
        kinetic = 0.5 * limbs.velocity @ inertia @ limbs.velocity
        energies.append(kinetic + pinocchio.computePotentialEnergy(model, data, limbs.position))
    assert np.ptp(energies) < 2e-3
    assert np.abs(limbs.velocity).max() > 3


def test_driven_limbs_agree_with_mujoco():
    """The same servos move the limbs alike by both libraries: a multisine to two encoder counts, most rows to one."""
    quiet = HiddenWorld(torque_noise=0.0, friction_drift=0.0, current_noise=0.0, latency_jitter=0.0, placement=0.0)
    run = robot_suite(3, duration=1.0)[2]
    logs = []
    for by_mujoco in (False, True):
        robot = StandIn(quiet, build_scene("stand", "op3"))
        if by_mujoco:
            robot._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
            robot._bodies = Floor(robot._model, robot.servos, robot.scene.joint_names, robot._imu_places())
        logs.append(robot.play(run.motion, run.p_gain, settle=0.8).array("joint/position"))
    apart = np.abs(logs[0] - logs[1])
    assert np.quantile(apart, 0.9) < 0.0016
    assert apart.max() < 0.005
    assert np.ptp(logs[0], axis=0).max() > 0.3


def test_a_soft_stand_sways():
    """What kicks makes the gyro of a soft stand feel it, at about its frequency, and not of a stiff one."""
    swings = []
    for frequency in (0.0, 12.0):
        robot = StandIn(
            HiddenWorld(gyro_noise=0.0, gyro_bias=0.0, mount_frequency=frequency), build_scene("stand", "op3")
        )
        robot.reset(pose("stand", "op3"))
        rates = []
        for tick in range(125):
            robot.write_current(np.full(20, 0.5 if tick < 25 else 0.0))
            robot.advance(0.008)
            rates.append(robot.read_sensors().angular_velocity[1])
        swings.append(np.array(rates))
    assert not swings[0].any()
    assert np.ptp(swings[1]) > 0.02
    spectrum = np.abs(np.fft.rfft(swings[1] - swings[1].mean()))
    assert 8 < np.fft.rfftfreq(125, 0.008)[spectrum.argmax()] < 20


def test_no_balls():
    """A robot with a ball on a fixed base is refused by the joint's name."""
    xml = '<mujoco><worldbody><body><joint name="lift" type="ball"/><geom size="0.1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="joint 'lift' is neither"):
        limb_model(mujoco.MjModel.from_xml_string(xml))


def test_end_stops_hold():
    """A pendulum driven against the end of its range stays within a few degrees of it."""
    robot = StandIn(HiddenWorld(), build_bench())
    low, high = robot.servos.servos["low"][0], robot.servos.servos["high"][0]
    if not np.isfinite(high):
        robot.servos.servos["low"], robot.servos.servos["high"] = -0.5, 0.5
        low, high = -0.5, 0.5
    robot.reset(np.zeros(1))
    robot.write_current([1.0])
    robot.advance(2.0)
    assert low < positions(robot)[0] < high + 0.05
