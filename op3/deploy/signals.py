"""Signals that end a run: the first one stops it, and none disturbs the exit path."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

from op3.deploy.exit_codes import ExitCode, Stop

_CODES = {
    signal.SIGINT: ExitCode.INTERRUPTED,
    signal.SIGTERM: ExitCode.TERMINATED,
    signal.SIGHUP: ExitCode.HANGUP,
    signal.SIGQUIT: ExitCode.QUIT,
}


class StopSignals:
    """While it is entered, the first signal raises `Stop` wherever the program is; later ones are only counted.

    So an impatient second Ctrl-C cannot interrupt switching off. `hush` says that from now on even the first signal
    is only counted: the exit path has begun. In a thread other than the main one signals are left alone.

    Foreign code may swallow what is raised in it, as a finaliser or a bare `except` does; `check` raises it again.

    Attributes:
        count: signals so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._stop: Stop | None = None
        self._quiet = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._receive) for number in _CODES}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def hush(self) -> None:
        """Let no signal interrupt what follows."""
        self._quiet = True

    def check(self) -> None:
        """Raise the first signal's `Stop` once more, if there was a signal and the program still goes on."""
        if self._stop is not None and not self._quiet:
            raise self._stop

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.count += 1
        if self.count > 1 or self._quiet:
            return
        name = signal.Signals(number)
        self._stop = Stop(_CODES[name], f"stopped by {name.name}")
        raise self._stop
