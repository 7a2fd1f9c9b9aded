"""Composes the config of a command as Hydra does, for calls from Python."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from op3.apps.fields import check
from op3.common.assets import config_file
from op3.identify.registration import register

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
        folder: folder of the run; None: a new temporary folder.
        arguments: settings by name, or by their short name in `SETTINGS_OF`; None keeps the config's default.
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
    except InstantiationException as error:  # the cause names the invalid value
        raise error.__cause__ or error from None
    finally:
        HydraConfig.instance().cfg = outer


def composed(config: str, overrides: Sequence[str], hydra: bool = False) -> DictConfig:
    """A config with these overrides; with `hydra`, it includes Hydra's own settings."""
    register()
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    file = config_file(config)
    try:
        with initialize_config_dir(str(file.parent), job_name=file.stem, version_base="1.3"):
            return compose(file.stem, list(overrides), return_hydra_config=hydra)
    finally:
        GlobalHydra.instance().hydra = outer


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
