"""Functions that several commands share: the run's folder and its settings, logs and motions by name."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.fields import plain
from op3.apps.job import command_of_run, composed, override
from op3.common.assets import find_model, named_configs
from op3.common.private import scrub
from op3.common.settings import nearest
from op3.common.wandb_settings import WandbSettings
from op3.common.writing import write_text
from op3.robot import DEFAULT

if TYPE_CHECKING:
    from op3.motions import Motion
    from op3.report import RunFolder
    from op3.rollout import Rollout

ASKED = "asked.yaml"
"""File in a run's folder with the settings that it started with; see `check_same`."""

Made = TypeVar("Made", bound=CommandResult)


def output_folder() -> Path:
    """The folder of this run."""
    return Path(HydraConfig.get().runtime.output_dir)


def reported(kind: type[Made], values: Mapping[str, Any], objective: str | None = None, **more: Any) -> Made:
    """The result of a command from the numbers that its page was published with.

    Args:
        kind: of result.
        values: as of `op3.report.result.publish`.
        objective: key of the number that a sweep optimises.
        more: further fields of the result.
    """
    known = {"folder": output_folder(), "objective": None if objective is None else values[objective]}
    return kind(headline=values["headline"], numbers=values, **{**known, **more})


def check_same(path: Path, asked: Mapping[str, Any]) -> None:
    """Refuse to continue in a folder that was started with other settings: results would be mixed silently.

    Args:
        path: file of the folder in which `remember` has written the settings; nothing is refused without it.
        asked: settings now.

    Raises:
        ValueError: naming what differs.
    """
    if not path.exists():
        return
    before, asked = yaml.safe_load(path.read_text(encoding="utf-8")), scrub(dict(asked))
    names = [name for name in {**before, **asked} if before.get(name) != asked.get(name)]
    if names:
        was, now = ({name: each.get(name) for name in names} for each in (before, asked))
        raise ValueError(f"{path.parent} was started with {was}, not {now}; choose another hydra.run.dir")


def remember(path: Path, asked: Mapping[str, Any]) -> None:
    """Write the settings that a folder was started with, once; see `check_same`."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, yaml.safe_dump(scrub(dict(asked)), width=1000))


def by_name(overrides: Sequence[str]) -> dict[str, str]:
    """Overrides as a mapping."""
    return {name: value for name, _, value in (each.partition("=") for each in overrides)}


def seeded_faults(node: DictConfig) -> Any:
    """Faults of an emulated robot from a config node.

    Raises:
        ValueError: if they are impossible; the message says which.
    """
    from op3.deploy.emulator import Faults  # brings MuJoCo

    return Faults(**built(node, _convert_="all"))


def built(node: DictConfig, **options: Any) -> Any:
    """What a config node describes; a refusal is passed on in its own words."""
    try:
        return instantiate(node, **options)
    except InstantiationException as error:
        raise ValueError(str(error.__cause__ or error)) from error


def model_artifact(cfg: DictConfig) -> list[tuple[str, Path]]:
    """The file of a config's model, as an artifact that the run has read; none where the model is the robot's own."""
    return [("model", find_model(cfg.model))] if cfg.get("model") else []


READ = {"policy": "policy", "data": "log", "heldout": "log", "episodes": "log"}
"""Type of the artifact that each of these fields names, besides the model."""


def run_folder(cfg: DictConfig, **made: str) -> "RunFolder":
    """This run's folder with its provenance; `made` is the name in it of what the run makes, by kind."""
    from op3.report import RunFolder  # brings plotly, which a deployment need not load

    folder = output_folder()
    given = {name: plain(cfg[name]) for name in READ if name in cfg}
    used = [(READ[name], where) for name, where in given.items() if isinstance(where, str | list)]
    return RunFolder(
        folder,
        provenance(cfg, given.get("data")),
        plain(cfg),
        wandb_of(cfg),
        used=[*used, *model_artifact(cfg)],
        made=[(kind, folder / name) for kind, name in made.items()],
    )


def wandb_of(cfg: DictConfig) -> WandbSettings:
    """How the run is logged: its name is, unless given, what was run and the seed, such as ``balance-s0``."""
    wandb = WandbSettings.of(plain(cfg.get("wandb", "disabled")))
    choices = HydraConfig.get().runtime.choices
    what = choices.get("task") if "train" in HydraConfig.get().job.name else HydraConfig.get().job.name
    return wandb if wandb.name else replace(wandb, name=f"{what}-s{cfg.get('seed', 0)}")


def provenance(cfg: DictConfig, data: Any = None) -> dict[str, Any]:
    """Where this run's numbers come from."""
    from op3.report import run_provenance

    return {**run_provenance(seed=cfg.seed, data=data), "command": command_of_run()}


def library_motion(name: str, robot: str = DEFAULT) -> "Motion":
    """A motion by its name in `conf/motion` or `conf/variants.yaml`, for this robot if it is one for any.

    Raises:
        ValueError: if there is none of this name.
    """
    known = named_configs("motion")
    if name not in known:
        raise ValueError(f"there is no motion {name!r}{nearest(name, known)}")
    return instantiate(composed("collect", [f"motion={name}", override("robot", robot)]).motion)


def logs_where(logs: "Sequence[Rollout]", where: Mapping[str, Any] | None, field: str) -> "list[Rollout]":
    """The logs with these metadata; all where nothing is asked.

    Args:
        logs: to choose from.
        where: values by field of the metadata.
        field: of the config that asks, for messages.
    """
    from op3.rollout import Metadata

    known = [entry.name for entry in fields(Metadata)]
    unknown = [name for name in where or {} if name not in known]
    if unknown:
        raise ValueError(f"{field}: logs have no metadata field {unknown[0]!r}; they have {', '.join(known)}")
    chosen = [log for log in logs if all(getattr(log.metadata, k) == v for k, v in (where or {}).items())]
    if not chosen:
        raise ValueError(f"{field}={where} matches none of the {len(logs)} logs; {field}=null takes all")
    return chosen


def focus_joints(joints: Sequence[str] | None, logs: "Sequence[Rollout]") -> tuple[str, ...]:
    """Joints whose traces count: those given, else the controlled ones of the robot where the logs have them."""
    if joints is not None:
        return tuple(joints)
    controlled = logs[0].robot.controlled
    return controlled if set(controlled) <= set(logs[0].joints) else ()
