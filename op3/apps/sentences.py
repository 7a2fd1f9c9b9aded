"""Errors of Hydra, the system and op3 as one sentence that suggests the nearest setting or name for a misspelt one."""

import difflib
import re
import sys
from collections.abc import Sequence

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from op3.apps.command_help import names_in, settings_of
from op3.common.assets import config_file
from op3.common.settings import nearest


def explained(error: Exception, config: str) -> str:
    """An error of Hydra or the system as one sentence, with the nearest valid setting or name."""
    text = " ".join(str(error).split())
    if asked := getattr(error, "missing_cfg_file", None):
        group, _, name = str(asked).rpartition("/")
        return no_such(group, name) if group else f"there is no config {name!r}"
    if found := re.match(r"Ambiguous value for argument '([^=]+)=([^']*)'", text):
        name, values = found.groups()
        return f"{name} has several values: add -m to run them one after another, or write {name}=[{values}] for a list"
    if "Config group override must be" in text:
        named = [word.partition("=") for word in sys.argv[1:]]
        return next((no_such(group, name) for group, _, name in named if names_in(group)), text)
    if found := re.search(r"Could not override '([^']+)'", text):
        asked, known = found[1].lstrip("+"), known_settings(config)
        if asked in known and (unknown := re.search(r"Key '([^']+)' is not in struct", str(error.__cause__))):
            part = asked.rpartition(".")[2]
            if unknown[1] == part:
                return f"{asked} belongs to another option of its config group; the chosen option has no field {part!r}"
            asked = f"{asked}.{unknown[1]}"
        if options := [word for word in sys.argv[1:] if word in settings_of(config)]:
            known = known_settings(config, options)
        group, _, part = asked.rpartition(".")
        if group and re.search(rf"^{re.escape(group)}: {{}}$", config_file(config).read_text("utf-8"), re.MULTILINE):
            return f"{group} has no entry {part!r} yet: add it with +{asked}=..."
        if parts := [name.removeprefix(f"{group}.") for name in known if group and name.startswith(f"{group}.")]:
            close = difflib.get_close_matches(part, parts, n=1)
            shown = nearest(part, close or [name for name in parts if "." not in name])
            more = f"; add an entry with +{asked}=..." if group.startswith("task.") and not close else ""
            return f"{group} has no field {part!r}{shown}{more}"
        close = difflib.get_close_matches(asked, known, n=1)
        return f"there is no setting {asked!r}{nearest(asked, close or [name for name in known if '.' not in name])}"
    if text.startswith("Error merging override") and error.__cause__:
        return f"{text.split()[-1]}: {str(error.__cause__).splitlines()[0]}"
    if asked := getattr(error, "override", None):
        return f"{asked}: invalid override; write setting=value, with quotes around a value that contains spaces"
    return as_sentence(error)


def no_such(group: str, name: str) -> str:
    """The message for an unknown name in a config group, with the nearest valid name."""
    return f"{group}={name}: there is no {name!r} in the group {group}{nearest(name, names_in(group))}"


def as_sentence(error: BaseException) -> str:
    """An error as one sentence; a system error names its file, other messages are unchanged."""
    if isinstance(error, MemoryError) or "std::bad_alloc" in str(error):
        return "not enough memory; use fewer robots, episodes or trials"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {(error.strerror or str(error)).lower()}; choose another folder"
    if isinstance(error, OmegaConfBaseException):  # the following lines locate the error in the config
        return re.sub(r"^\w+ raised while resolving interpolation: ", "", str(error).splitlines()[0])
    return " ".join(str(error).split())


def known_settings(config: str, options: Sequence[str] = ()) -> list[str]:
    """Dotted names of a config's settings and groups, with these options of its groups or the default ones."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(config_file(config).parent), version_base="1.3"):
        cfg = compose(config, list(options), return_hydra_config=True)
    names: list[str] = []

    def walk(node: DictConfig, prefix: str) -> None:
        for key in (key for key in node if not str(key).startswith("_")):
            names.append(f"{prefix}{key}")
            value = node._get_node(key)
            if isinstance(value, DictConfig) and not value._is_none() and not value._is_missing():
                walk(value, f"{prefix}{key}.")

    walk(cfg, "")
    names = [name for name in names if not name.startswith("hydra") or name.startswith("hydra.sweeper.")]
    groups = [choice.partition("=")[0] for choice in settings_of(config)]
    return list(dict.fromkeys([*names, *groups]))
