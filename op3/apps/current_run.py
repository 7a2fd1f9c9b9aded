"""The current run: folder, command, provenance of its numbers, logging, and result."""

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps import COMMANDS
from op3.apps.command_result import CommandResult
from op3.apps.fields import plain
from op3.common.assets import find_model
from op3.common.private import CLAIMED, scrub
from op3.common.wandb_settings import WandbSettings

Made = TypeVar("Made", bound=CommandResult)


def output_folder() -> Path:
    """The folder of this run."""
    return Path(HydraConfig.get().runtime.output_dir)


def reported(kind: type[Made], values: Mapping[str, Any], objective: str | None = None, **more: Any) -> Made:
    """The result of a command, built from the numbers published on its page.

    Args:
        kind: class of the result.
        values: the published numbers, see `op3.report.result.publish`.
        objective: key of the number that a sweep optimises.
        more: further fields of the result.
    """
    known = {"folder": output_folder(), "objective": None if objective is None else values[objective]}
    return kind(headline=values["headline"], numbers=values, **{**known, **more})


def by_name(overrides: Sequence[str]) -> dict[str, str]:
    """Overrides as a mapping."""
    return {name: value for name, _, value in (each.partition("=") for each in overrides)}


def command_of_run() -> str:
    """The command with overrides that reproduces this run."""
    hydra = HydraConfig.get()
    names = {app: ["op3", *command.split()] for command, app in COMMANDS.items() if command != "demo"}
    given = [*hydra.overrides.task, *(word for word in hydra.overrides.hydra if "sweeper" in word)]
    words = [word for word in given if word != os.environ.get(CLAIMED)]
    start = names.get(hydra.job.name, ["python", f"experiments/{hydra.job.name}.py"])
    return scrub(shlex.join([*start, *words]))


def model_artifact(cfg: DictConfig) -> list[tuple[str, Path]]:
    """The config's model file as an input artifact of the run; empty if the robot's own model is used."""
    return [("model", find_model(cfg.model))] if cfg.get("model") else []


def wandb_of(cfg: DictConfig) -> WandbSettings:
    """The settings of wandb; the default name is the task or command and the seed, such as ``balance-s0``."""
    wandb = WandbSettings.of(plain(cfg.get("wandb", "disabled")))
    choices = HydraConfig.get().runtime.choices
    what = choices.get("task") if "train" in HydraConfig.get().job.name else HydraConfig.get().job.name
    return wandb if wandb.name else replace(wandb, name=f"{what}-s{cfg.get('seed', 0)}")


def provenance(cfg: DictConfig, data: Any = None) -> dict[str, Any]:
    """Provenance of this run's numbers."""
    from op3.report import run_provenance

    return {**run_provenance(seed=cfg.seed, data=data), "command": command_of_run()}
