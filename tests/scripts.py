"""Programs in processes that begin with everything imported, for which a new interpreter would take seconds."""

import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

import op3.command_line
import op3.diagnose
import op3.envs
import op3.identify
import op3.report
import op3.train  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]

LONGEST = 600.0
"""A program that has not ended by then hangs, and is killed [s]."""

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload([__name__])


def run_script(script: str | Path, *arguments: str, place: Path = ROOT) -> CompletedProcess[str]:
    """What `python <script> <arguments>` gives in a folder; the name of a script is that of one in `experiments`."""
    return run_apart(_script, [str(ROOT / "experiments" / script), *arguments], place)


def run_apart(work: Callable[[list[str]], object], command: list[str], place: Path) -> CompletedProcess[str]:
    """How a program ends that does this work with its command in a folder, and what it prints."""
    with TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        process = SERVER.Process(target=_run, args=(work, command, place, out, err))
        process.start()
        process.join(LONGEST)
        if process.is_alive():
            process.kill()
            process.join()
        return CompletedProcess(command, process.exitcode or 0, out.read_text(), err.read_text())


def _run(work: Callable[[list[str]], object], command: list[str], place: Path, out: Path, err: Path) -> None:
    """Be the program of this process."""
    for number, path in ((1, out), (2, err)):
        with path.open("w") as file:
            os.dup2(file.fileno(), number)
    os.chdir(place)
    os.environ |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    work(command)


def _script(command: list[str]) -> None:
    """Run a script as the main program."""
    sys.argv, sys.path[:0] = command, [str(Path(command[0]).parent)]
    runpy.run_path(command[0], run_name="__main__")
