"""A problem that a check reports in a log."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from op3.rollout.errors import LogError

ERROR, WARNING = "error", "warning"
"""With an error, the log is physically impossible and refused; with a warning, it is suspicious but accepted."""


@dataclass(frozen=True)
class LogFinding:
    """A wrong or suspicious property of a log.

    Attributes:
        severity: `error` or `warning`.
        problem: Evidence with numbers, and the likely cause.
        remedy: How to correct it, if possible by an option of the import.
        column: Column of the wide CSV, `time`, or a metadata field (`field mass`); None for the whole log.
        rows: First and last affected row, counted from 1; None for all rows.
        times: Times of these rows [s].
        set_aside: Whether the column is excluded while the rest of the log is used.
        check: Name of the check.
    """

    severity: str
    problem: str
    remedy: str
    column: str | None = None
    rows: tuple[int, int] | None = None
    times: tuple[float, float] | None = None
    set_aside: bool = False
    check: str = ""

    def error(self, source: str | Path | None) -> LogError:
        """The problem as an error that rejects the log."""
        row = None if self.rows is None else self.rows[0]
        return LogError(self.problem, self.remedy, source=source, column=self.column, row=row)

    def row(self) -> dict[str, Any]:
        """The problem as a row of a table, in plain values."""
        joint, _, channel = (self.column or "").rpartition(".")
        rows = "" if self.rows is None else "-".join(str(row) for row in dict.fromkeys(self.rows))
        times = "" if self.times is None else " to ".join(f"{t:.6g}" for t in dict.fromkeys(self.times))
        where = {"joint": joint, "channel": channel, "rows": rows, "times [s]": times}
        severity = "set aside" if self.set_aside else self.severity
        return {"severity": severity, **where, "finding": self.problem, "remedy": self.remedy}


def merge_findings(findings: Sequence[LogFinding]) -> list[LogFinding]:
    """Merge problems of several joints that differ only in their numbers, because they have the same cause."""
    alike: dict[tuple, list[LogFinding]] = {}
    for number, one in enumerate(findings):
        joint, _, channel = (one.column or "").rpartition(".")
        words = tuple(re.sub(r"(?<!\w)-?\d[\d.e+-]*", "#", text) for text in (one.problem, one.remedy))
        key = (one.check, one.severity, one.set_aside, channel, *words) if joint else (number,)
        alike.setdefault(key, []).append(one)
    merged = []
    for first, *others in alike.values():
        joints = ", ".join(dict.fromkeys((one.column or "").rpartition(".")[0] for one in others))
        merged.append(replace(first, problem=f"{first.problem} (also in {joints})") if others else first)
    return merged
