"""The error of all log readers: one sentence with location, problem and remedy."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


class LogError(ValueError):
    """A log that cannot be used, described in one sentence.

    The sentence reads `<source>, row <row>, column <column>: <problem>; <remedy>.`; parts that do not apply are
    omitted. The same parts are attributes, so that a program can mark the cell.

    Args:
        problem: What is wrong, with the offending value.
        remedy: How to correct it.
        source: File or object that the log was read from.
        column: Column name as in the wide CSV (`elbow.position`), or a metadata field (`field rate`).
        row: Data row counted from 1, or the word `header`.
        episode: Episode counted from 0, for logs with an episode axis.
    """

    def __init__(
        self,
        problem: str,
        remedy: str,
        *,
        source: str | Path | None = None,
        column: str | None = None,
        row: int | str | None = None,
        episode: int | None = None,
    ):
        self.problem, self.remedy = problem, remedy
        self.source, self.column, self.row, self.episode = source, column, row, episode
        parts = [
            source,
            None if episode is None else f"episode {episode}",
            f"row {row}" if isinstance(row, int) else row,
            column if column is None or column.startswith("field ") else f"column {column}",
        ]
        where = ", ".join(str(part) for part in parts if part is not None)
        sentence = f"{where}: {problem}; {remedy}." if where else f"{problem}; {remedy}."
        super().__init__(" ".join(sentence.split()))


@contextlib.contextmanager
def located(**place: Any) -> Iterator[None]:
    """Add missing parts of the location to a `LogError` raised within the context."""
    try:
        yield
    except LogError as error:
        known = {name: getattr(error, name) for name in ("source", "column", "row", "episode")}
        said = {name: value for name, value in known.items() if value is not None}
        raise LogError(error.problem, error.remedy, **{**place, **said}) from None


def rename(name: object, known: Iterable[str], otherwise: str) -> str:
    """The remedy for an unknown name: the nearest valid name, or a general remedy if none is similar."""
    by_lower = {one.lower(): one for one in known}
    close = difflib.get_close_matches(str(name).lower(), by_lower, n=1)
    return f"rename it to {by_lower[close[0]]} if that is what you mean" if close else otherwise
