"""``effect=[name]`` switches any effect on and searches its parameters; a group of that name only searches them."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from op3.identify.resolvers import register
from op3.identify.search_space import parse_search_space
from op3.identify.sweeper import sweep_or_report
from op3.servo import catalogue, parameter

CONF = Path(__file__).resolve().parents[2] / "conf"
NAMES = sorted(set(catalogue()) - {"motor", "current_pd"})
register()
assert sweep_or_report  # its module makes the sweeper known to Hydra


def composed(*overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("identify", ["data=none", *overrides], return_hydra_config=True)


@pytest.mark.parametrize("name", NAMES)
def test_effect_is_switched_on_and_searched(name):
    """The config brings the effect, start values within the ranges, and ranges that the sweeper understands."""
    cfg = composed(f"effect=[{name}]", "groups=[motor]")
    assert name in cfg.effects
    own = {p.name for p in catalogue()[name].parameters}
    assert catalogue()[name].size in cfg.parameters or name == "dte"
    space = parse_search_space(OmegaConf.to_container(cfg.hydra.sweeper.params, resolve=True))
    for key in own & set(cfg.parameters):
        assert parameter(key).low <= cfg.parameters[key] <= parameter(key).high
        assert f"parameters.{key}" in space


def test_every_parameter_with_a_neutral_value_can_be_searched():
    """Some group has it, or some effect's config."""
    searched = set()
    for name in NAMES:
        searched |= set(composed(f"effect=[{name}]", "groups=[motor]").parameters)
    for path in (CONF / "groups").glob("*.yaml"):
        searched |= set(composed(f"groups=[{path.stem}]").parameters)
    wanted = {p.name for e in catalogue().values() for p in e.parameters if p.neutral is not None}
    assert wanted - searched <= {"forward_efficiency"}  # fixed at 1 in the paper
