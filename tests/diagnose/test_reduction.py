"""What windows are reduced to: rates, which mechanics leave alone and a bent encoder does not."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.diagnose import WindowResiduals
from op3.diagnose.coordinates import base_coordinates, with_chain
from op3.diagnose.judge_settings import FLOORS, PIECES
from op3.diagnose.reduction import Reduction
from op3.diagnose.responses import RATES, filter_matrix, filtered_rate_weights, velocity_weights
from op3.motions import chirp, leg_suite
from op3.replay import simulate_motion
from op3.replay.planned import planned_suite
from op3.servo import Estimate, RobotModel, effect_class
from op3.servo.effects import VelocityFilter
from op3.sim import load_model
from tests.op3_table import LEG_JOINTS
from tests.servo.test_effect_laws import law_of


@given(
    st.integers(8, 30),
    st.lists(st.floats(-2.0, 2.0), min_size=31, max_size=31),
    st.floats(0.004, 0.02),
    st.floats(0.004, 0.03),
    st.floats(0.1, 0.5),
)
@settings(max_examples=20, deadline=None)
def test_whatever_a_joint_does_its_filtered_velocity_is_the_filtered_rate_of_its_angle(
    ticks, angles, period, lag, shape
):
    """Of angles linear between ticks, both whitened, in every piece; the filter by small steps of its equation."""
    angle, fine = np.array(angles[: ticks + 1]), 400
    step, told, slope, velocity = period / fine, 0.0, 0.0, [0.0]
    for rate in np.repeat(np.diff(angle) / period, fine):
        slope += step * (rate - told - slope) / (shape * lag)
        told += step * slope / lag
        velocity.append(told)
    reading, moving = velocity_weights(ticks), filtered_rate_weights(filter_matrix(lag, shape, ticks, period), period)
    assert reading.shape == moving.shape == (RATES, ticks + 1)
    ends = np.rint(np.linspace(0, ticks, PIECES + 1)).astype(int)[1:] * fine
    means = [np.mean(velocity[begin:end]) for begin, end in pairwise(ends)]
    size = np.abs(np.diff(angle)).max() / period / FLOORS["joint", "velocity"]
    whitened = angle / FLOORS["joint", "position"]
    np.testing.assert_allclose(
        moving @ whitened, np.array(means) / FLOORS["joint", "velocity"], atol=0.01 * size + 1e-9
    )
    np.testing.assert_allclose(reading.sum(1), 1.0)


@pytest.mark.parametrize(("lag", "shape"), [(0.0, 0.0), (0.006, 0.0), (0.012, 0.25), (0.018, 1 / 3)])
def test_a_filter_of_readings_is_that_of_the_servo_law(lag, shape):
    """Of velocities that are linear between ticks."""
    velocity, fine = np.cumsum(np.random.default_rng(0).standard_normal(26)), 8
    velocity[0] = 0.0
    law, signals = law_of(VelocityFilter(), velocity_time_constant=lag, velocity_filter_shape=shape)
    law.reset()
    told = []
    for number in range(25 * fine + 1):
        signals.velocity = torch.full_like(signals.velocity, float(np.interp(number / fine, np.arange(26), velocity)))
        law.sense()
        told.append(signals.measured_velocity.item())
        law.step()
    np.testing.assert_allclose(filter_matrix(lag, shape, 25, 0.008) @ velocity, told[::fine], atol=1e-5)


@pytest.mark.parametrize("lag", [0.0, 0.012])
def test_rates_show_an_encoder_that_bends_and_no_friction(lag):
    """A motor's own sensor tells the velocity of a joint whose encoder bends; friction moves both readings alike."""
    bent = effect_class("encoder_nonlinearity")(velocity="apart")
    none = {"encoder_nonlinearity": 0.0, "encoder_nonlinearity_phase": 0.0}
    none |= {"velocity_time_constant": lag, "velocity_filter_shape": 1 / 3}
    sound = with_chain(load_model("paper")).with_effect(bent).with_values(none)
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:2]
    engine = WindowResiduals(planned_suite(sound, runs), windows=18)
    reduction = Reduction(engine)
    coordinates = base_coordinates(sound, engine.joints, reduction.moving)
    at = coordinates.start.copy()
    for i, entry in enumerate(coordinates.entries):
        at[i] = none.get(entry.parameter, at[i])
    linear = reduction.linearise(coordinates, at)

    def change(model: RobotModel) -> np.ndarray:
        """Root mean square of how much rows change [units or noise], ``[joint, kind]``."""
        rows = [
            reduction.reduce(linear.reducers, reduction.errors(one, one.tensors(engine.joints), 1))[0]
            for one in (sound, model)
        ]
        off = rows[1] - rows[0]
        return np.stack([np.sqrt(np.square(off[..., reduction.kinds == kind]).mean((1, 2))) for kind in range(6)], 1)

    knee = LEG_JOINTS.index("r_knee")
    judged = list(reduction.joint_indices).index(knee)
    bends = change(sound.with_values({"encoder_nonlinearity": Estimate(0.0, joints={"r_knee": 0.05})}))
    rubs = change(sound.with_values({"coulomb_friction": 1.5 * sound.value("coulomb_friction")}))
    assert bends[judged, 4] > 1.0
    assert np.delete(bends[:, 4], judged).max() < 0.1 * bends[judged, 4]
    assert rubs[:, 0].max() > 1.0
    assert rubs[:, 4].max() < 0.3


