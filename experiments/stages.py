"""Experiments one after another, each once: what longer experiments are made of."""

import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

HERE = Path(__file__).resolve().parent
DONE = "done"
"""File in a stage's folder that says that it is finished, and what it took."""


def children_seconds() -> float:
    """Processor time of all processes that this one has started and waited for [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class Stages:
    """Runs experiments one after another, each once.

    Args:
        folder: of the whole run; each stage gets a folder in it.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.seconds: dict[str, float] = {}
        """Duration of each stage [s]."""
        self.processor_seconds: dict[str, float] = {}
        """Time that processors spent on each stage, all of them together [s]."""

    def run(self, name: str, script: str, *overrides: str) -> Path:
        """Run one experiment, unless it has been finished before; returns its folder.

        Raises:
            ValueError: if it fails.
        """
        place = self.folder / name
        mark = place / DONE
        if mark.exists():
            self.seconds[name], self.processor_seconds[name] = map(float, mark.read_text(encoding="utf-8").split())
            print(f"{name}: done before", flush=True)
            return place
        command = [sys.executable, str(HERE / script), *overrides, f"hydra.run.dir={place}"]
        print(f"{name}: python experiments/{script} {' '.join(command[2:])}", flush=True)
        started, worked = time.monotonic(), children_seconds()
        code = subprocess.run(command, check=False).returncode
        if code:
            raise ValueError(f"stage {name} ended with exit code {code}; mend it and run the same command again")
        self.seconds[name] = time.monotonic() - started
        self.processor_seconds[name] = children_seconds() - worked
        mark.write_text(f"{self.seconds[name]:.1f} {self.processor_seconds[name]:.1f}\n", encoding="utf-8")
        return place

    def on_stand(self, name: str, motions: Sequence[str], *robot: str) -> Path:
        """Record motions of a robot in its stand, as one stage.

        Args:
            name: of the stage; its plan lies beside it.
            motions: names; one may be played several times.
            robot: overrides of collect.py for it.
        """
        plan = (self.folder / name).parent / "stand_plan.yaml"
        plan.write_text(yaml.safe_dump({"plan": [{"motion": motion, "mount": "stand"} for motion in motions]}))
        return self.run(name, "collect.py", *robot, f"plan={plan}")
