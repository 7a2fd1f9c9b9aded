"""Runs commands for Hydra: checks the config, prints results, and prints an error as one sentence."""

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from op3.apps.command_result import CommandResult
from op3.apps.compose import composed
from op3.apps.fields import check
from op3.apps.search import search
from op3.apps.sentences import as_sentence
from op3.common.private import masked
from op3.identify.registration import register
from op3.identify.sweeper_conf import PopulationSweeperConf

NOTHING_KEPT = "This command cannot resume: start it again."
"""Message after Ctrl-C for commands that cannot resume."""


class Job:
    """Hydra's task function of a command, which imports the command after its config has been checked.

    Args:
        app: name of the config.
        module: module with a `main` that takes the config; empty: the module of this name in `op3.apps`. Its
            `INTERRUPTED` is the message after Ctrl-C.
    """

    def __init__(self, app: str, module: str = ""):
        self.module = module or f"op3.apps.{app}"
        self.__module__ = f"op3.apps.{app}"  # Hydra names the job after it

    def __call__(self, cfg: DictConfig) -> Any:
        """Check the config, run the command, print the result, and return the number that a sweep optimises."""
        with one_sentence(self.module):
            register()  # in a launcher's worker process nothing is registered yet
            check(cfg)
            module = importlib.import_module(self.module)
            if hasattr(module, "sweep_or_report"):  # its `main` runs a study
                result = module.main(cfg)
            else:
                result = search(module.main, cfg) if searched() else module.main(cfg)
            if not isinstance(result, CommandResult):
                return result  # results of the population that the sweeper requested
            print(result, flush=True)
            return result.objective


def searched() -> bool:
    """Whether this process is a worker of a study over a command's settings."""
    hydra: Any = HydraConfig.get()
    target = OmegaConf.select(hydra, "sweeper._target_")
    return hydra.mode == RunMode.MULTIRUN and target == PopulationSweeperConf._target_


@contextmanager
def one_sentence(module: str = "") -> Iterator[None]:
    """End a command after invalid input with one sentence and a non-zero exit code, without a stack trace."""
    try:
        yield
    except (ValueError, OSError, MemoryError, HydraException, OmegaConfBaseException) as error:
        if isinstance(error, InstantiationException):  # the cause names the invalid value
            error = error.__cause__ or error
        if HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN:
            raise CompactHydraException(as_sentence(error)) from error  # the sweeper names the job
        print(masked(as_sentence(error)), file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        how = getattr(sys.modules.get(module), "INTERRUPTED", NOTHING_KEPT)
        print(f"\nInterrupted. {how}", file=sys.stderr)
        raise SystemExit(130) from None


def goes_on(done: str) -> str:
    """Message after Ctrl-C of a run that keeps finished trials, recordings or stages."""
    return f"Run the same command with the same hydra.run.dir to continue after the finished {done}."


def check_first_job(app: str, overrides: Sequence[str]) -> None:
    """Compose the config of a multirun's first job, so that wrong names are found before the sweeper is imported."""
    first = []
    for each in OverridesParser.create().parse_overrides(list(overrides)):
        swept = each.is_sweep_override() and each.is_discrete_sweep() and not each.is_hydra_override()
        value = next(iter(each.sweep_string_iterator())) if swept else None
        first.append(f"{each.get_key_element()}={value}" if swept else str(each.input_line))
    composed(app, first, hydra=True)
