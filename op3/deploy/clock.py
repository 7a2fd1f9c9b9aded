"""The time that the loop and the bus run on: the machine's, or that of an emulated robot."""

from time import monotonic, sleep
from typing import Protocol


class Clock(Protocol):
    """Seconds since some fixed instant, and the only way that anything here waits."""

    def now(self) -> float:
        """The time [s]; it never goes back."""
        ...

    def sleep_until(self, time: float) -> None:
        """Wait until `now` is at least this [s]; return at once if it has passed."""
        ...


class MonotonicClock:
    """The machine's monotonic clock. Waiting gives up the processor; there is no spinning."""

    def now(self) -> float:
        """Monotonic time [s]."""
        return monotonic()

    def sleep_until(self, time: float) -> None:
        """Wait until then [s]."""
        remaining = time - monotonic()
        while remaining > 0:
            sleep(remaining)
            remaining = time - monotonic()
