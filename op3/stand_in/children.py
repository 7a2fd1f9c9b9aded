"""Processes of a bench: Python scripts fork from a server that has imported what they need, other commands are started.

Importing torch, MuJoCo and what draws pages takes seconds of CPU time, a tenth and more of a diagnosis.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from multiprocessing.context import ForkServerContext
from pathlib import Path

_preloaded: list[str] = []

GRACE = 10.0
"""Time that a stopped process has to end by itself [s]."""


def preload(*modules: str) -> None:
    """Say what scripts are going to import; to be called before the first is run."""
    _preloaded.extend(modules)


def run_command(command: Sequence[str], log: Path, timeout: float) -> None:
    """Run a command to its end or for `timeout` [s], with all processes that it starts.

    Args:
        command: program and arguments. A script of this interpreter is forked, which starts it at once.
        log: file for what it prints.
        timeout: [s].
    """
    script = len(command) > 1 and command[0] == sys.executable and command[1].endswith(".py")
    server = _server() if script else None
    group, wait = _start(command, log) if server is None else _fork(server, command[1:], log)
    try:
        ended = wait(timeout)
    except KeyboardInterrupt:
        _stop(group, wait)
        raise
    if not ended:
        _stop(group, wait)
        with log.open("a", encoding="utf-8") as out:
            out.write(f"\nstopped after {timeout:g} s\n")


def _start(command: Sequence[str], log: Path) -> tuple[int, Callable[[float], bool]]:
    """Any program: its process group, and what waits for its end and says whether it has come."""
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)

    def wait(seconds: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
        return process.poll() is not None

    return process.pid, wait


def _fork(server: ForkServerContext, script: Sequence[str], log: Path) -> tuple[int, Callable[[float], bool]]:
    """A script of this interpreter, as `_start`."""
    log.write_text("", encoding="utf-8")
    process = server.Process(target=_play, args=(list(script), str(log)))
    with _nameless_main():
        process.start()
    assert process.pid is not None

    def wait(seconds: float) -> bool:
        process.join(seconds)
        return not process.is_alive()

    return process.pid, wait


@contextlib.contextmanager
def _nameless_main() -> Iterator[None]:
    """A start in which the child does not import this process's main file first: it is a script of its own."""
    main = sys.modules["__main__"]
    known = {name: vars(main)[name] for name in ("__file__", "__spec__") if name in vars(main)}
    vars(main).update(__file__=None, __spec__=None)
    try:
        yield
    finally:
        vars(main).pop("__file__")
        vars(main).update(known)


@cache
def _server() -> ForkServerContext | None:
    """What scripts are forked from; None where the system cannot."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return None
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_preloaded)
    return context


def _stop(group: int, wait: Callable[[float], bool]) -> None:
    """End a process and all that it has started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, number)
        wait(GRACE)


def _play(script: list[str], log: str) -> None:
    """Be `python <script> <arguments>`, with everything printed into a file."""
    os.setsid()
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    for stream in (1, 2):
        os.dup2(out, stream)
    sys.argv = script
    sys.path[0] = str(Path(script[0]).resolve().parent)
    try:
        runpy.run_path(script[0], run_name="__main__")
    finally:
        atexit._run_exitfuncs()  # such a child ends without
