"""Windows under effects that change the bodies, against the whole simulation by MuJoCo."""

import sys
from pathlib import Path

import numpy as np
import pytest

from op3.diagnose import WindowResiduals
from op3.diagnose.coordinates import with_chain
from op3.motions import chirp, leg_suite, multisine, squat
from op3.replay import ModelRobot, simulate_motion
from op3.replay.planned import planned_suite
from op3.robot import load_robot
from op3.robot.register_units import CURRENT_UNIT
from op3.rollout import LogError, Rollout
from op3.servo import Estimate, RobotModel, effect_class
from op3.sim import load_model, servo_model
from op3.sim.held_base import PendulumBase
from tests.op3_table import LEG_JOINTS

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "robot"))
from robots import ROBOTS, write_robot

FAULTS = {
    ("link_mass", "link_mass_offset", "r_ank_roll"): 0.09,
    ("link_com", "link_com_offset_x", "r_ank_pitch"): 0.02,
    ("link_inertia", "gyration_squared", "r_ank_roll"): 0.004,
    ("encoder_offset", "encoder_offset", "r_hip_roll"): 0.06,
    ("encoder_nonlinearity", "encoder_nonlinearity", "r_hip_roll"): 0.06,
}


def with_fault(effect: str, parameter: str, joint: str | None, amount: float) -> RobotModel:
    joints = {} if joint is None else {joint: amount}
    made = effect_class(effect)
    neutral = {known.name: 1.5 if known.neutral is None else known.neutral for known in made.parameters}
    return with_chain(load_model("paper")).with_effect(made(), {**neutral, parameter: Estimate(0.0, joints=joints)})


@pytest.mark.parametrize("fault", FAULTS, ids=[name for name, *_ in FAULTS])
def test_windows_of_a_faulty_leg_agree_with_mujoco(fault):
    """A fault that the model holds, as a value of its own or as a parameter, leaves less than half of the squares.

    What is left is that of smoothing and of steps, as in logs of a leg without a fault.
    """
    effect, parameter, joint = fault
    faulty, sound = with_fault(*fault, FAULTS[fault]), with_fault(effect, parameter, None, 0.0)
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(planned_suite(faulty, runs), windows=18)
    values = sound.tensors(LEG_JOINTS)[parameter].clone()
    values[0, LEG_JOINTS.index(joint)] = FAULTS[fault]
    scale = np.abs(engine.errors(sound)).max((0, 1, 2, 3))
    own, without = (np.square(engine.errors(model) / scale).mean() for model in (faulty, sound))
    as_parameter = engine.errors(sound, {parameter: values})
    np.testing.assert_allclose(as_parameter, engine.errors(faulty), atol=1e-4)
    assert own < 0.4 * without


def test_commands_are_rounded_as_the_servos_take_them():
    """The simulated controller asks for whole counts of the goal current's register."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(planned_suite(load_model("paper"), runs), windows=6)
    simulation = engine.simulation(with_chain(load_model("paper")))
    (controller,) = [effect for effect in simulation.model.effects if effect.name == "current_pd"]
    assert controller.resolution == CURRENT_UNIT


def test_steps_are_stretched_as_far_as_they_divide_a_tick():
    """Of 8 ms: four steps of 2 ms and two of 4 ms, and no step of 3 ms."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(planned_suite(load_model("paper"), runs), windows=6)
    found = [engine.simulation(load_model("paper"), stretch=stretch).substeps for stretch in (1, 2, 3, 4)]
    assert found == [8, 4, 4, 2]


@pytest.mark.parametrize(("name", "parameter"), [("backlash", "backlash_half_gap"), ("viscous", "viscous_friction")])
def test_loose_gears_take_no_longer_steps(name, parameter):
    """Coarse residuals of a stiff model are the exact ones; of another they are not."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(planned_suite(load_model("paper"), runs), windows=6)
    made = effect_class(name)
    values = {known.name: known.nominal for known in made.parameters} | {parameter: 0.003}
    model = load_model("paper").with_effect(made(), values)
    exact, coarse = engine.errors(model), engine.errors(model, stretch=2)
    assert np.array_equal(exact, coarse) == model.stiff == (name == "backlash")


def test_what_the_gyro_tells_of_a_stand_that_sways_is_asked_of_the_joints():
    """A trunk that pitches by 0.05 rad/s four times a second; the gyro tells it 6 ms late."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:1]
    (still,) = planned_suite(load_model("paper"), runs)
    time, rate = still.array("time"), 2 * np.pi * 4
    gyro = 0.05 * np.sin(rate * (time - 0.006)) * [0.0, 1.0, 0.0]
    arrays = {key: still.array(key) for key in still.channels} | {("imu", "angular_velocity"): gyro}
    swaying = WindowResiduals([Rollout.from_arrays(arrays, still.metadata)], windows=6)
    known = WindowResiduals([still], windows=6).motion
    asked = 0.05 * rate * np.cos(rate * known.time) * known.dynamics.carried[:, :, 1]
    np.testing.assert_allclose(swaying.motion.dynamics.bias - known.dynamics.bias, asked, atol=0.05 * asked.max())
    np.testing.assert_allclose(swaying.motion.dynamics.mass, known.dynamics.mass)


