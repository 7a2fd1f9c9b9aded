"""Registers the sweeper, effect groups, motions and interpolations with Hydra for use in configs.

The library is not imported until an interpolation is resolved.
"""

from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from op3.common.assets import config_variants
from op3.identify import search_groups
from op3.identify.sweeper_conf import PopulationSweeperConf

INTERPOLATIONS = ("range", "value", "start", "own", "each_joint")
"""Interpolations of `op3.identify.resolvers`."""


def register() -> None:
    """Register everything with Hydra and OmegaConf; repeated calls are harmless."""
    ConfigStore.instance().store(group="hydra/sweeper", name="population", node=PopulationSweeperConf, provider="op3")
    search_groups.register()
    for place, entries in config_variants().items():
        group, _, package = place.partition("@")
        for name, node in entries.items():
            ConfigStore.instance().store(group=group, name=name, node=node, package=package or None, provider="op3")
    for name in INTERPOLATIONS:
        OmegaConf.register_new_resolver(name, _resolver(name), replace=True)
    OmegaConf.register_new_resolver("stem", lambda path: Path(path).stem, replace=True)


def _resolver(name: str) -> Any:
    def resolve(*arguments: Any, _root_: DictConfig) -> Any:
        from op3.identify import resolvers

        return getattr(resolvers, f"{name}_of")(*arguments, _root_=_root_)

    return resolve
