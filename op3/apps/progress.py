"""Progress of a run, with the time left."""

import math
import sys
import time

LINE_SECONDS = 10.0
"""Minimum time between two lines of progress in a file [s]."""


class ProgressLine:
    """Shows progress on standard error: on a terminal as one line that is updated, in a file as occasional lines."""

    def __init__(self) -> None:
        self._began, self._written, self._stage = time.monotonic(), -math.inf, ""

    def __call__(self, stage: str, share: float) -> None:
        """Show the progress; `share` is the completed share of the run."""
        now = time.monotonic()
        left = f", {(now - self._began) * (1 / share - 1):.0f} s left" if share > 0.02 else ""
        if sys.stderr.isatty():
            bar = f"{'#' * round(30 * share):<30}"
            end = "\n" if share >= 1 else ""
            print(f"\r{stage:>13} {bar} {share:4.0%}{left}  ", end=end, file=sys.stderr, flush=True)
        elif stage != self._stage or now - self._written > LINE_SECONDS:
            print(f"{stage}: {share:.0%}{left}", file=sys.stderr, flush=True)
            self._written = now
        self._stage = stage
