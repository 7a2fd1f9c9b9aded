"""Reads the settings of a study from `hydra.sweeper` in Hydra's config."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from op3.identify.search_space import SearchSpace, StudyError, check_nominal, parse_search_space
from op3.identify.study import StudySettings
from op3.identify.sweeper_conf import PopulationSweeperConf
from op3.servo.conditions import JOINT

STORAGE_FILE = "study.journal"


def read_settings(config: DictConfig, sweeper: DictConfig, folder: Path, cell: str = "") -> StudySettings:
    """Read the settings of a study.

    Args:
        config: the composed config, whose values are the nominal parameters.
        sweeper: its node `hydra.sweeper`.
        folder: folder of the run or cell, for the default storage.
        cell: overrides of the grid cell, which distinguish its study from others.
    """
    if OmegaConf.select(sweeper, "_target_") != PopulationSweeperConf._target_:
        raise StudyError(
            "The config does not choose this sweeper: add `- override hydra/sweeper: population` to its defaults."
        )
    plain = OmegaConf.to_container(sweeper, resolve=True)
    assert isinstance(plain, dict)
    search_space = search_space_of(plain)
    values = {key: _config_value(config, key.partition(f"@{JOINT}=")[0]) for key in search_space}
    directions: Any = [plain["direction"]] if isinstance(plain["direction"], str) else plain["direction"]
    storage, name = plain["storage"], plain["study_name"] or "study"
    return StudySettings(
        search_space=search_space,
        nominal=check_nominal(search_space, values) if plain["nominal"] else None,
        sampler=plain["sampler"],
        directions=directions,
        storage=_storage_address(storage, folder),
        study_name=f"{name}/{cell}" if storage and cell else name,
        **{key: plain[key] for key in ("n_trials", "population", "parallel_populations", "seed", "starts", "worker")},
    )


def search_space_of(sweeper: Mapping[Any, Any]) -> SearchSpace:
    """Searched ranges by config key: the ranges in `params`, and the ranges in `each` for every label.

    Args:
        sweeper: the resolved node `hydra.sweeper`.
    """
    space, each = parse_search_space(sweeper["params"]), sweeper.get("each") or {}
    for key in each:
        if key not in space:
            raise StudyError(f"{key} is listed in per_joint but not searched: add its group, or omit it there.")
    labels = {key: [f"{key}@{JOINT}={label}" for label in each[key]] if key in each else [key] for key in space}
    return {name: distribution for key, distribution in space.items() for name in labels[key]}


def _config_value(config: DictConfig, key: str) -> Any:
    missing = object()
    try:
        value = OmegaConf.select(config, key, default=missing, throw_on_missing=False)
    except OmegaConfBaseException as error:
        raise StudyError(f"{key}: its value in the config is invalid ({error}).") from error
    if value is missing:
        raise StudyError(
            f"{key}: hydra.sweeper.params names a key that the config does not have: "
            "correct the name, or add the key with its nominal value."
        )
    return value


def _storage_address(storage: str | None, folder: Path) -> str:
    if storage is None:
        return str(folder.absolute() / STORAGE_FILE)
    return storage if "://" in storage else to_absolute_path(storage)
