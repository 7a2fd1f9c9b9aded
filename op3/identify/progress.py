"""Progress of a study: a bar on a terminal, now and then a line in a file."""

import sys
import time

from tqdm import tqdm

LINE_SECONDS = 15.0
"""Least time between two lines where standard error is no terminal [s]."""


class TrialProgress:
    """Shows trials, best value, trials per second and time left."""

    def __init__(self, total: int, finished: int, *, enabled: bool = True) -> None:
        self._total, self._first, self._finished = total, finished, finished
        self._enabled = enabled
        self._start = time.monotonic()
        self._told = self._start
        self._bar: tqdm | None = None
        if enabled and sys.stderr.isatty():
            self._bar = tqdm(total=total, initial=finished, unit="trial", dynamic_ncols=True)

    def update(self, finished: int, best: float | None) -> None:
        """Show the state after a population; `best` is None where there is no single best value."""
        new, self._finished = finished - self._finished, finished
        if new <= 0:
            return
        if self._bar is not None:
            if best is not None:
                self._bar.set_postfix_str(f"best {best:.6g}", refresh=False)
            self._bar.update(new)
        elif self._enabled and (finished >= self._total or time.monotonic() - self._told > LINE_SECONDS):
            self._told = time.monotonic()
            print(self._line(best), file=sys.stderr, flush=True)

    def _line(self, best: float | None) -> str:
        rate = (self._finished - self._first) / max(time.monotonic() - self._start, 1e-9)
        left = max(self._total - self._finished, 0) / rate
        text = f"{self._finished}/{self._total} trials, {rate:.3g} trials/s, {left:.0f} s left"
        return text if best is None else f"{text}, best {best:.6g}"

    def __enter__(self) -> "TrialProgress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
