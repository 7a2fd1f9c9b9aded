"""The person at the robot: asked before torque, and able to say go while the loop runs."""

from __future__ import annotations

import select
import sys
import termios
from collections.abc import Callable
from contextlib import suppress


class Operator:
    """Someone who answers; this one agrees to everything at once, for the emulated robot and for tests."""

    def confirm(self, text: str) -> bool:
        """Ask, and wait for the answer."""
        return True

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Whether go was said since the last call; never waits. `say` shows the person a line while the loop runs."""
        return True

    def begins(self) -> None:
        """The policy begins now: set the ground in motion."""

    def ends(self) -> None:
        """The policy is over: take hold of the robot."""

    def travelled(self) -> float | None:
        """How far the robot has got since then [m]; None where nobody measured it, as a person does by hand."""
        return None


class Console(Operator):
    """A person at the terminal."""

    def __init__(self) -> None:
        self._prompted = False

    def confirm(self, text: str) -> bool:
        """Ask for the word yes."""
        self._forget()
        print(f"{text} Type yes and Enter to continue: ", end="", flush=True)
        answer = sys.stdin.readline()
        return answer.strip().lower() in ("yes", "y")

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Whether Enter was pressed."""
        if not self._prompted:
            self._prompted = True
            self._forget()
            say("In the start pose. Put the robot where it should begin, then press Enter; Ctrl-C switches off.")
        ready, _, _ = select.select([sys.stdin], [], [], 0)
        return bool(ready) and sys.stdin.readline() != ""

    @staticmethod
    def _forget() -> None:
        """An Enter from before the question is no answer to it."""
        with suppress(OSError, ValueError, termios.error):
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def quietly(report: Callable[[str], None]) -> Callable[[str], None]:
    """A report that does not fail where the terminal is gone: switching off matters more than saying so."""

    def say(text: str) -> None:
        with suppress(OSError, ValueError):
            report(text)

    return say
