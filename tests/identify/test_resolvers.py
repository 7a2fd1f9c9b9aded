"""Interpolations of configs: what is searched follows the model."""

import pytest
from omegaconf import OmegaConf

from op3.identify.registration import register

OFFSET = "encoder_offset@length=7e-2"


def resolved(model: str, text: str):
    register()
    return OmegaConf.create({"model": model, "x": text}).x


@pytest.mark.parametrize(
    ("model", "name", "searched"),
    [
        ("sts3032", "backward_efficiency", True),
        ("rhoban_m6", "backward_efficiency", False),
        ("rhoban_m6", "motor_friction", True),
        ("sts3032", OFFSET, True),
        ("sts3032", "encoder_offset", False),  # it has an offset for every length instead
        ("rhoban_m6", OFFSET, False),
        ("rhoban_m6", "encoder_offset", True),
    ],
)
def test_a_model_is_searched_for_its_own_parameters(model, name, searched):
    """A range where the model has the parameter, under the conditions that it has; otherwise null."""
    assert resolved(model, f"${{own:'{name}',-0.3,0.3}}") == ("interval(-0.3, 0.3)" if searched else None)


def test_values_under_conditions_are_read():
    """The start of a parameter under a condition is the model's; without one, the shared value."""
    assert resolved("sts3032", f"${{value:'{OFFSET}'}}") == 0.12
    assert resolved("rhoban_m1", f"${{value:'{OFFSET}'}}") == 0.12
