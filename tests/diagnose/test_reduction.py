"""What windows are reduced to: rates, which mechanics leave alone and a bent encoder does not."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from op3.diagnose import WindowResiduals
from op3.diagnose.coordinates import base_coordinates, with_chain
from op3.diagnose.features import FLOORS, PIECES, rates
from op3.diagnose.reduction import Reduction
from op3.robot import leg_suite
from op3.servo import Estimate, RobotModel, effect_class
from op3.sim import load_model
from op3.tasks.planned import planned_suite
from tests.op3_table import LEG_JOINTS


@given(st.integers(8, 60), st.lists(st.floats(-5.0, 5.0), min_size=61, max_size=61), st.floats(0.002, 0.02))
def test_whatever_a_joint_does_its_velocity_is_the_rate_of_its_angle(ticks, velocities, period):
    """Angles by the trapezoidal rule from any velocities, both whitened, give the same mean in every piece."""
    velocity = np.array(velocities[: ticks + 1])
    angle = period * np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2)])
    read, moved = rates(ticks, period)
    assert read.shape == moved.shape == (PIECES - 1, ticks + 1)
    whitened = velocity / FLOORS["joint", "velocity"], angle / FLOORS["joint", "position"]
    np.testing.assert_allclose(read @ whitened[0], moved @ whitened[1], atol=1e-8)


def test_rates_show_an_encoder_that_bends_and_no_friction():
    """A motor's own sensor tells the velocity of a joint whose encoder bends; friction moves both readings alike."""
    bent = effect_class("encoder_nonlinearity")(velocity="apart")
    none = {"encoder_nonlinearity": 0.0, "encoder_nonlinearity_phase": 0.0, "velocity_time_constant": 0.0}
    sound = with_chain(load_model("paper")).with_effect(bent).with_values(none)
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:2]
    engine = WindowResiduals(planned_suite(sound, runs), windows=18)
    reduction = Reduction(engine)
    coordinates = base_coordinates(sound, engine.joints, reduction.moving)
    linear = reduction.linearise(coordinates, coordinates.start)

    def change(model: RobotModel) -> np.ndarray:
        """Root mean square of how much rows change [units or noise], ``[joint, kind]``."""
        rows = [
            reduction.reduce(linear.reducers, reduction.errors(one, one.tensors(engine.joints), 1))[0]
            for one in (sound, model)
        ]
        off = rows[1] - rows[0]
        return np.stack([np.sqrt(np.square(off[..., reduction.kinds == kind]).mean((1, 2))) for kind in range(6)], 1)

    knee = LEG_JOINTS.index("r_knee")
    judged = list(reduction.judged).index(knee)
    bends = change(sound.with_values({"encoder_nonlinearity": Estimate(0.0, joints={"r_knee": 0.05})}))
    rubs = change(sound.with_values({"coulomb_friction": 1.5 * sound.value("coulomb_friction")}))
    assert bends[judged, 4] > 1.0
    assert np.delete(bends[:, 4], judged).max() < 0.1 * bends[judged, 4]
    assert rubs[:, 0].max() > 1.0
    assert rubs[:, 4].max() < 0.3
