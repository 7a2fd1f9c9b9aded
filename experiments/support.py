"""What the experiment scripts share."""

import dataclasses
import math
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, HydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import Field

from op3.command_help import config_file
from op3.command_line import told
from op3.policy.actions import GAIN_HIGH, GAIN_LOW
from op3.private import masked, scrub
from op3.robot import DEFAULT, Motion, named_configs
from op3.rollout import Metadata, Rollout
from op3.rollout.files import write_text
from op3.settings import (
    Count,
    Listed,
    Named,
    NotNegative,
    Number,
    Positive,
    Some,
    Text,
    Whole,
    nearest,
    read_yaml,
    settings,
    shown,
)
from op3.sim.model_file import find_model

if TYPE_CHECKING:
    from op3.report import RunFolder

CONF = Path(__file__).resolve().parents[1] / "conf"
"""The configs of this project."""

LINE_SECONDS = 10.0
"""Least time between two lines of progress in a file [s]."""


Gain = Annotated[Number, Field(ge=GAIN_LOW, le=GAIN_HIGH)]
"""A P gain [A/rad] that the servos take."""


@settings()
class Common:
    """What fields must be that mean the same in every experiment which has them."""

    seed: Whole = 0
    world_seed: Whole = 0
    threads: Whole = 0
    processes: Whole = 0
    number: Whole = 0
    rounds: Whole = 0
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
    grounds: Some[str] | None = None
    fixed_gains: Listed[Gain] = ()
    where: Named[Any] | None = None
    weights: Named[Any] | None = None
    heldout_where: Named[Any] | None = None
    overhead: NotNegative = 1.0
    mount_change: NotNegative = 1.0
    cycle: Positive | None = None
    duration: Positive | None = None
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
    wandb: Literal["offline", "online", "disabled"] = "offline"

    @classmethod
    def of(cls, cfg: DictConfig) -> "Common":
        """Those that a config has and that are given."""
        names = [field.name for field in dataclasses.fields(cls) if field.name in cfg]
        return cls(**{name: cfg[name] for name in names if not OmegaConf.is_missing(cfg, name)})


KINDS = {
    dict: (Mapping, "a mapping of its fields"),
    str: (str | None, "a text"),
    bool: (bool, "true or false"),
    int: (int | float, "a number"),
    float: (int | float, "a number"),
}
"""What a setting must be whose default in the config is of this kind, and that in words."""


def check_kinds(cfg: DictConfig) -> None:
    """Refuse another kind of value than the config has; what is null there, missing or made of others, may be any."""
    for name, default in read_yaml(config_file(HydraConfig.get().job.config_name or "")).items():
        kind, wanted = KINDS.get(type(default), (object, ""))
        open_ended = isinstance(default, str) and re.match(r"\$\{|\?\?\?", default)
        if name in cfg and not open_ended and not isinstance(cfg[name], kind):
            raise ValueError(f"{name} must be {wanted}, got {shown(plain(cfg[name]))}")


