"""Scenes: what compiles, what touches, where things start."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.motions.op3_motions import SQUAT_LEAN
from op3.robot import pose
from op3.robot.kinematics import rotation_matrix
from op3.scenes import SCENES, Scene, build_bench, build_scene
from tests.op3_table import JOINTS, LIMBS

joint_positions = st.lists(st.floats(-2.8, 2.8), min_size=20, max_size=20).map(np.array)


@pytest.fixture(scope="module")
def floor() -> Scene:
    """The robot on the floor."""
    return build_scene("floor", "op3")


@pytest.fixture(scope="module")
def stand_model() -> mujoco.MjModel:
    """The robot in the stand, compiled."""
    return build_scene("stand", "op3").compile()


def start(scene: Scene, *where) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A compiled scene in its initial state."""
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(*where)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("name", SCENES)
def test_scenes_compile(name):
    """Every scene compiles with the common step and integrator."""
    model = build_scene(name, "op3").compile()
    assert model.opt.timestep == 0.001
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.nu == 0


def test_unknown_scene():
    """An unknown scene is named, with the ones that exist."""
    with pytest.raises(ValueError, match=r"unknown scene 'moon'; there are floor, stand, bench,"):
        build_scene("moon", "op3")


def test_joint_layout(floor, stand_model):
    """In order, joints are qpos[7:] and qvel[6:] of a free robot, and everything of a fixed one."""
    model = floor.compile()
    assert [model.joint(name).qposadr[0] for name in floor.joint_names] == list(range(7, 27))
    assert [model.joint(name).dofadr[0] for name in floor.joint_names] == list(range(6, 26))
    assert [stand_model.joint(name).qposadr[0] for name in floor.joint_names] == list(range(20))
    assert [joint.name for joint in floor.joints] == list(JOINTS)


def test_nothing_moves_otherwise_without_geoms_for_pictures(floor):
    """A fall onto the floor is the same to the bit, with a tenth of the geoms."""
    ends = []
    for visual in (True, False):
        model = floor.compile(visual)
        data = mujoco.MjData(model)
        data.qpos[:] = floor.initial_qpos(pose("stand", "op3"), roll=0.4)
        mujoco.mj_step(model, data, 400)
        ends.append((data.qpos.copy(), data.ncon, model.ngeom))
    assert np.array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1] > 0
    assert ends[1][2] < ends[0][2] / 5


@pytest.mark.parametrize(("name", "lean"), [("zero", 0.0), ("stand", 0.0), ("squat_low", SQUAT_LEAN)])
def test_initial_state_touches_the_floor(floor, name, lean):
    """A free robot starts with all four sole boxes on the floor and no penetration."""
    model, data = start(floor, pose(name, "op3"), 0.0, lean)
    data.qpos[2] -= 1e-5
    mujoco.mj_forward(model, data)
    touching = {model.geom(contact.geom[1]).name for contact in data.contact}
    assert touching == {f"op3/{side}_sole_{kind}" for side in "lr" for kind in ("long", "wide")}
    assert data.ncon == 16
    assert np.abs(data.contact.dist).max() < 2e-5


