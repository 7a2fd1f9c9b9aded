"""Config groups derived from the catalogue of effects, for ``effect=[name]`` and ``groups=[name]``.

``effect=[name]`` switches an effect on in the model and searches its parameters; ``groups=[name]`` only searches them,
for a model in which the effect is on. Both accept every effect that has parameters to search. Groups of the paper's
Table I combine parameters of several effects.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore

from op3.common.settings import read_yaml

TABLE_ONE: Mapping[str, Sequence[str]] = {
    "gear": ("backward_efficiency",),
    "friction": ("coulomb_friction", "viscous_friction", "static_friction_excess"),
    "body": ("base_mass_offset", "base_com_offset_x", "base_com_offset_z"),
    "stribeck_velocity": ("stribeck_velocity",),
}
"""Groups of the paper's Table I, plus the Stribeck velocity, which the table omits."""


SEARCHED = Path(__file__).with_name("searched_parameters.yaml")
"""File of the searched parameters of each effect, so that the catalogue need not be imported."""


def searched_parameters() -> dict[str, tuple[str, ...]]:
    """Searched parameters by effect name; a user's effects are included once the catalogue is imported."""
    if "op3.servo" not in sys.modules:
        return {name: tuple(names) for name, names in read_yaml(SEARCHED).items()}
    from op3.servo import catalogue

    searched = {name: tuple(p.name for p in effect.parameters if p.searched) for name, effect in catalogue().items()}
    return {name: names for name, names in searched.items() if names}


def search(names: Sequence[str]) -> dict[str, Any]:
    """The part of a config with the initial values and the sweeper's ranges of parameters."""
    return {
        "parameters": {name: f"${{start:{name}}}" for name in names},
        "hydra": {"sweeper": {"params": {f"parameters.{name}": f"${{range:{name}}}" for name in names}}},
    }


def register() -> None:
    """Register the groups with Hydra; repeated calls are harmless."""
    store, effects = ConfigStore.instance(), searched_parameters()
    for name, names in effects.items():
        store.store(group="effect", name=name, node={"effects": {name: {}}, **search(names)}, package="_global_")
    for name, names in {**effects, **TABLE_ONE}.items():
        store.store(group="groups", name=name, node=search(names), package="_global_")
