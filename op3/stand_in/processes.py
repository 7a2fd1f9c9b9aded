"""Running other programs to their end, with what they cost."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

GRACE = 10.0
"""Time that a stopped process has to end by itself [s]."""


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
    limited = ["timeout", f"--kill-after={GRACE:g}", f"{timeout:g}", *command]
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen(limited, stdout=out, stderr=subprocess.STDOUT)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except KeyboardInterrupt:
            process.terminate()  # which `timeout` passes on
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode in (124, 137, -9):  # of `timeout`, once it has stopped the command
        with log.open("a", encoding="utf-8") as out:
            out.write(f"\nstopped after {timeout:g} s\n")
    # Linux counts the resident set in kilobytes
    return Cost(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)
