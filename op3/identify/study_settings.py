"""The settings of a study: Hydra's config under `hydra.sweeper`, and what is read from it."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import optuna
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from op3.common.settings import Count, Listed, Whole, settings
from op3.identify.samplers import make_sampler_factory
from op3.identify.search_space import SearchSpace, StudyError, check_nominal, parse_search_space
from op3.identify.storage import open_storage
from op3.identify.study import Evaluate, run_study
from op3.identify.sweeper_conf import PopulationSweeperConf
from op3.servo.conditions import JOINT

STORAGE_FILE = "study.journal"


def _refused(field: str, wanted: str, given: Any) -> StudyError:
    return StudyError(f"hydra.sweeper: {field} must be {wanted}, got {given!r}.")


@settings("hydra.sweeper", _refused)
class StudySettings:
    """What one study needs, read from a composed config."""

    search_space: SearchSpace
    nominal: dict[str, Any] | None
    sampler: Any
    directions: Listed[str]
    storage: str
    study_name: str
    n_trials: Count
    population: Count
    parallel_populations: Count
    seed: Whole | None
    starts: Whole = 0
    worker: Whole = 0

    def check(self) -> None:
        """Find out before the first trial whether the sampler and the storage can be used."""
        make_sampler_factory(
            self.sampler,
            population=self.population * self.parallel_populations,
            directions=len(self.directions),
            nominal=self.nominal,
        )
        open_storage(self.storage)

    def run(
        self,
        evaluate: Evaluate,
        starts: Sequence[Mapping[str, Any]] = (),
        identity: Mapping[str, str] | None = None,
    ) -> optuna.Study:
        """Run the study, or go on with it, from these starts; see `run_study` for its identity."""
        given = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name != "parallel_populations"
        }
        given |= {"population": self.population * self.parallel_populations, "starts": starts}
        given["identity"] = identity
        return run_study(evaluate, **given)

    def split(self, population: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
        """Cut what was asked into the populations of single jobs."""
        return [population[i : i + self.population] for i in range(0, len(population), self.population)]


def read_settings(config: DictConfig, sweeper: DictConfig, folder: Path, cell: str = "") -> StudySettings:
    """Read the settings of a study.

    Args:
        config: the composed config, whose values are the nominal parameters.
        sweeper: its node `hydra.sweeper`.
        folder: folder of the run or cell, for the default storage.
        cell: overrides of the cell in an outer grid, which tell its study from its neighbours'.
    """
    if OmegaConf.select(sweeper, "_target_") != PopulationSweeperConf._target_:
        raise StudyError(
            "The config does not choose this sweeper: add `- override hydra/sweeper: population` to its defaults."
        )
    plain = OmegaConf.to_container(sweeper, resolve=True)
    assert isinstance(plain, dict)
    search_space = search_space_of(plain)
    values = {key: _config_value(config, key.partition(f"@{JOINT}=")[0]) for key in search_space}
    direction = plain["direction"]
    storage, name = plain["storage"], plain["study_name"] or "study"
    return StudySettings(
        search_space=search_space,
        nominal=check_nominal(search_space, values) if plain["nominal"] else None,
        sampler=plain["sampler"],
        directions=(direction,) if isinstance(direction, str) else tuple(direction),
        storage=_storage_address(storage, folder),
        study_name=f"{name}/{cell}" if storage and cell else name,
        **{key: plain[key] for key in ("n_trials", "population", "parallel_populations", "seed", "starts", "worker")},
    )


def search_space_of(sweeper: Mapping[Any, Any]) -> SearchSpace:
    """What is searched, by config key: the ranges of `params`, those of `each` once for every label.

    Args:
        sweeper: the resolved node `hydra.sweeper`.
    """
    space, each = parse_search_space(sweeper["params"]), sweeper.get("each") or {}
    for key in each:
        if key not in space:
            raise StudyError(f"{key} is listed in per_joint, but is not searched: add its group, or leave it out.")
    labels = {key: [f"{key}@{JOINT}={label}" for label in each[key]] if key in each else [key] for key in space}
    return {name: distribution for key, distribution in space.items() for name in labels[key]}


def _config_value(config: DictConfig, key: str) -> Any:
    missing = object()
    try:
        value = OmegaConf.select(config, key, default=missing, throw_on_missing=False)
    except OmegaConfBaseException as error:
        raise StudyError(f"{key}: cannot be read from the config ({error}).") from error
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
