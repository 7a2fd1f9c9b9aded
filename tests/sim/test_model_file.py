"""``model.yaml``: written and read without loss, refused with a sentence."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.servo import Estimate, RobotModel
from op3.servo.effects import Coulomb, CurrentPD, DirectionalEfficiency, Latency, Motor, PositionServo, Stribeck
from op3.sim import load_model, model_hash, save_model
from op3.sim.model_file import from_dict, to_dict

number = st.floats(0, 1, allow_nan=False)
estimates = st.builds(
    Estimate,
    number,
    st.none() | st.floats(-10, 0),
    st.none() | st.floats(0, 10),
    st.dictionaries(st.sampled_from(["l_knee", "r_knee"]), number),
)


@given(estimates, estimates, st.sampled_from(["passive", "printed"]), st.floats(5, 15))
def test_dictionaries_round_trip(friction, efficiency, form, voltage):
    """Effects, options, values, intervals and per-joint values survive writing and reading."""
    model = RobotModel(
        (CurrentPD(2.0), Motor(gear_ratio=200.0), DirectionalEfficiency(form=form), Coulomb()),
        {"coulomb_friction": friction, "backward_efficiency": efficiency},
        bus_voltage=voltage,
    )
    again = from_dict(to_dict(model))
    assert again.effects == model.effects
    assert again.estimates["coulomb_friction"] == friction
    assert again.estimates["backward_efficiency"] == efficiency
    assert again.bus_voltage == voltage
    assert model_hash(again) == model_hash(model)


def test_files_round_trip(tmp_path):
    """A saved model loads again with its provenance; the hash does not depend on the provenance."""
    model = RobotModel((Motor(), Latency(signal="goal"), PositionServo()), provenance={"data": ["a"], "seed": 3})
    loaded = load_model(save_model(model, tmp_path / "model.yaml"))
    assert loaded.effects == model.effects
    assert loaded.provenance == {"data": ["a"], "seed": 3}
    assert model_hash(loaded) == model_hash(RobotModel(model.effects))
    assert load_model(tmp_path).effects == model.effects


GOOD = "format: op3-model/1\nbus_voltage: 11.1\neffects:\n  - motor: {torque_constant: 0.006}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format: op3-model/1\neffects: [", "not valid YAML"),
        ("effects: []", "format"),
        (GOOD.replace("op3-model/1", "op3-model/9"), "format"),
        ("format: op3-model/1\neffects: []", "effects"),
        (GOOD + "  - motr: {}\n", "unknown effect 'motr'"),
        (GOOD + "  - coulomb: {friction: 0.1}\n", "coulomb_friction"),
        (GOOD + "  - motor: {}\n", "listed twice"),
        (GOOD.replace("0.006", "big"), "motor.torque_constant.*finite number"),
        (GOOD.replace("0.006", "{low: 1}"), "motor.torque_constant"),
        (GOOD.replace("11.1", "yes"), "bus_voltage"),
        (GOOD + "colour: red\n", "colour"),
        (GOOD.replace("0.006", ".inf"), "finite number"),
        (GOOD.replace("torque_constant: 0.006", "terminal_resistance: -1.0"), "terminal_resistance must be at least"),
        (GOOD.replace("torque_constant: 0.006", "drive: volt"), "drive must be one of current, voltage"),
        (GOOD.replace("torque_constant: 0.006", "gear_ratio: '353'"), "gear_ratio must be a finite number"),
        (GOOD + "  - dte: {form: pasive}\n", "form must be one of passive, printed"),
        (GOOD + "  - dte: {backward_efficiency: 1.7}\n", "between 0 and 1"),
        (GOOD.replace("0.006", "{value: 0.006, low: 0.5, high: 0.2}"), "lower end 0.5 is above its upper end 0.2"),
        (GOOD + "  - {coulomb: {}, viscous: {}}\n", "effects"),
    ],
)
def test_bad_files_are_refused_by_name_and_field(tmp_path, text, message):
    """One sentence with the file, the field and what belongs there."""
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        load_model(path)
    assert "broken.yaml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_bodies_are_no_servo_model(tmp_path):
    """An exported MJCF among them."""
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    with pytest.raises(ValueError, match="describes bodies, not a servo model"):
        load_model(tmp_path / "arm.xml")


def test_options_at_their_default_do_not_change_the_hash():
    """The hash is that of a model whose effects have no such option; another choice shows."""
    model = load_model("paper")
    plain = model_hash(model)
    assert model_hash(model.without("stribeck").with_effect(Stribeck(fade="gaussian"))) != plain
    written = to_dict(model)
    for named in written["effects"]:
        named.get("stribeck", {}).pop("fade", None)
    assert model_hash(from_dict(written)) == plain