def test_values_that_hardly_differ_between_joints_are_fitted_like_a_shared_value():
    """The same resolution of torques, the same unreliable windows, and a common factor in place of the value."""
    shared, logs = with_chain(load_model("paper")), planned_suite(load_model("paper"), leg_suite(3, 2.5)[:1])
    names = ("armature", "coulomb_friction", "stribeck_velocity", "viscous_friction")
    own = {
        name: Estimate(
            shared.value(name), joints={j: shared.value(name) * (1 + 1e-6 * k) for k, j in enumerate(LEG_JOINTS)}
        )
        for name in names
    }
    fits = []
    for model in (shared, shared.with_values(own)):
        reduction = Reduction(WindowResiduals(logs, windows=8))
        coordinates = base_coordinates(model, reduction.engine.joints, reduction.moving)
        linear = reduction.linearise(coordinates, coordinates.start)
        kinds = {entry.parameter: entry.kind for entry in coordinates.entries if entry.joints is None}
        fits.append((np.concatenate(linear.variance), reduction.rows(linear).variance, kinds))
    (torques, rows, _), (other_torques, other_rows, kinds) = fits
    assert [kinds[name] for name in names] == ["scale"] * len(names)
    assert other_torques == pytest.approx(torques, rel=1e-2)
    unreliable = np.isfinite(rows) & (rows > 2 * np.median(rows))
    assert np.median(other_rows[unreliable] / rows[unreliable]) == pytest.approx(1.0, abs=0.1)


def test_a_stribeck_velocity_cannot_vanish():
    """A fit that reached zero would not return, because Stribeck friction has no influence there."""
    model = load_model("paper")
    coordinates = base_coordinates(with_chain(model), LEG_JOINTS)
    (entry,) = [entry for entry in coordinates.entries if entry.parameter == "stribeck_velocity"]
    known = model.parameters()["stribeck_velocity"]
    assert (entry.low, entry.high) == pytest.approx((known.low / 1.25, 1.25 * known.high))


def test_a_limb_that_moves_alone_is_simulated_alone():
    """Of a robot of several limbs, with values joint by joint."""
    model = with_chain(load_model("paper"))
    log = simulate_motion(model, chirp({"l_knee": 0.3}, duration=3.0, robot="op3"), mount="stand")
    engine = WindowResiduals([log], windows=4)
    reduction = Reduction(engine)
    (error,) = reduction.errors(model, model.tensors(engine.joints), 1)
    assert [engine.joints[joint] for joint in reduction.joint_indices] == [
        joint.replace("r_", "l_", 1) for joint in LEG_JOINTS
    ]
    assert np.isfinite(error).all()
