"""The house: no import circles, no name twice, no robot read by an import, and the OP3's names in few files."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from op3.robot import load_robot

ROOT = Path(__file__).resolve().parents[1]
FILES = {
    ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in ROOT.glob("op3/**/*.py")
}


def imports(name: str) -> set[str]:
    """Modules of the house that a module imports, in its functions too; what only the type checker sees is left out."""

    def walk(node: ast.AST) -> Iterator[ast.AST]:
        for child in ast.iter_child_nodes(node):
            if not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
                yield child
                yield from walk(child)

    found = set()
    for node in walk(ast.parse(FILES[name].read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {one if one in FILES else node.module for one in whole}
    return (found & set(FILES)) - {name}


def test_no_module_imports_itself_by_a_detour():
    """Modules that can be taken away one after the other, each once nothing it imports is left, hold no circle."""
    left = {name: imports(name) for name in FILES}
    while ready := [name for name, needs in left.items() if not needs & set(left)]:
        for name in ready:
            del left[name]
    assert not left


def test_no_class_and_no_file_shares_its_name():
    """A reader who meets a name finds one thing of that name in the package."""
    nodes = [node for path in FILES.values() for node in ast.walk(ast.parse(path.read_text()))]
    classes = [node.name for node in nodes if isinstance(node, ast.ClassDef)]
    files = [path.name for path in FILES.values() if path.name != "__init__.py"]
    assert {name: count for name, count in Counter(classes + files).items() if count > 1} == {}


def test_the_op3_is_data():
    """Its joints are named, and its own motions are made, in at most five files of the house."""
    names = "|".join(load_robot("op3").joints)
    nailed = rf"\b({names})\b|op3_motions|op3_suites"
    assert len([path for path in FILES.values() if re.search(nailed, path.read_text())]) <= 5


IMPORT_ALL = """
import importlib, pkgutil, sys
import op3

opened = []
sys.addaudithook(lambda event, arguments: event == "open" and opened.append(str(arguments[0])))
for module in pkgutil.walk_packages(op3.__path__, "op3."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
assert len(sys.modules) > 1000 and len(opened) > 1000
assets = [path for path in opened if "/assets/" in path]
print(*[path for path in assets if "/assets/servos/" not in path and "/assets/buses/" not in path])
"""


def test_no_import_reads_a_robot():
    """With every module imported, no robot file, model or scene has been opened; makes of servos and buses are."""
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