def test_reference_pose_stands(floor):
    """The model's own reference pose is the zero pose on the floor, so a fresh MjData is usable."""
    model = floor.compile()
    np.testing.assert_allclose(model.qpos0, floor.initial_qpos(pose("zero", "op3")), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(joint_positions)
def test_nothing_touches_the_stand(stand_model, position):
    """In the stand the robot touches nothing but itself in any pose."""
    data = mujoco.MjData(stand_model)
    data.qpos[:] = position
    mujoco.mj_forward(stand_model, data)
    bodies = stand_model.geom_bodyid[data.contact.geom]
    assert (stand_model.body_rootid[bodies] == stand_model.body("op3/").id).all()


def test_stand_tilts():
    """The stand's tilt is the trunk's orientation, and its height stays."""
    model, data = start(build_scene("stand", "op3", tilt_roll=0.3, tilt_pitch=-0.2), pose("zero", "op3"))
    trunk = data.body("op3/body_link")
    np.testing.assert_allclose(trunk.xmat.reshape(3, 3), rotation_matrix(0.3, -0.2), atol=1e-12)
    np.testing.assert_allclose(trunk.xpos, [0.0, 0.0, 0.5], atol=1e-12)
    assert model.nv == 20


def test_mounted_specific_force(floor):
    """A fixed IMU reads gravity: 9.81 upwards, turned into the frame of the tilted trunk."""
    np.testing.assert_allclose(build_scene("stand", "op3").mounted_specific_force, [0.0, 0.0, 9.81])
    # Nose down by 0.2 rad: up is 9.81 cos 0.2 along z and -9.81 sin 0.2 along the nose.
    expected = [-9.81 * np.sin(0.2), 0.0, 9.81 * np.cos(0.2)]
    np.testing.assert_allclose(build_scene("stand", "op3", tilt_pitch=0.2).mounted_specific_force, expected, atol=1e-12)
    with pytest.raises(ValueError, match="the base of scene 'floor' moves"):
        _ = floor.mounted_specific_force


def test_wrong_tilts(floor):
    """A tilt that a scene cannot have is refused, with what to do."""
    with pytest.raises(ValueError, match="only the scene 'stand' can be tilted"):
        build_scene("floor", "op3", tilt_roll=0.1)
    with pytest.raises(ValueError, match="tilt the stand with build_scene"):
        build_scene("stand", "op3").initial_qpos(pose("zero", "op3"), roll=0.1)
    with pytest.raises(ValueError, match=r"shape \(20,\), got \(3,\)"):
        floor.initial_qpos(np.zeros(3))


def test_fall_ends_on_the_floor(floor):
    """A limp robot collapses onto the floor, stays above it, and its parts stay within 2 mm outside each other."""
    model, data = start(floor, pose("stand", "op3"), 0.0, 0.3)
    # Frictionless hinges flail against their stops; what a servo has of friction and inertia calms them.
    model.dof_damping[6:], model.dof_armature[6:] = 0.05, 0.01
    deepest = 0.0
    for _ in range(1500):
        mujoco.mj_step(model, data)
        deepest = min(deepest, data.contact.dist.min(initial=0.0))
    assert deepest > -0.002
    assert data.body("op3/body_link").xpos[2] < 0.15
    assert data.xipos[1:, 2].min() > 0.0
    assert not any(warning.number for warning in data.warning)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 3.0), st.floats(0.02, 1.0), st.floats(-3.0, 3.0))
def test_bench_is_a_point_pendulum(mass, length, position):
    """Inertia is mass length^2, gravity -mass 9.81 length sin(position), the total mass the weight's."""
    scene = build_bench(mass, length)
    model, data = start(scene, [position])
    inertia = np.empty((1, 1))
    mujoco.mj_fullM(model, data, inertia)
    assert scene.joint_names == ("bench/servo",)
    assert model.body_mass.sum() == pytest.approx(mass, rel=1e-12)
    assert inertia[0, 0] == pytest.approx(mass * length**2, rel=1e-6)
    torque = -mass * 9.81 * length * np.sin(position)
    assert -data.qfrc_bias[0] == pytest.approx(torque, rel=1e-9, abs=1e-12)


def test_bench_description():
    """The bench has no robot and says how its servo is loaded."""
    scene = build_scene("bench", "bench")
    assert (scene.robot, scene.mount, scene.name) == (None, "pendulum", "bench")
    assert scene.initial_qpos([0.4]).tolist() == [0.4]
    with pytest.raises(ValueError, match=r"must be positive, got 0.0 kg and 0.1 m"):
        build_bench(0.0, 0.1)


def test_a_stand_may_hold_some_limbs_only():
    """Limbs without a wanted joint are left out, whole limbs stay; on a floor that is refused."""
    scene = build_scene("stand", "op3", joints=("r_knee", "head_tilt"))
    assert [str(joint.name) for joint in scene.joints] == [*LIMBS[0], *LIMBS[-1]]
    assert scene.compile().nq == 8
    with pytest.raises(ValueError, match="stand"):
        build_scene("floor", "op3", joints=("r_knee",))
