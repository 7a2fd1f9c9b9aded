"""Running other programs to their end, with what they cost."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

GRACE = 10.0
"""Time that a stopped process has to end by itself [s]."""

LOOK = 0.05
"""Time between two looks at whether a process has ended [s]."""


@dataclass(frozen=True)
class Cost:
    """What a process has used, with those that it started and waited for.

    Attributes:
        seconds: wall time [s].
        processor_seconds: processor time [s].
        peak_memory: largest resident set of one process [bytes].
    """

    seconds: float
    processor_seconds: float
    peak_memory: int


def run_command(command: Sequence[str], log: Path, timeout: float) -> Cost:
    """Run a command to its end or for `timeout` [s], with all processes that it starts.

    Args:
        command: program and arguments.
        log: file for what it prints.
        timeout: [s].
    """
    begin = time.monotonic()
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        usage = _wait(process, timeout)
        if usage is None:
            with log.open("a", encoding="utf-8") as out:
                out.write(f"\nstopped after {timeout:g} s\n")
            usage = _stop(process)
    except KeyboardInterrupt:
        _stop(process)
        raise
    if usage is None:
        raise RuntimeError(f"process {process.pid} does not end; see {log}")
    # Linux counts the resident set in kilobytes
    return Cost(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)


def _wait(process: subprocess.Popen, seconds: float):
    """What a process has used once it has ended; None if it runs on after that time."""
    end = time.monotonic() + seconds
    while True:
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        if ended:
            process.returncode = os.waitstatus_to_exitcode(status)
            return usage
        if time.monotonic() >= end:
            return None
        time.sleep(LOOK)


def _stop(process: subprocess.Popen):
    """End a process and all that it has started."""
    usage = None
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        usage = usage or _wait(process, GRACE)
    return usage