def test_a_bench_has_the_dynamics_of_a_pendulum():
    """0.5 kg on 0.1 m: 0.005 kg m^2, 0.49 N m held level; a gyration of 0.05 m adds a quarter of the inertia."""
    bench = PendulumBase(0.5, 0.1)
    level = bench.dynamics(np.array([[np.pi / 2]]), np.zeros((1, 1)), radial_force=True)
    assert level.mass[0, 0, 0] == pytest.approx(0.005)
    assert level.bias[0, 0] == pytest.approx(0.5 * 9.81 * 0.1, rel=1e-3)
    assert level.radial_force[0, 0] == pytest.approx(0.5 * 9.81, rel=1e-3)
    edited = bench.changed(load_model("paper"), "gyration_squared", 0, 0.0025)
    assert edited is not None
    assert bench.along(edited, np.zeros((1, 1)), np.zeros((1, 1))).mass[0, 0, 0] == pytest.approx(0.00625)
    assert bench.changed(load_model("paper"), "link_mass_offset", 0, 0.1) is None


def test_a_limb_by_itself_moves_as_with_all_others():
    """Windows of both legs' joints, simulated together and each leg by itself, agree where no supply couples them."""
    model = with_chain(load_model("paper"))
    motion = squat(frequency=1.0, duration=2.5)
    log = simulate_motion(model, motion, "stand")
    columns = [log.joints.index(joint) for joint in log.joints if "knee" in joint or "hip" in joint or "ank" in joint]
    arrays = {k: log.array(k)[:, columns] if k[0] in ("joint", "command") else log.array(k) for k in log.channels}
    arrays = {key: value for key, value in arrays.items() if key != ("joint", "voltage")}
    legs = Rollout.from_arrays(arrays, log.metadata.replace(joints=tuple(log.joints[c] for c in columns)))
    engine = WindowResiduals([legs], windows=6)
    whole = engine.errors(model)
    sides = [[j for j, joint in enumerate(engine.joints) if joint.startswith(side)] for side in ("l_", "r_")]
    for side in sides:
        np.testing.assert_allclose(engine.part(side).errors(model), whole[:, :, :, side], atol=2e-5)


@pytest.mark.parametrize("name", ROBOTS)
def test_windows_of_any_robot(name, tmp_path):
    """Its own model predicts the windows of its log twice as well as one of ten times the friction."""
    path = write_robot(tmp_path, name)
    log = ModelRobot(str(path)).play(multisine(duration=2.0, robot=str(path)), 6.0, 0.1, recording="one")
    model = servo_model(load_robot(path))
    stuck = model.with_values({"coulomb_friction": 10.0 * model.value("coulomb_friction")})
    engine = WindowResiduals([log], windows=6)
    own, other = (np.sqrt(np.square(engine.errors(one)[..., 0]).mean()) for one in (model, stuck))
    assert own < 0.5 * other
    assert bool(engine.mirror) == any(entry.mirror for entry in log.robot.file.joints.values())


def test_a_velocity_that_was_set_aside_is_not_compared():
    """That of one joint: all other channels are, and the position of the same joint."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:1]
    (log,) = planned_suite(load_model("paper"), runs)
    aside = Rollout(log.data, log.metadata.replace(set_aside=["r_knee.velocity"]))
    known = WindowResiduals([aside], windows=4).known
    expected = np.ones_like(known)
    expected[LEG_JOINTS.index("r_knee"), 1] = False
    np.testing.assert_array_equal(known, expected)


def test_too_few_readings_for_a_window_are_refused():
    """At 10 Hz a window of 0.2 s has two: the sentence says how many it takes."""
    log = simulate_motion(load_model("paper"), chirp({"l_knee": 0.3}, duration=3.0, robot="op3"), mount="stand")
    rows = slice(0, log.rows, 12)
    slow = Rollout.from_arrays({key: log.array(key)[rows] for key in log.channels}, log.metadata)
    with pytest.raises(LogError, match=r"2 readings in 0.19 s are too few for a window.* record 4"):
        WindowResiduals([slow])
