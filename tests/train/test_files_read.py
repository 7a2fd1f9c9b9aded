"""How much of the package a training reads."""

import subprocess
import sys
from pathlib import Path

FILES_READ, LEARNING = (105, 13_730), (39, 5_690)
"""Files and lines: of the whole package, and of tasks, environments, policies, algorithms and the command."""

PROGRAM = """
import importlib.abc, importlib.machinery, sys
from unittest.mock import MagicMock


class NoReport(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path=None, target=None):
        if name.startswith("op3.report"):
            return importlib.machinery.ModuleSpec(name, self, is_package=True)

    def create_module(self, spec):
        return MagicMock(__path__=[], __spec__=spec, __file__=None)

    def exec_module(self, module):
        pass


sys.meta_path.insert(0, NoReport())
from op3.apps import train as app

trained = app.run_training


class Done(Exception):
    pass


def run_training(*arguments, **options):
    assert trained(*arguments, **options).steps == 64 and arguments[0].updates
    raise Done


app.run_training = run_training
app.provenance = lambda cfg: {"git_hash": "", "command": "", "date": ""}
small = ["train.steps=64", "algorithm.warmup=16", "algorithm.rollout=4", "environments=4", "algorithm.buffer=64"]
small += ["algorithm.batch=8", "evaluation.episodes=1", "train.evaluate_every=64", "train.checkpoint_every=64"]
try:
    app.train("walk", folder=sys.argv[1], overrides=small)
except Done:
    pass
for module in list(sys.modules.values()):
    if module.__name__.split(".")[0] == "op3" and module.__file__:
        print("READ", module.__name__, len(open(module.__file__).read().splitlines()))
"""


def test_a_training_reads_few_files(tmp_path: Path):
    """From the command to the last gradient, without pages: files and lines by the half of the package."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    read = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("READ ")]
    lines = {name: int(count) for name, count in read}
    learning = {
        name: count
        for name, count in lines.items()
        if name.split(".")[1:2] in (["train"], ["tasks"], ["envs"], ["policy"]) or name == "op3.apps.train"
    }
    for read, (files, most) in ((lines, FILES_READ), (learning, LEARNING)):
        assert len(read) <= files, sorted(read)
        assert sum(read.values()) <= most, sorted(read)
