"""Functions that several commands share: a run's folder and its settings, logs and motions by name."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig

from op3.apps.compose import composed, override
from op3.apps.current_run import model_artifact, output_folder, provenance, wandb_of
from op3.apps.fields import plain
from op3.common.assets import named_configs
from op3.common.private import scrub
from op3.common.settings import nearest
from op3.common.writing import write_text
from op3.robot import DEFAULT

if TYPE_CHECKING:
    from op3.motions import Motion
    from op3.report import RunFolder
    from op3.rollout import Rollout

ASKED = "asked.yaml"
"""File with the initial settings of a run; see `check_same`."""


def check_same(path: Path, asked: Mapping[str, Any]) -> None:
    """Raise an error if the folder was started with other settings, so that results are never mixed.

    Args:
        path: file with the settings, written by `remember`; without it, any settings are accepted.
        asked: current settings.

    Raises:
        ValueError: names the settings that differ.
    """
    if not path.exists():
        return
    before, asked = yaml.safe_load(path.read_text(encoding="utf-8")), scrub(dict(asked))
    both = {name: [each.get(name, "unset") for each in (before, asked)] for name in {**before, **asked}}
    if differing := [f"{name}: {was} -> {now}" for name, (was, now) in both.items() if was != now]:
        raise ValueError(
            f"{path.parent} was started with other settings ({', '.join(differing)}); choose another hydra.run.dir"
        )


def remember(path: Path, asked: Mapping[str, Any]) -> None:
    """Write the settings that a folder was started with, once; see `check_same`."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, yaml.safe_dump(scrub(dict(asked)), width=1000))


INPUTS = {"policy": "policy", "data": "log", "heldout": "log", "episodes": "log"}
"""Artifact type of each field that names an input, besides the model."""


def run_folder(cfg: DictConfig, **made: str) -> "RunFolder":
    """This run's folder with its provenance; `made` lists the files that become artifacts, by kind."""
    from op3.report import RunFolder  # imports plotly, which a deployment does not need

    folder = output_folder()
    given = {name: plain(cfg[name]) for name in INPUTS if name in cfg}
    used = [(INPUTS[name], where) for name, where in given.items() if isinstance(where, str | list)]
    return RunFolder(
        folder,
        provenance(cfg, given.get("data")),
        plain(cfg),
        wandb_of(cfg),
        used=[*used, *model_artifact(cfg)],
        made=[(kind, folder / name) for kind, name in made.items()],
    )


def seeded_faults(node: DictConfig) -> Any:
    """Faults of an emulated robot from a config node.

    Raises:
        ValueError: if a fault is impossible; the message names it.
    """
    from op3.deploy.emulator import Faults  # brings MuJoCo

    return Faults(**built(node, _convert_="all"))


def built(node: DictConfig, **options: Any) -> Any:
    """The object that a config node describes. Its ValueError is raised unchanged; a text for a number is reported."""
    try:
        return instantiate(node, **options)
    except InstantiationException as error:
        texts = {k: v for k, v in node.items() if isinstance(v, str) and k not in ("_target_", "name", "robot")}
        if isinstance(error.__cause__, TypeError) and texts:
            group = node._get_full_key(None)
            given = ", ".join(f"{group}.{name}={value}" for name, value in texts.items())
            raise ValueError(f"{given}: must be a number ({error.__cause__})") from error
        raise ValueError(str(error.__cause__ or error)) from error


def library_motion(name: str, robot: str = DEFAULT) -> "Motion":
    """A motion by its name in `conf/motion` or `conf/variants.yaml`; general motions are adapted to this robot.

    Raises:
        ValueError: if the name is unknown.
    """
    known = named_configs("motion")
    if name not in known:
        raise ValueError(f"there is no motion {name!r}{nearest(name, known)}")
    return instantiate(composed("collect", [f"motion={name}", override("robot", robot)]).motion)


def logs_where(logs: "Sequence[Rollout]", where: Mapping[str, Any] | None, field: str) -> "list[Rollout]":
    """The logs with these metadata; all logs if `where` is empty.

    Args:
        logs: all logs.
        where: values by field of the metadata.
        field: config field that contains `where`, for messages.
    """
    from op3.rollout import Metadata

    known = [entry.name for entry in fields(Metadata)]
    unknown = [name for name in where or {} if name not in known]
    if unknown:
        raise ValueError(f"{field}: logs have no metadata field {unknown[0]!r}; they have {', '.join(known)}")
    chosen = [log for log in logs if all(getattr(log.metadata, k) == v for k, v in (where or {}).items())]
    if not chosen:
        raise ValueError(f"{field}={where} matches none of the {len(logs)} logs; {field}=null selects all")
    return chosen


def focus_joints(joints: Sequence[str] | None, logs: "Sequence[Rollout]") -> tuple[str, ...]:
    """The compared joints: the given ones, or the controlled joints that the logs contain."""
    if joints is not None:
        return tuple(joints)
    controlled = logs[0].robot.controlled
    return controlled if set(controlled) <= set(logs[0].joints) else ()
