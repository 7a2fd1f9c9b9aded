"""Named models."""

import pytest

from op3.sim import find_model, load_model, model_names


@pytest.mark.parametrize("name", model_names())
def test_named_models_load(name):
    """Every model of ``assets/models`` is a valid model file."""
    assert load_model(name).effects
    assert load_model(find_model(name)) == load_model(name)


def test_unknown_models_are_answered_with_the_nearest_name_or_the_known_ones():
    """Neither a file nor a name."""
    with pytest.raises(FileNotFoundError, match="the nearest is 'paper'"):
        load_model("papr")
    with pytest.raises(FileNotFoundError, match="paper_without_dte"):
        load_model("xyz")
