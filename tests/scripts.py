"""Scripts in processes that begin with everything imported, for which a new interpreter would take seconds."""

import multiprocessing
import os
import runpy
import sys
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory

import op3.diagnose
import op3.identify
import op3.report
import op3.train  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload([__name__])


def run_script(script: str | Path, *arguments: str, place: Path = ROOT) -> CompletedProcess[str]:
    """What `python <script> <arguments>` gives in a folder; the name of a script is that of one in `experiments`."""
    command = [str(ROOT / "experiments" / script), *arguments]
    with TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        process = SERVER.Process(target=_run, args=(command, place, out, err))
        process.start()
        process.join()
        return CompletedProcess(command, process.exitcode or 0, out.read_text(), err.read_text())


def _run(command: list[str], place: Path, out: Path, err: Path) -> None:
    """Be the program of this process."""
    for number, path in ((1, out), (2, err)):
        with path.open("w") as file:
            os.dup2(file.fileno(), number)
    os.chdir(place)
    os.environ |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    sys.argv, sys.path[:0] = command, [str(Path(command[0]).parent)]
    runpy.run_path(command[0], run_name="__main__")
