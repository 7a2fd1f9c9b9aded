"""Experiments one after another, each once: what longer experiments are made of."""

import ctypes
import fcntl
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import yaml
from support import by_name, check_same, remember

from op3.rollout.files import write_text

HERE = Path(__file__).resolve().parent
DONE = "done"
"""File in a stage's folder that says that it is finished, and what it took."""
ASKED = "stage.yaml"
"""File in a stage's folder with the script and its overrides."""
CHECKPOINT = "checkpoint.pt"
"""File of a training that can go on."""
PR_SET_PDEATHSIG = 1
"""Of Linux's prctl: the signal that a process gets when its parent ends."""


def ends_with_parent() -> None:
    """Have this process asked to end when its parent does, even by a kill: two must not write to one stage."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def children_seconds() -> float:
    """Processor time of all processes that this one has started and waited for [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other processes out as long as this one works, those of other machines on the same disk too."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _is_work(path: Path) -> bool:
    """Whether a file or folder of a stage is more than what every start leaves."""
    return path.name not in (ASKED, ".hydra") and path.suffix != ".log"


class Stages:
    """Runs experiments one after another, each once.

    Args:
        folder: of the whole run; each stage gets a folder in it.
        shared: folder in which stages are kept by what they were asked, so that runs have them in common: whichever
            comes first does the work, and the folder of each run links to it. None: every run does all of its own.
    """

    def __init__(self, folder: Path, shared: Path | None = None):
        self.folder = folder
        self.shared = shared
        self.seconds: dict[str, float] = {}
        """Duration of each stage [s]."""
        self.processor_seconds: dict[str, float] = {}
        """Time that processors spent on each stage, all of them together [s]."""

    def run(self, name: str, script: str, *overrides: str) -> Path:
        """Run one experiment, unless it has been finished before; returns its folder.

        A training that was interrupted goes on from its checkpoint, as other experiments go on by themselves.

        Raises:
            ValueError: if it fails, or was begun with other settings.
        """
        overrides = tuple(self._real(override) for override in overrides)
        asked = {"script": script, **by_name(overrides)}
        if self.shared is None:
            return self._run(name, self.folder / name, script, overrides, asked)
        place = self._common(name, asked)
        with _alone(place.with_suffix(".lock")):
            self._run(name, place, script, overrides, asked)
        return self.folder / name

    def _run(self, name: str, place: Path, script: str, overrides: Sequence[str], asked: dict[str, str]) -> Path:
        mark = place / DONE
        check_same(place / ASKED, asked)
        if mark.exists():
            self.seconds[name], self.processor_seconds[name] = map(float, mark.read_text(encoding="utf-8").split())
            print(f"{name}: done before", flush=True)
            return place
        command = [sys.executable, str(HERE / script), *overrides, f"hydra.run.dir={place}"]
        if script == "train.py" and (place / CHECKPOINT).exists():
            command.append(f"resume={place}")
        remember(place / ASKED, asked)
        print(f"{name}: python experiments/{script} {' '.join(command[2:])}", flush=True)
        started, worked = time.monotonic(), children_seconds()
        code = subprocess.run(command, check=False, preexec_fn=ends_with_parent).returncode
        if code:
            if not any(_is_work(path) for path in place.iterdir()):
                (place / ASKED).unlink()  # what was wrong may be mended
            raise ValueError(f"stage {name} ended with exit code {code}; mend it and run the same command again")
        self.seconds[name] = time.monotonic() - started
        self.processor_seconds[name] = children_seconds() - worked
        write_text(mark, f"{self.seconds[name]:.1f} {self.processor_seconds[name]:.1f}\n")
        return place

    def _real(self, override: str) -> str:
        """An override in which a path into this run is that of what is shared."""
        key, equals, value = override.partition("=")
        inside = self.shared is not None and value.startswith(str(self.folder))
        return f"{key}{equals}{Path(value).resolve() if inside else value}"

    def _common(self, name: str, asked: dict[str, str]) -> Path:
        """The shared folder of a stage, with a link to it from this run's."""
        assert self.shared is not None
        text = json.dumps(asked, sort_keys=True).replace(str(self.shared.resolve()), "")
        place = self.shared.resolve() / f"{name.lstrip('0123456789_')}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        place.mkdir(parents=True, exist_ok=True)
        link = self.folder / name
        if not link.exists():
            link.symlink_to(os.path.relpath(place, self.folder.resolve()), target_is_directory=True)
        return place

    def on_stand(self, name: str, motions: Sequence[str], *robot: str) -> Path:
        """Record motions of a robot in its stand, as one stage.

        Args:
            name: of the stage; its plan lies beside it.
            motions: names; one may be played several times.
            robot: overrides of collect.py for it.
        """
        content = {"plan": [{"motion": motion, "mount": "stand"} for motion in motions]}
        plan = (self.shared or (self.folder / name).parent) / "stand_plan.yaml"
        if plan.exists():
            check_same(plan, content)
        write_text(plan, yaml.safe_dump(content))
        return self.run(name, "collect.py", *robot, f"plan={plan}")
