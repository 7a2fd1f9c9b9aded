"""What the room may know of the others."""

import ast
import sys
from pathlib import Path

import pytest

import op3.stand_in

THEIRS = ("numpy", "scipy", "numba", "mujoco", "pinocchio", "yaml")
HOUSE = ("common.sample_intervals", "common.settings", "motions", "robot", "rollout", "scenes", "stand_in")
ALLOWED = (*THEIRS, *(f"op3.{room}" for room in HOUSE))
STANDARD = sys.stdlib_module_names


def imported_modules(room: str = "stand_in"):
    files = sorted((Path(op3.stand_in.__path__[0]).parent / room).rglob("*.py"))
    assert len(files) >= 4
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                yield from ((file.name, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{file.name} imports relatively"
                # `from op3 import servo` names its module in the alias
                names = [f"op3.{alias.name}" for alias in node.names] if node.module == "op3" else [node.module]
                yield from ((file.name, name) for name in names)


def test_only_robot_and_rollout_are_known():
    """The truth is made without the laws that identification fits: no import of servo, sim or anything above."""
    for file, module in imported_modules():
        allowed = any(module == name or module.startswith(f"{name}.") for name in ALLOWED)
        assert allowed or module.split(".")[0] in STANDARD, f"{file} imports {module}"


def test_nothing_is_imported_by_name_at_run_time():
    """No dynamic import hides from the test above."""
    for file in Path(op3.stand_in.__path__[0]).rglob("*.py"):
        assert "importlib" not in file.read_text()
        assert "__import__" not in file.read_text()
        for room in ("servo", "sim", "identify", "diagnose"):
            assert f'"op3.{room}' not in file.read_text()


@pytest.mark.parametrize("room", ["servo", "sim", "identify", "diagnose"])
def test_nothing_that_identifies_knows_the_truth(room):
    """No line of these rooms imports the stand-in, or reads its tables."""
    assert not [(file, module) for file, module in imported_modules(room) if module.startswith("op3.stand_in")]
    for file in (Path(op3.stand_in.__path__[0]).parent / room).rglob("*.py"):
        assert "stand_in" not in file.read_text(), file
