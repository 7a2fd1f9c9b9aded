"""Configs and catalogue agree."""

from pathlib import Path

import pytest
import yaml

from op3.servo import catalogue, effect_class
from op3.sim import find_model, load_model, model_names

CONF = Path(__file__).resolve().parents[2] / "conf"
ALWAYS_ON = {"motor", "current_pd"}


def test_every_effect_has_a_config_and_every_config_an_effect():
    """What can be switched on is switched on by ``effect=[name]``."""
    files = {path.stem for path in (CONF / "effect").glob("*.yaml")}
    assert files == set(catalogue()) - ALWAYS_ON


@pytest.mark.parametrize("path", sorted((CONF / "effect").glob("*.yaml")), ids=lambda p: p.stem)
def test_effect_configs_search_their_own_parameters(path):
    """The parameters that a config brings in are those of its effect."""
    content = yaml.safe_load(path.read_text())
    assert list(content["effects"]) == [path.stem]
    own = {p.name for p in effect_class(path.stem).parameters}
    assert set(content.get("parameters", {})) <= own


@pytest.mark.parametrize("name", model_names())
def test_named_models_load(name):
    """Every model of ``conf/servo`` is a valid model file."""
    assert load_model(name).effects
    assert load_model(find_model(name)) == load_model(name)


def test_unknown_models_are_answered_with_the_known_names():
    """Neither a file nor a name."""
    with pytest.raises(FileNotFoundError, match="paper_without_dte"):
        load_model("papr")
