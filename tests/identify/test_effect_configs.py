"""``effect=[name]`` switches any effect on and searches its parameters; a group of that name only searches them."""

import pytest
from omegaconf import OmegaConf

from op3.apps import job
from op3.identify.search_groups import TABLE_ONE, searched_parameters
from op3.identify.search_space import parse_search_space
from op3.servo import parameter


def composed(*overrides: str):
    return job.composed("identify", ["data=none", *overrides], hydra=True)


@pytest.mark.parametrize("name", searched_parameters())
def test_effect_is_switched_on_and_searched(name):
    """The config brings the effect, start values within the ranges, and ranges that the sweeper understands."""
    cfg = composed(f"effect=[{name}]", "groups=[motor]")
    assert name in cfg.effects
    space = parse_search_space(OmegaConf.to_container(cfg.hydra.sweeper.params, resolve=True))
    for key in searched_parameters()[name]:
        assert parameter(key).low <= cfg.parameters[key] <= parameter(key).high
        assert f"parameters.{key}" in space


def test_a_group_searches_without_switching_on():
    """Of an effect, or of the paper's Table I."""
    cfg = composed("groups=[backlash,friction]")
    assert set(cfg.parameters) == {"backlash_half_gap", *TABLE_ONE["friction"]}
    assert not cfg.effects
