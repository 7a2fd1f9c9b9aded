"""Several workers on one study: who is alive, and what each has in flight.

Every worker keeps one record in the study's user attributes, `worker:<id>`, and refreshes it while it
lives. The record never decides what is stored, only how much more is worth asking for: a worker that
is wrongly believed dead costs a few trials more, one wrongly believed alive a short wait.
"""

import logging
import os
import socket
import threading
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna

log = logging.getLogger(__name__)

HEARTBEAT_SECONDS = 20.0
STALE_SECONDS = 120.0
_PREFIX = "worker:"


class Worker:
    """This process's record in a study, refreshed by a thread between `start` and `stop`."""

    def __init__(self, study: optuna.Study) -> None:
        self.name = f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
        self._study = study
        self._claim: dict[str, Any] = {"trials": 0, "given": []}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="study-heartbeat", daemon=True)

    def start(self) -> None:
        """Announce this worker."""
        self._write()
        self._thread.start()

    def claim(self, trials: int, given: Sequence[int]) -> None:
        """Announce how many trials this worker has in flight, and which of the given ones are among them."""
        with self._lock:
            self._claim = {"trials": trials, "given": list(given)}
        self._write()

    def stop(self) -> None:
        """Withdraw the record."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()
        self._study.set_user_attr(_PREFIX + self.name, None)

    def others(self) -> list[dict[str, Any]]:
        """Records of the other workers that are alive."""
        return list(self._alive().values())

    def taken(self) -> set[int]:
        """Numbers of the given trials that the other workers alive have in flight."""
        return {number for record in self.others() for number in record["given"]}

    def rivals(self, given: Sequence[int]) -> list[str]:
        """Names of the other workers that are alive and claim one of these given trials."""
        return [name for name, record in self._alive().items() if set(record["given"]) & set(given)]

    def _alive(self) -> dict[str, dict[str, Any]]:
        records = {k.removeprefix(_PREFIX): v for k, v in self._study.user_attrs.items() if k.startswith(_PREFIX)}
        return {name: r for name, r in records.items() if r and name != self.name and is_alive(r)}

    def _beat(self) -> None:
        while not self._stopped.wait(HEARTBEAT_SECONDS):
            try:
                self._write()
            except Exception:
                # A database may be away for a moment; the next beat tries again.
                log.warning("The heartbeat could not be stored.", exc_info=True)

    def _write(self) -> None:
        with self._lock:
            record = {
                **self._claim,
                "host": socket.gethostname(),
                "pid": os.getpid(),
                "started": _start_time(os.getpid()),
                "seen": time.time(),
            }
            self._study.set_user_attr(_PREFIX + self.name, record)


def is_alive(record: dict[str, Any]) -> bool:
    """Say whether the worker that wrote a record still runs.

    On its own machine the process table knows; elsewhere, or where there is no such table, the record
    must be younger than `STALE_SECONDS`, six missed heartbeats.
    """
    if record["host"] == socket.gethostname() and record["started"] is not None:
        return _start_time(record["pid"]) == record["started"]
    return time.time() - record["seen"] < STALE_SECONDS


def _start_time(pid: int) -> int | None:
    """Start of a process in clock ticks since boot, which tells a reused process id from the old one.

    Source: proc(5), /proc/[pid]/stat, field 22.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    # The second field, the name in brackets, may hold spaces; a zombie has ended in all but name.
    fields = text.rpartition(")")[2].split()
    return None if fields[0] == "Z" else int(fields[19])
