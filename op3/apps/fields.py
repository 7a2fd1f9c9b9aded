"""Checks of config fields, made before the libraries of a command are imported."""

import dataclasses
import glob
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from op3.common.assets import config_file, find_model, here_or_shipped, model_names, robot_file
from op3.common.settings import (
    GAIN_HIGH,
    Count,
    Gain,
    Listed,
    Named,
    NotNegative,
    Positive,
    Some,
    Text,
    Whole,
    nearest,
    read_yaml,
    settings,
    shown,
)
from op3.common.wandb_settings import WandbSettings


@settings()
class Common:
    """Fields with the same meaning in every command."""

    seed: Whole = 0
    world_seed: Whole = 0
    threads: Whole = 0
    processes: Whole = 0
    number: Whole = 0
    rounds: Whole = 0
    baud: Count = 1
    card_robots: Count = 1
    repeats: Count = 1
    environments: Count = 1
    finalists: Count = 1
    windows: Count | None = None
    model: Text | None = None
    robot: Text | None = None
    plan: Text | None = None
    resume: Text | None = None
    runs: Text = ""
    joint: Text | None = None
    out: Text | None = None
    joints: Some[str] | None = None
    ablate: Listed[str] = ()
    per_joint: Listed[str] = ()
    without: Listed[str] = ()
    wanted: Listed[str] | None = None
    motions: Some[str] | None = None
    mounts: Some[Literal["floor", "stand"]] | None = None
    hidden_robot: Literal["leg", "pendulum", "op3", "arm"] = "leg"
    severity: Literal["mild", "clear", "strong"] = "strong"
    grounds: Some[str] | None = None
    fixed_gains: Listed[Gain] = ()
    where: Named[Any] | None = None
    weights: Named[Any] | None = None
    heldout_where: Named[Any] | None = None
    overhead: NotNegative = 1.0
    mount_change: NotNegative = 1.0
    cycle: Positive | None = None
    duration: Positive | None = None
    seconds: Positive = 1.0
    speed: Positive = 1.0
    span: Positive = 1.0
    initial_gain: Gain = 1.0
    fixed_gain: Gain | None = None
    hold_gain: Gain = 1.0
    p_gain: Annotated[NotNegative, Field(le=GAIN_HIGH)] | None = None
    d_gain: NotNegative | None = None
    gain_scale: Positive = 1.0
    bench_timestep: Positive = 1.0
    latency_timer: Positive = 1.0

    @classmethod
    def of(cls, cfg: DictConfig) -> "Common":
        """The common fields that are present and set in the config."""
        names = [field.name for field in dataclasses.fields(cls) if field.name in cfg]
        return cls(**{name: cfg[name] for name in names if not OmegaConf.is_missing(cfg, name)})


KINDS = {
    dict: (Mapping, "a mapping of its fields"),
    str: (str | None, "text"),
    bool: (bool, "true or false"),
    int: (int | float, "a number"),
    float: (int | float, "a number"),
}
"""Allowed types of a setting and their name in messages, by the type of its default."""

LOGS = ("data", "heldout", "episodes", "actual", "log", "diagnosis")
"""Fields whose text values are paths of logs."""

BASELINES = ("hold", "zero", "random", "stiff")
"""Names of policies that are not bundles."""

REQUIRED = {
    "data": "a log, a folder of logs, or a list of them",
    "policy": "the folder of a policy bundle",
    "episodes": "a folder of logs of the policy's episodes",
    "model": "a model.yaml or a name in assets/models",
    "runs": "the folder of a multirun of op3 identify",
    "what": "a log, a policy bundle, a model.yaml, a robot file or the run of a diagnosis",
    "robot": "a name in assets/robots or a robot file",
}
"""Meaning of required fields."""


def check(cfg: DictConfig) -> None:
    """Raise an error for a missing field, a wrong type, a value out of range or an unknown name.

    Raises:
        ValueError: one sentence that names the field and its valid values.
        FileNotFoundError: if the model is neither a file nor a name.
    """
    for name in (name for name in REQUIRED if not OmegaConf.is_missing(cfg, name) and cfg.get(name) == ""):
        raise ValueError(f"{name} is empty: give {REQUIRED[name]}")
    Common.of(cfg)
    if "wandb" in cfg:
        WandbSettings.of(plain(cfg.wandb))
    defaults = read_yaml(config_file(HydraConfig.get().job.config_name or ""))
    for name, default in defaults.items():
        kind, wanted = KINDS.get(type(default), (object, ""))
        open_ended = isinstance(default, str) and re.match(r"\$\{|\?\?\?", default)
        if name in cfg and not open_ended and not isinstance(cfg[name], kind):
            raise ValueError(f"{name} must be {wanted}, got {shown(plain(cfg[name]))}")
    for name, what in REQUIRED.items():
        if name == "data" and cfg.get("planned"):
            continue
        if OmegaConf.is_missing(cfg, name):
            raise ValueError(f"{name} is missing: add {name}=<{what}>")
        if defaults.get(name) == "???" and not isinstance(plain(cfg[name]), str | list):
            raise ValueError(f"{name} must be {what}, got {shown(plain(cfg[name]))}")
    for name in LOGS:
        value = None if OmegaConf.is_missing(cfg, name) else cfg.get(name)
        if isinstance(value, str) and not (glob.has_magic(value) or glob.glob(value)):
            raise ValueError(f"{name}={value}: there is no such file or folder; correct the path")
    baselines = BASELINES if "baseline" in cfg else ()  # then the policy may be a baseline too
    for name, known in {"policy": baselines, "baseline": baselines, "what": model_names()}.items():
        value = None if OmegaConf.is_missing(cfg, name) or cfg.get("live") else cfg.get(name)
        if isinstance(value, str) and value not in known and not here_or_shipped(value).exists():
            meaning = ", ".join([REQUIRED["what" if name == "what" else "policy"], *(known if name != "what" else ())])
            raise FileNotFoundError(f"{name}={value}: no such folder; give {meaning}")
    effect, hideable = cfg.get("hidden_effect"), read_yaml(Path(__file__).parents[1] / "stand_in" / "kinds.yaml")
    if effect and effect not in hideable:
        raise ValueError(f"hidden_effect={effect}: there is no such effect{nearest(effect, hideable)}")
    if cfg.get("robot"):
        robot_file(cfg.robot)
    model = None if OmegaConf.is_missing(cfg, "model") else cfg.get("model")
    if isinstance(model, str) and model != "own":
        find_model(model)


def plain(node: Any) -> Any:
    """A config node as plain Python data."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def whole(cfg: DictConfig, name: str, least: int) -> int:
    """The integer in a field of a config; the field's name may be dotted.

    Raises:
        ValueError: if the value is not an integer of at least `least`.
    """
    value = OmegaConf.select(cfg, name)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}")
    return value
