"""Packages that import a module when one of its names is first used, so that a command only loads what it needs."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy(package: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package whose imports are under ``if TYPE_CHECKING``.

    Args:
        package: ``__name__`` of the package.
    """
    module = sys.modules[package]
    assert module.__file__ is not None
    blocks = [node for node in ast.parse(Path(module.__file__).read_text()).body if isinstance(node, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def look_up(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes[name]), name)
        setattr(module, name, value)
        return value

    return look_up