@contextmanager
def one_sentence(
    interrupted: str = "Nothing goes on from here: run it again.",
    cfg: DictConfig | None = None,
) -> Iterator[None]:
    """Let wrong input end a script with its one sentence and a non-zero exit, without a stack trace.

    Args:
        interrupted: what is said after Ctrl-C of how to go on.
        cfg: config whose common fields are checked first; see `Common`.
    """
    try:
        if cfg is not None:
            Common.of(cfg)
            check_kinds(cfg)
        yield
    except (ValueError, OSError, MemoryError, HydraException, OmegaConfBaseException) as error:
        if isinstance(error, InstantiationException):  # what it was that would not be built says enough
            error = error.__cause__ or error
        if HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
            raise CompactHydraException(told(error)) from error  # the sweeper says which job it was
        print(masked(told(error)), file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        print(f"\nInterrupted. {interrupted}", file=sys.stderr)
        raise SystemExit(130) from None


def goes_on(done: str) -> str:
    """What is said after Ctrl-C of a run that keeps what it has done: trials, recordings or stages."""
    return f"The same command with the same hydra.run.dir goes on from the {done} done."


class Progress:
    """Says how far a stage of a run is and how long the run still takes: in one line on a terminal, in a file now and
    then in a new one."""

    def __init__(self) -> None:
        self._began, self._told, self._stage = time.monotonic(), -math.inf, ""

    def __call__(self, stage: str, share: float) -> None:
        """Say it; the share is that of the whole run which is done."""
        now = time.monotonic()
        left = f", {(now - self._began) * (1 / share - 1):.0f} s left" if share else ""
        if sys.stderr.isatty():
            bar = f"{'#' * round(30 * share):<30}"
            end = "\n" if share >= 1 else ""
            print(f"\r{stage:>10} {bar} {share:4.0%}{left}  ", end=end, file=sys.stderr, flush=True)
        elif stage != self._stage or now - self._told > LINE_SECONDS:
            print(f"{stage}: {share:.0%}{left}", file=sys.stderr, flush=True)
            self._told = now
        self._stage = stage


ASKED = "asked.yaml"
"""File in a run's folder that tells its settings from others; see `check_same`."""


def check_same(path: Path, asked: Mapping[str, Any]) -> None:
    """Refuse to go on in a folder with other settings than it was begun with: results would be mixed in silence.

    Args:
        path: file of the folder in which `remember` has written the settings down; nothing is refused without it.
        asked: settings now.

    Raises:
        ValueError: naming what differs.
    """
    if not path.exists():
        return
    before, asked = yaml.safe_load(path.read_text(encoding="utf-8")), scrub(dict(asked))
    names = [name for name in {**before, **asked} if before.get(name) != asked.get(name)]
    if names:
        was, now = ({name: one.get(name) for name in names} for one in (before, asked))
        raise ValueError(f"{path.parent} was begun with {was}, not {now}; choose another hydra.run.dir")


def remember(path: Path, asked: Mapping[str, Any]) -> None:
    """Write down what a folder was begun with, once; see `check_same`."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, yaml.safe_dump(scrub(dict(asked)), width=1000))


def by_name(overrides: Sequence[str]) -> dict[str, str]:
    """Overrides as a mapping."""
    return {name: value for name, _, value in (override.partition("=") for override in overrides)}


def seeded_faults(node: DictConfig) -> Any:
    """Faults of an emulated robot from a config node.

    Raises:
        ValueError: if they are impossible; the message says which.
    """
    from op3.deploy.emulator import Faults  # brings MuJoCo

    try:
        return Faults(**instantiate(node, _convert_="all"))
    except InstantiationException as error:
        raise ValueError(str(error.__cause__ or error)) from error


def plain(node: Any) -> Any:
    """A config node as Python's own data."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def positive(cfg: DictConfig, name: str, unit: str) -> float:
    """The number in a config's field.

    Raises:
        ValueError: if it is none above 0 and finite.
    """
    value = cfg[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise ValueError(f"{name} must be a number of {unit} above 0, got {value!r}")
    return float(value)


def whole(cfg: DictConfig, name: str, least: int) -> int:
    """The whole number in a config's field, which may be a dotted one.

    Raises:
        ValueError: if it is none of at least `least`.
    """
    value = OmegaConf.select(cfg, name)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return value


def check_given(cfg: DictConfig, name: str, what: str) -> None:
    """Refuse a config whose field `name` is still `???`, or neither a text nor a list."""
    if OmegaConf.is_missing(cfg, name):
        raise ValueError(f"{name} is missing: add {name}=<{what}>")
    if not isinstance(plain(cfg[name]), str | list):
        raise ValueError(f"{name} must be {what}, got {shown(plain(cfg[name]))}")


def model_file(cfg: DictConfig) -> list[tuple[str, Path]]:
    """The file of a config's model, as an artifact that the run has read; none where the model is the robot's own."""
    return [("model", find_model(cfg.model))] if cfg.get("model") else []


READ = {"policy": "policy", "data": "log", "heldout": "log", "episodes": "log"}
"""What fields name that a run reads, besides its model."""


def run_folder(cfg: DictConfig, folder: Path, **made: str) -> "RunFolder":
    """A run's folder with its provenance; `made` is the name in it of what the run makes, by kind."""
    from op3.report import RunFolder, run_provenance  # brings plotly, which a deployment need not load

    given = {name: plain(cfg.get(name)) for name in READ}
    used = [(READ[name], where) for name, where in given.items() if isinstance(where, str | list)]
    return RunFolder(
        folder,
        run_provenance(seed=cfg.seed, data=given["data"]),
        plain(cfg),
        os.environ.get("WANDB_MODE", cfg.wandb),
        used=[*used, *model_file(cfg)],
        made=[(kind, folder / name) for kind, name in made.items()],
    )


def source_word(argument: str) -> str:
    """An argument of before `robot=` named a robot, `robot=stand_in`, as it is now: `source=stand_in`."""
    name, _, value = argument.partition("=")
    sources = set(named_configs("source"))
    return f"source={value}" if name == "robot" and set(value.split(",")) <= sources else argument


def library_motion(name: str, robot: str = DEFAULT) -> Motion:
    """A motion of the library by its name in `conf/motion`, for a robot if it is one for any.

    Raises:
        ValueError: if there is none of this name.
    """
    known = named_configs("motion")
    if name not in known:
        raise ValueError(f"there is no motion {name!r}{nearest(name, known)}")
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return instantiate(compose("collect", [f"motion={name}", f"robot={robot!r}"]).motion)


def logs_where(logs: Sequence[Rollout], where: Mapping[str, Any] | None, field: str) -> list[Rollout]:
    """The logs with these metadata; all where nothing is asked.

    Args:
        logs: to choose from.
        where: values by field of the metadata.
        field: of the config that asks, for messages.
    """
    known = [entry.name for entry in dataclasses.fields(Metadata)]
    unknown = [name for name in where or {} if name not in known]
    if unknown:
        raise ValueError(f"{field}: logs have no metadata field {unknown[0]!r}; they have {', '.join(known)}")
    chosen = [log for log in logs if all(getattr(log.metadata, k) == v for k, v in (where or {}).items())]
    if not chosen:
        raise ValueError(f"{field}={where} matches none of the {len(logs)} logs; {field}=null takes all")
    return chosen


def focus_joints(joints: Sequence[str] | None, logs: Sequence[Rollout]) -> tuple[str, ...]:
    """Joints whose traces count: those given, else the controlled ones of the robot where the logs have them."""
    if joints is not None:
        return tuple(joints)
    controlled = logs[0].robot.controlled
    return controlled if set(controlled) <= set(logs[0].joints) else ()
