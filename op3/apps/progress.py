"""Progress of a run, with the time left."""

import math
import sys
import time

LINE_SECONDS = 10.0
"""Minimum time between two lines of progress in a file [s]."""


class ProgressLine:
    """Shows progress on standard error: one line that is written over on a terminal, a line now and then in a file."""

    def __init__(self) -> None:
        self._began, self._written, self._stage = time.monotonic(), -math.inf, ""

    def __call__(self, stage: str, share: float) -> None:
        """Show it; `share` is the part of the whole run that is done."""
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
