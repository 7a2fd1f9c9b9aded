"""YAML as people write it: 1e-3 is a number, `on` is a name, and a key that stands twice is refused.

PyYAML reads YAML 1.1, in which 1e-3 is a text, `no` is false and 1:30 is ninety; of two equal keys the last wins.
This loader reads plain values as YAML 1.2 does.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from op3.rollout.errors import LogError

_SCALARS = (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    ("null", r"~|null|Null|NULL|", "~nN"),
)


_MOST_ALIASES = 20
"""Few enough that no text of ours is refused, and that lists of lists of aliases cannot fill the memory."""


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[Any, Any] = {}
    aliases = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            self.aliases += 1
            if self.aliases > _MOST_ALIASES:
                raise yaml.composer.ComposerError(None, None, "too many aliases", self.peek_event().start_mark)
        return super().compose_node(parent, index)


for _name, _pattern, _first in _SCALARS:
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_name}", re.compile(f"^(?:{_pattern})$"), [*_first] + ([""] if _name == "null" else [])
    )
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        line = key.start_mark.line + 1
        if isinstance(key, yaml.ScalarNode) and lines.setdefault(key.value, line) != line:
            first = lines[key.value]
            raise LogError(
                f"the key stands at line {first} and again at line {line}",
                "keep the one that is right",
                column=f"field {key.value[:60]}",
            )
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def parse(text: str, source: str | Path) -> Any:
    """The value that a YAML text holds; raises `LogError` with the line where it is none."""
    try:
        return yaml.load(text, Loader=_Loader)
    except LogError as error:
        raise error.at(source) from None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise LogError(f"invalid YAML at line {line} ({error.problem})", "correct that line", source=source) from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError, AttributeError, TypeError):
        remedy = "write plain `field: value` lines with valid numbers"
        raise LogError("invalid YAML", remedy, source=source) from None


def read(path: Path) -> Any:
    """The value in a YAML file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        problem = f"the metadata cannot be read ({getattr(error, 'strerror', None) or 'not UTF-8 text'})"
        raise LogError(problem, "write a UTF-8 YAML file there", source=path) from None
    return parse(text, path)
