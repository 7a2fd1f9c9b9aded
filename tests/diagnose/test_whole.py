"""A diagnosis from logs to verdict: a leg with a strong effect, and the same leg without."""

import numpy as np
import pytest

from op3.diagnose import Diagnosis, Settings, split_logs
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.robot.register_units import CURRENT_UNIT, POSITION_UNIT, VELOCITY_UNIT
from op3.rollout import Rollout
from op3.servo import Estimate, RobotModel
from op3.servo.effects import CableSpring
from op3.sim import load_model

UNITS = {"position": POSITION_UNIT, "velocity": VELOCITY_UNIT, "current": CURRENT_UNIT}


def logs_of(model: RobotModel) -> list[Rollout]:
    """A minute of a leg by MuJoCo, its readings rounded as the servos' registers round them, with a count of noise."""
    rng, result = np.random.default_rng(0), []
    for log in planned_suite(model, leg_suite(3, 3.0)):
        arrays = {key: log.array(key) for key in log.channels}
        for name, unit in UNITS.items():
            noisy = arrays["joint", name] + unit * rng.standard_normal(arrays["joint", name].shape)
            arrays["joint", name] = np.round(noisy / unit) * unit
        result.append(Rollout.from_arrays(arrays, log.metadata))
    return result


@pytest.mark.slow
@pytest.mark.parametrize("windows", [56, 40])
def test_a_strong_effect_is_found_in_its_joint_and_a_sound_leg_is_silent(windows):
    """A spring of 0.25 N m/rad at the knee: one finding, its size to a fifth, in the model; without it none."""
    sound = load_model("paper").with_effect(CableSpring(), {"cable_stiffness": 0.0, "cable_rest_angle": 0.0})
    springy = sound.with_values({"cable_stiffness": Estimate(0.0, joints={"r_knee": 0.25})})
    found = Diagnosis(load_model("paper"), split_logs(logs_of(springy)), settings=Settings(windows=windows)).run()
    (finding,) = [one for one in found.findings if one.probability > 0.5]
    assert (finding.effect, finding.joints) == ("cable_spring", ("r_knee",))
    assert finding.size == pytest.approx(0.25, rel=0.2)
    assert finding.interval[0] < 0.25 < finding.interval[1]
    assert "cable_spring" in found.model.effect_names
    assert found.windows is not None
    torque = found.windows.joints["r_knee"]["torque"]
    assert torque.returned < torque.baseline < torque.given
    quiet = Diagnosis(load_model("paper"), split_logs(logs_of(sound)), settings=Settings(windows=windows)).run()
    assert quiet.findings == ()
    assert quiet.verdict == "nothing_missing"
