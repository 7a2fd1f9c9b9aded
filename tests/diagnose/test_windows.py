"""Windows under effects that change the bodies, against the whole simulation by MuJoCo."""

import numpy as np
import pytest

from op3.diagnose import WindowResiduals, planned_suite, split_logs
from op3.diagnose.coordinates import with_chain
from op3.diagnose.fitting import COARSE, ROUGH
from op3.diagnose.show import show, vetoed
from op3.robot import LEG_JOINTS, leg_suite
from op3.robot.units import CURRENT_UNIT
from op3.servo import Estimate, RobotModel, effect_class
from op3.sim import load_model

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
    """A fault that the model holds, as a value of its own or as a parameter, leaves a third of the error at most.

    What is left is that of smoothing and of steps, as in logs of a leg without a fault.
    """
    effect, parameter, joint = fault
    faulty, sound = with_fault(*fault, FAULTS[fault]), with_fault(effect, parameter, None, 0.0)
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(faulty, runs)), fit_windows=14, select_windows=4)
    values = sound.tensors(LEG_JOINTS)[parameter].clone()
    values[0, LEG_JOINTS.index(joint)] = FAULTS[fault]
    engine.prepare(faulty)
    own, without = (np.square(engine.residuals(model)).mean() for model in (faulty, sound))
    as_parameter = engine.residuals(sound, {parameter: values})
    np.testing.assert_allclose(as_parameter, engine.residuals(faulty), atol=1e-4)
    assert own < without / 9


def test_squares_are_told_by_joint():
    """An error in one joint's velocity is in this joint's squares alone."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(load_model("paper"), runs)), fit_windows=6, select_windows=2)
    error = np.zeros((8, engine.ticks + 1, len(engine.joints), len(engine.channels)))
    error[:, :, 4, engine.channels.index(("joint", "velocity"))] = 0.5
    squares = engine.squares_by_joint(error.reshape(8, -1))
    assert squares.shape == (8, 6)
    np.testing.assert_allclose(squares[:, 4], 0.25 * (engine.ticks + 1))
    assert not squares[:, [0, 1, 2, 3, 5]].any()


@pytest.mark.parametrize(
    ("improved", "worsened", "after", "expected"),
    [
        (True, False, 0.9, False),
        (False, False, 0.9, False),
        (False, True, 0.9, True),
        (True, True, 0.9, False),
        (True, False, 1.0, False),  # the loss does not feel it
        (False, False, 1.0, True),
        (True, True, 1.0, True),
    ],
)
def test_free_runs_veto_what_they_speak_against(improved, worsened, after, expected):
    """Neither a better channel nor a lower loss alone outweighs a channel that is worse."""
    assert vetoed(improved, worsened, 1.0, after) is expected


@pytest.mark.parametrize(("faulty", "expected"), [((), True), (("r_hip_pitch",), False), (("r_hip_yaw",), True)])
def test_a_fault_counts_as_better_where_its_own_joint_is(faulty, expected):
    """A friction that is right in one joint, and another that is wrong: only asked by itself the first is better."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:3]
    paper = load_model("paper")
    usual = paper.value("coulomb_friction")

    def rubbing(**joints: float) -> RobotModel:
        return paper.with_values({"coulomb_friction": Estimate(usual, joints=joints)})

    split = split_logs(planned_suite(rubbing(r_hip_pitch=usual + 0.05), runs))
    half_right = rubbing(r_hip_pitch=usual + 0.05, r_hip_yaw=usual + 0.07)
    assert show(paper, half_right, split, faulty=faulty)["vetoed"] is expected


def test_a_joint_counts_less_only_in_windows_that_stand_out():
    """An outlier of one joint in one window is capped, and what a joint misses in every third window is not."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(load_model("paper"), runs)), fit_windows=24, select_windows=6)
    count = len(engine.windows)
    residual = np.ones((count, engine.ticks + 1, len(engine.joints), len(engine.channels)))
    residual[7, :, 2] = 10.0
    residual[::3, :, 4] = 10.0
    weight = engine._weights(residual.reshape(count, -1)).reshape(residual.shape)
    np.testing.assert_allclose(weight[7, :, 2], 0.2)
    expected = np.ones_like(weight)
    expected[7, :, 2] = 0.2
    np.testing.assert_array_equal(weight, expected)


def test_commands_are_rounded_as_the_servos_take_them():
    """The simulated controller asks for whole counts of the goal current's register."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(load_model("paper"), runs)), fit_windows=4, select_windows=2)
    simulation = engine.simulation(with_chain(load_model("paper")))
    (controller,) = [effect for effect in simulation.model.effects if effect.name == "current_pd"]
    assert controller.resolution == CURRENT_UNIT


def test_steps_are_stretched_as_far_as_they_divide_a_tick():
    """Of 8 ms: four steps of 2 ms and two of 4 ms, and no step of 3 ms."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(load_model("paper"), runs)), fit_windows=4, select_windows=2)
    found = [engine.simulation(load_model("paper"), stretch=stretch).substeps for stretch in (1, COARSE, 3, ROUGH)]
    assert found == [8, 4, 4, 2]


@pytest.mark.parametrize(("name", "parameter"), [("backlash", "backlash_half_gap"), ("viscous", "viscous_friction")])
def test_loose_gears_take_no_longer_steps(name, parameter):
    """Coarse residuals of a stiff model are the exact ones; of another they are not."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    engine = WindowResiduals(split_logs(planned_suite(load_model("paper"), runs)), fit_windows=4, select_windows=2)
    made = effect_class(name)
    values = {known.name: known.nominal for known in made.parameters} | {parameter: 0.003}
    model = load_model("paper").with_effect(made(), values)
    engine.prepare(model)
    exact, coarse = engine.residuals(model)[0], engine.residuals(model, stretch=COARSE)[0]
    assert np.array_equal(exact, coarse) == model.stiff == (name == "backlash")
