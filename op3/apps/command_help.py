"""The overview of all commands, the help of each, and completion for bash."""

import ast
import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from op3.apps import COMMANDS
from op3.common.assets import conf_folder, config_file

PRESETS: Mapping[str, Sequence[str]] = {
    "demo": ("source=emulated", "task=balance", "world=robot_4", "budget=demo"),
}
"""Overrides that every run of a command starts with."""


def documentation(app: str) -> str:
    """The docstring of a command's module, read without importing it, or that of the running script."""
    path = Path(__file__).parent / f"{app}.py"
    path = path if path.exists() else Path(sys.argv[0])
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def asked_for(config: str) -> str | None:
    """The required setting whose name may be omitted: ``op3 view <log>``."""
    found = re.search(r"^(\w+): \?\?\?", config_file(config).read_text(encoding="utf-8"), re.MULTILINE)
    return found and found[1]


def overview() -> str:
    """The output of ``op3 --help``."""
    rows = [f"  {name:15s}{documentation(app).splitlines()[0]}" for name, app in COMMANDS.items() if name != "demo"]
    return "\n".join(
        [
            "op3 diagnoses why a servo-driven robot differs from its simulation, and trains policies for it.",
            "",
            "  op3 <command> [setting=value ...]      op3 <command> --help lists the settings",
            "",
            f"  {'demo':15s}Record, identify, train and deploy on an emulated robot in minutes; write one HTML page.",
            *rows,
            f"  {'doctor':15s}Check this machine, and state how to fix what is missing.",
            f'  {"completion":15s}Completion for bash: eval "$(op3 completion)".',
            f"  {'--version':15s}The version of op3.",
        ]
    )


def completion() -> str:
    """A bash function that completes commands, settings and the names in config groups."""
    words = {name: settings_of(app) for name, app in COMMANDS.items()}
    for name in [name for name in words if " " in name]:
        first, second = name.split()
        words[first] = [second, *words[first], *words.pop(name)]
    cases = "\n".join(f'    {name}) words="{" ".join(dict.fromkeys(each))}" ;;' for name, each in words.items())
    commands = " ".join([*words, "doctor", "completion"])
    # bash ends words at `=`, so completions must not repeat the text before it
    return (
        "_op3() {\n"
        '  local words line="${COMP_LINE:0:COMP_POINT}"\n'
        '  local current="${line##* }"\n'
        '  case "${COMP_WORDS[1]}" in\n'
        f"{cases}\n  esac\n"
        f'  [ "$COMP_CWORD" = 1 ] && words="{commands}"\n'
        '  COMPREPLY=($(compgen -W "$words" -- "$current"))\n'
        '  [[ $current == *=* ]] && COMPREPLY=("${COMPREPLY[@]#*=}")\n'
        "}\ncomplete -o nospace -o default -F _op3 op3"
    )


@cache
def settings_of(config: str) -> list[str]:
    """Overrides that a config accepts: ``group=name`` for each option of its groups, ``setting=`` for its fields."""
    import yaml

    from op3.identify.registration import register

    register()
    content = yaml.safe_load(config_file(config).read_text(encoding="utf-8")) or {}
    chosen = {name: value for e in content.get("defaults", []) if isinstance(e, dict) for name, value in e.items()}
    choices = []
    for group, value in chosen.items():
        written = "{}=[{}]" if isinstance(value, list) else "{}={}"
        choices += [written.format(group, name) for name in names_in(group)]
    return [*choices, *(f"{name}=" for name in content if name not in ("defaults", "hydra"))]


def names_in(group: str) -> list[str]:
    """Names in a config group: files in ``conf``, effects of the catalogue and variants of motions."""
    from hydra.core.config_store import ConfigStore

    names = [*ConfigStore.instance().repo.get(group, {}), *(conf_folder() / group).glob("*.yaml")]
    return sorted({Path(name).stem for name in names})


def usage(config: str) -> str:
    """The output of ``--help`` of a command: usage, settings with defaults and units, config groups."""
    text = config_file(config).read_text(encoding="utf-8")
    body = re.sub(r"\A(#.*\n)+", "", text)  # the script's documentation describes the usage
    body = re.sub(r"^(defaults|hydra):\n(?: .*\n|\n)*", "", body, flags=re.MULTILINE)
    body = re.sub(r"\n{3,}", "\n\n", body).strip()
    groups: dict[str, list[str]] = {}
    for choice in settings_of(config):
        name, _, value = choice.partition("=")
        if value:
            groups.setdefault(name, []).append(value.strip("[]"))
    listed = [f"{name}=  {', '.join(values)}" for name, values in groups.items()]
    parts = [documentation(config), "Settings, with defaults (setting=value; group.field=value):", body]
    if listed:
        parts += ["Groups (group=name):", "\n".join(listed)]
    if asked := asked_for(config):
        parts.append(f"`{asked}=` may be omitted for the first argument.")
    parts.append("With -m, every value in a list (seed=0,1,2) starts a separate run; --cfg job prints all settings.")
    return "\n\n".join(parts)
