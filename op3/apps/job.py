"""Runs commands for Hydra and for Python: composes configs, ends errors in one sentence, prints results."""

import importlib
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from op3.apps.command_help import COMMANDS, config_file
from op3.apps.command_result import CommandResult
from op3.apps.fields import check
from op3.apps.search import search
from op3.apps.sentences import as_sentence
from op3.common.private import CLAIMED, masked, scrub
from op3.identify.registration import register
from op3.identify.sweeper_conf import PopulationSweeperConf

NOTHING_KEPT = "This command cannot resume: run it again."
"""Message after Ctrl-C for commands that cannot resume."""


class Job:
    """Hydra's task function of a command, which imports the command once its config stands.

    Args:
        app: module in `op3.apps` with a `main` that takes the config; its `INTERRUPTED` says how to go on after Ctrl-C.
    """

    def __init__(self, app: str):
        self.app = app
        self.__module__ = f"op3.apps.{app}"  # Hydra names the job after it

    def __call__(self, cfg: DictConfig) -> Any:
        """Check, run, print the result; returns what a sweep optimises."""
        with one_sentence(self.__module__):
            register()  # a launcher's worker process has composed nothing itself
            check(cfg)
            module = importlib.import_module(self.__module__)
            if hasattr(module, "sweep_or_report"):  # its main is a study
                result = module.main(cfg)
            else:
                result = search(module.main, cfg) if searched() else module.main(cfg)
            if not isinstance(result, CommandResult):
                return result  # of a population that the sweeper asked for
            print(result, flush=True)
            return result.objective


def searched() -> bool:
    """Whether this process works for a study over a command's settings."""
    hydra: Any = HydraConfig.get()
    target = OmegaConf.select(hydra, "sweeper._target_")
    return hydra.mode == RunMode.MULTIRUN and target == PopulationSweeperConf._target_


@contextmanager
def one_sentence(module: str = "") -> Iterator[None]:
    """Let wrong input end a command with its one sentence and a non-zero exit, without a stack trace."""
    try:
        yield
    except (ValueError, OSError, MemoryError, HydraException, OmegaConfBaseException) as error:
        if isinstance(error, InstantiationException):  # what could not be built says enough
            error = error.__cause__ or error
        if HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
            raise CompactHydraException(as_sentence(error)) from error  # the sweeper says which job it was
        print(masked(as_sentence(error)), file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        how = getattr(sys.modules.get(module), "INTERRUPTED", NOTHING_KEPT)
        print(f"\nInterrupted. {how}", file=sys.stderr)
        raise SystemExit(130) from None


def goes_on(done: str) -> str:
    """Message after Ctrl-C of a run that keeps finished trials, recordings or stages."""
    return f"The same command with the same hydra.run.dir continues after the finished {done}."


SETTINGS_OF = {
    "diagnosed": "diagnose",
    "effects": "effect",
    "steps": "train.steps",
    "trials": "hydra.sweeper.n_trials",
}
"""Settings whose Python argument has another name."""


@contextmanager
def configured(
    app: str, *, overrides: Sequence[str] = (), folder: str | Path | None = None, **arguments: Any
) -> Iterator[DictConfig]:
    """The config of a command as Hydra would give it, for a call from Python.

    Args:
        app: module in `op3.apps`, whose config has the same name.
        overrides: as on the command line; they come after the arguments.
        folder: of the run; None: a new temporary one.
        arguments: settings by name, or by the shorter one of `SETTINGS_OF`; None leaves the config's default.
    """
    given = {SETTINGS_OF.get(name, name): value for name, value in arguments.items() if value is not None}
    overrides = [*(override(name, value) for name, value in given.items()), *overrides]
    folder = Path(mkdtemp(prefix=f"op3-{app}-") if folder is None else folder).absolute()
    places = [override("hydra.run.dir", folder), override("hydra.runtime.output_dir", folder)]
    folder.mkdir(parents=True, exist_ok=True)
    outer = HydraConfig.instance().cfg
    whole = composed(app, [*overrides, *places], hydra=True)
    HydraConfig.instance().set_config(whole)
    try:
        cfg = OmegaConf.masked_copy(whole, [str(name) for name in whole if name != "hydra"])
        check(cfg)
        yield cfg
    except InstantiationException as error:  # what could not be built says enough
        raise error.__cause__ or error from None
    finally:
        HydraConfig.instance().cfg = outer


def composed(config: str, overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    """A config with these overrides, with Hydra's own part where `hydra`."""
    register()
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    file = config_file(config)
    try:
        with initialize_config_dir(str(file.parent), job_name=file.stem, version_base="1.3"):
            return compose(file.stem, list(overrides), return_hydra_config=hydra)
    finally:
        GlobalHydra.instance().hydra = outer


def check_first_job(app: str, overrides: Sequence[str]) -> None:
    """Compose the config of a multirun's first job, so that wrong names are found before the sweeper is imported."""
    first = []
    for each in OverridesParser.create().parse_overrides(list(overrides)):
        swept = each.is_sweep_override() and each.is_discrete_sweep() and not each.is_hydra_override()
        value = next(iter(each.sweep_string_iterator())) if swept else None
        first.append(f"{each.get_key_element()}={value}" if swept else str(each.input_line))
    composed(app, first, hydra=True)


def override(name: str, value: Any) -> str:
    """An override that sets a field or chooses from a group, in Hydra's grammar."""
    return f"{name}={_written(value)}"


def _written(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_written(item)}" for name, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(_written, value)) + "]"
    text = str(value)
    if isinstance(value, int | float) or re.fullmatch(r"[A-Za-z_][\w./+-]*|/[\w./+-]*", text):
        return text
    escaped = text.replace("\\", "\\\\").replace("'", "\\'").replace("${", "\\${")
    return f"'{escaped}'"


def command_of_run() -> str:
    """The command that makes this run again, with its overrides."""
    hydra = HydraConfig.get()
    names = {app: ["op3", *command.split()] for command, app in COMMANDS.items() if command != "demo"}
    given = [*hydra.overrides.task, *(word for word in hydra.overrides.hydra if "sweeper" in word)]
    words = [word for word in given if word != os.environ.get(CLAIMED)]
    start = names.get(hydra.job.name, ["python", f"experiments/{hydra.job.name}.py"])
    return scrub(shlex.join([*start, *words]))
