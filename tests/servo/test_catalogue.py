"""The catalogue: names, neutral values, and the robot model made of it."""

import pytest
import torch

from op3.servo import Estimate, RobotModel, Stage, catalogue, effect_class, parameter, register
from op3.servo.effect import Effect, Parameter
from op3.servo.effects import Coulomb, CurrentPD, DirectionalEfficiency, Motor


@pytest.mark.parametrize("name", catalogue())
def test_every_effect_describes_itself(name):
    """Each effect states its equation, source and documented parameters with sensible ranges."""
    effect = effect_class(name)
    assert effect.equation
    assert effect.source
    assert effect.__doc__
    assert isinstance(effect.stage, Stage)
    for p in effect.parameters:
        assert p.low < p.high
        assert p.low <= p.nominal <= p.high
        assert p.unit
        assert p.text


def test_unknown_names_list_the_known_ones():
    """A misspelt effect or parameter is answered with what there is."""
    with pytest.raises(ValueError, match="coulomb"):
        effect_class("coulom")
    with pytest.raises(ValueError, match="torque_constant"):
        parameter("kt")


def test_a_taken_parameter_name_is_refused():
    """Two effects cannot own one parameter name."""

    class Clash(Effect):
        name = "clash"
        stage = Stage.FRICTION
        equation = source = "-"
        parameters = (Parameter("coulomb_friction", "N m", 0, 1, 0.5, 0, "taken"),)

    with pytest.raises(ValueError, match="coulomb_friction"):
        register(Clash)
    assert "clash" not in catalogue()


def model() -> RobotModel:
    return RobotModel((Coulomb(), Motor(), CurrentPD(), DirectionalEfficiency()))


def test_effects_run_in_stage_order_whatever_the_list():
    """The order of a model file does not matter."""
    assert model().effect_names == ("current_pd", "motor", "dte", "coulomb")


def test_values_of_effects_that_are_off_are_refused():
    """A value without its effect is a mistake, and the message says which effects are on."""
    with pytest.raises(ValueError, match=r"viscous_friction.*off.*coulomb"):
        model().with_values({"viscous_friction": 0.1})


def test_joints_may_differ():
    """Per-joint values reach their columns; the others share one value."""
    changed = model().with_values({"coulomb_friction": Estimate(0.1, joints={"b": 0.3})})
    row = changed.tensors(["a", "b"])["coulomb_friction"]
    torch.testing.assert_close(row, torch.tensor([[0.1, 0.3]], dtype=torch.float64))
    with pytest.raises(ValueError, match="unknown joint 'b'"):
        changed.tensors(["a", "c"])


def test_switching_an_effect_off_forgets_its_values():
    """Without DTE there are no efficiencies; an effect that is off cannot be switched off."""
    without = model().with_values({"backward_efficiency": 0.7}).without("dte")
    assert "backward_efficiency" not in without.parameters()
    with pytest.raises(ValueError, match="dte"):
        without.without("dte")
