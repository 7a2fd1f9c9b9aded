"""Stages: commands that run in sequence, each once."""

import fcntl
import hashlib
import io
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

import yaml

from op3.apps.collect import collect
from op3.apps.command_result import CommandResult
from op3.apps.progress import LINE_SECONDS
from op3.apps.support import check_same, remember
from op3.common.writing import write_text
from op3.deploy.exit_codes import Stop

DONE = "done"
"""File that marks a stage as finished and contains its duration."""

ASKED = "stage.yaml"
"""File with the command of a stage and its arguments."""

OUTPUT = "stage.log"
"""File with the output of a stage's command."""

CHECKPOINT = "checkpoint.pt"
"""Checkpoint from which a training can resume."""


def used_seconds() -> float:
    """Processor time of this process and its finished child processes [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + used.ru_utime + used.ru_stime


class StageOutput(io.TextIOBase):
    """Writes the standard output of a stage to a file and sometimes prints a line with the remaining time.

    Args:
        name: name of the stage.
        file: receives the output.
    """

    def __init__(self, name: str, file: TextIO):
        self._name, self._file, self._line, self._shown = name, file, "", time.monotonic()

    def write(self, text: str) -> int:
        """Write text to the file."""
        self._file.write(text)
        *lines, self._line = (self._line + text).split("\n")
        now = time.monotonic()
        if lines and lines[-1].endswith(" left") and now - self._shown > LINE_SECONDS:
            print(f"{self._name}: {' '.join(lines[-1].split())}", file=sys.stderr, flush=True)
            self._shown = now
        return len(text)

    def flush(self) -> None:
        """Flush the file."""
        self._file.flush()


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Lock out other processes, including those on other machines with the same disk."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _is_work(path: Path) -> bool:
    """Whether a stage produced this file or folder; files that every start writes do not count."""
    return path.name not in (ASKED, ".hydra") and path.suffix != ".log"


class Stages:
    """Runs commands one after another, each once.

    Args:
        folder: folder of the whole run; each stage has a subfolder.
        shared: folder of stages that several runs share. The first run that needs a stage executes it, and other runs
            with the same arguments link to it. None: every run executes all of its stages.
    """

    def __init__(self, folder: Path, shared: Path | None = None):
        self.folder = folder
        self.shared = shared
        self.seconds: dict[str, float] = {}
        """Duration of each stage [s]."""
        self.processor_seconds: dict[str, float] = {}
        """Processor time of each stage, summed over processors [s]."""

    def run(self, name: str, command: Callable[..., CommandResult], **arguments: Any) -> Path:
        """Run one command unless it has already finished; return its folder.

        An interrupted training continues from its checkpoint; other commands resume automatically.

        Args:
            name: name of the stage.
            command: function that takes `folder` and the arguments.
            arguments: arguments of the command.

        Raises:
            ValueError: if the command fails, or was started with other arguments.
        """
        arguments = {key: self._real(value) for key, value in arguments.items() if value is not None}
        asked = {"command": command.__name__, **{key: _as_data(value) for key, value in arguments.items()}}
        if self.shared is None:
            return self._run(name, self.folder / name, command, arguments, asked)
        place = self._common(name, asked)
        with _alone(place.with_suffix(".lock")):
            self._run(name, place, command, arguments, asked)
        return self.folder / name

    def _run(
        self,
        name: str,
        place: Path,
        command: Callable[..., CommandResult],
        arguments: Mapping[str, Any],
        asked: Mapping[str, Any],
    ) -> Path:
        mark = place / DONE
        check_same(place / ASKED, asked)
        if mark.exists():
            self.seconds[name], self.processor_seconds[name] = map(float, mark.read_text(encoding="utf-8").split())
            print(f"{name}: already finished", flush=True)
            return place
        resumed = {"resume": place} if command.__name__ == "train" and (place / CHECKPOINT).exists() else {}
        remember(place / ASKED, asked)
        print(f"{name}: started, output in {place / OUTPUT}", file=sys.stderr, flush=True)
        started, worked = time.monotonic(), used_seconds()
        try:
            with (place / OUTPUT).open("a", encoding="utf-8") as file, redirect_stdout(StageOutput(name, file)):
                result = command(**arguments, **resumed, folder=place)
                print(result)
        except (ValueError, FileNotFoundError) as error:
            if not any(_is_work(path) for path in place.iterdir()):
                (place / ASKED).unlink()  # a corrected command may have other arguments
            raise ValueError(f"stage {name}: {error}; run the same command to continue from this stage") from error
        except Stop as stop:
            raise Stop(stop.code, f"stage {name}: {stop}; run the same command to continue from this stage") from stop
        self.seconds[name] = time.monotonic() - started
        self.processor_seconds[name] = used_seconds() - worked
        write_text(mark, f"{self.seconds[name]:.1f} {self.processor_seconds[name]:.1f}\n")
        print(f"{name} ({self.seconds[name]:.0f} s): {result.headline}", flush=True)
        return place

    def _real(self, value: Any) -> Any:
        """An argument; a path into this run's folder is replaced by the shared path."""
        inside = self.shared is not None and isinstance(value, str | Path) and str(value).startswith(str(self.folder))
        return Path(value).resolve() if inside else value

    def _common(self, name: str, asked: Mapping[str, Any]) -> Path:
        """The shared folder of a stage, linked from this run's folder."""
        assert self.shared is not None
        text = json.dumps(asked, sort_keys=True).replace(str(self.shared.resolve()), "")
        place = self.shared.resolve() / f"{name.lstrip('0123456789_')}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        place.mkdir(parents=True, exist_ok=True)
        link = self.folder / name
        if not link.exists():
            link.symlink_to(os.path.relpath(place, self.folder.resolve()), target_is_directory=True)
        return place

    def on_stand(self, name: str, motions: Sequence[str], robot: Mapping[str, Any]) -> Path:
        """Record motions of a robot on a stand, as one stage.

        Args:
            name: name of the stage; its plan lies beside it.
            motions: names of motions; a name may occur several times.
            robot: arguments of `collect` that select the robot.
        """
        content = {"plan": [{"motion": motion, "mount": "stand"} for motion in motions]}
        plan = (self.shared or (self.folder / name).parent) / "stand_plan.yaml"
        if plan.exists():
            check_same(plan, content)
        write_text(plan, yaml.safe_dump(content))
        return self.run(name, collect, **robot, plan=plan)


def _as_data(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_as_data(item) for item in value]
    return value if isinstance(value, bool | int | float) else str(value)
