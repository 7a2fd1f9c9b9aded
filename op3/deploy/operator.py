"""The person at the robot, who confirms before torque and starts the policy while the loop runs."""

from __future__ import annotations

import select
import sys
import termios
from collections.abc import Callable
from contextlib import suppress


class Operator:
    """An operator; this base class confirms everything at once, for the emulated robot and for tests."""

    def confirm(self, text: str) -> bool:
        """Ask, and wait for the answer."""
        return True

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Whether the operator has confirmed since the last call; never waits. `say` shows a line while the loop
        runs."""
        return True

    def begins(self) -> None:
        """The policy begins: start the motion of the ground."""

    def ends(self) -> None:
        """The policy has ended: hold the robot."""

    def travelled(self) -> float | None:
        """Distance travelled since `begin` [m]; None if not measured, for example if a person measures it."""
        return None


class Console(Operator):
    """A person at the terminal."""

    def __init__(self) -> None:
        self._prompted = False

    def confirm(self, text: str) -> bool:
        """Ask the person to type yes."""
        self._forget()
        print(f"{text} Type yes and Enter to continue: ", end="", flush=True)
        answer = sys.stdin.readline()
        return answer.strip().lower() in ("yes", "y")

    def said_go(self, say: Callable[[str], None] = print) -> bool:
        """Whether Enter was pressed."""
        if not self._prompted:
            self._prompted = True
            self._forget()
            say("The robot is in the start pose. Put it where it should begin, then press Enter; Ctrl-C switches off.")
        ready, _, _ = select.select([sys.stdin], [], [], 0)
        return bool(ready) and sys.stdin.readline() != ""

    @staticmethod
    def _forget() -> None:
        """Discard an Enter that was pressed before the question."""
        with suppress(OSError, ValueError, termios.error):
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)


def quietly(report: Callable[[str], None]) -> Callable[[str], None]:
    """Print a line; a closed terminal is ignored, so that switching off continues."""

    def say(text: str) -> None:
        with suppress(OSError, ValueError):
            report(text)

    return say
