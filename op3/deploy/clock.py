"""The time that the loop and the bus run on: the machine's, or a virtual one."""

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds since some fixed instant, and the only way that anything here waits."""

    def now(self) -> float:
        """The time [s]; it never goes back."""
        ...

    def sleep_until(self, when: float) -> None:
        """Wait until `now` is at least `when` [s]; return at once if that has passed."""
        ...


class MonotonicClock:
    """The machine's monotonic clock. Waiting gives up the processor; there is no spinning."""

    def now(self) -> float:
        """Monotonic time [s]."""
        return time.monotonic()

    def sleep_until(self, when: float) -> None:
        """Wait until `when` [s]."""
        remaining = when - time.monotonic()
        while remaining > 0:
            time.sleep(remaining)
            remaining = when - time.monotonic()
