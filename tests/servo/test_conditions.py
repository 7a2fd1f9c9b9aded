"""Parameters that hold under a condition of the recording."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.servo import Estimate, RobotModel
from op3.servo.conditions import Condition, split_name
from op3.servo.effects import Coulomb, EncoderOffset
from op3.sim import load_model, save_model

AT_70_MM = "encoder_offset@length=7e-2"


def model() -> RobotModel:
    return RobotModel((EncoderOffset(), Coulomb())).with_values(
        {"encoder_offset": 0.1, AT_70_MM: Estimate(0.16, 0.1, 0.2)}
    )


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_names_of_numbers_have_no_dot_and_lose_nothing(value):
    """A condition's text goes into config keys, which are split at dots, and is read back exactly."""
    name = f"encoder_offset@{Condition('length', value)}"
    assert "." not in name
    assert split_name(name) == ("encoder_offset", Condition("length", value))


def test_names_of_texts():
    """A field may hold text; a name without condition is the parameter."""
    assert split_name("armature@servo=xl330") == ("armature", Condition("servo", "xl330"))
    assert split_name("armature") == ("armature", None)


@pytest.mark.parametrize(
    "name", ["a@length=7e-2@joint=servo", "encoder_offset@", "encoder_offset@length", "encoder_offset@=3", "@length=3"]
)
def test_half_a_condition_is_refused(name):
    """The message says how a name with a condition is written."""
    with pytest.raises(ValueError, match="field of the metadata"):
        split_name(name)


def test_a_condition_that_holds_goes_before_the_shared_value():
    """Under the condition its own value counts, otherwise the shared one."""
    assert model().under({"length": 0.07}).value("encoder_offset") == 0.16
    assert model().under({"length": 0.05}).value("encoder_offset") == 0.1
    assert model().estimate(AT_70_MM) == Estimate(0.16, 0.1, 0.2)
    assert model().estimate("encoder_offset@length=5e-2").value == 0.1


def test_a_field_that_logs_do_not_have_is_refused():
    """A misspelt field would otherwise never hold, in silence."""
    with pytest.raises(ValueError, match=r"lenght.*mass"):
        model().with_values({"coulomb_friction@lenght=7e-2": 0.1}).under({"mass": 1.0, "length": 0.07})


def test_conditions_survive_the_model_file(tmp_path):
    """What is written is read back, intervals and all."""
    again = load_model(save_model(model(), tmp_path / "model.yaml"))
    assert again.estimates["encoder_offset"] == model().estimates["encoder_offset"]


def test_a_joint_has_its_own_value_and_interval(tmp_path):
    """A value for one joint counts in all logs, for that joint; its interval is kept, also by the file."""
    knee = load_model("paper").with_values(
        {"coulomb_friction": 0.1, "coulomb_friction@joint=l_knee": Estimate(0.2, 0.15, 0.25)}
    )
    knee = knee.with_values({"coulomb_friction@joint=r_knee": 0.12})
    again = load_model(save_model(knee, tmp_path / "model.yaml"))
    for each in (knee, again):
        assert each.tensors(("l_hip_pitch", "l_knee", "r_knee"))["coulomb_friction"].tolist() == [[0.1, 0.2, 0.12]]
        assert each.estimate("coulomb_friction@joint=l_knee") == Estimate(0.2, 0.15, 0.25)
        assert each.estimate("coulomb_friction@joint=r_knee") == Estimate(0.12)
        assert each.estimate("coulomb_friction@joint=l_hip_pitch") == Estimate(0.1)
    assert (
        knee.with_values({"coulomb_friction@joint=l_knee": 0.2}).estimate("coulomb_friction@joint=l_knee").low is None
    )
    with pytest.raises(ValueError, match="is above its upper end"):
        knee.with_values({"coulomb_friction@joint=l_knee": Estimate(0.2, 0.25, 0.15)})
    both = knee.with_values({"coulomb_friction@joint=l_knee": 0.3, "coulomb_friction": 0.1})
    assert both.estimate("coulomb_friction@joint=l_knee") == Estimate(0.3)
