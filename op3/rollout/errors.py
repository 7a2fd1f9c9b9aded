"""The one error of the log format: a sentence that says where, what, and how to mend it."""

from __future__ import annotations

from pathlib import Path


class LogError(ValueError):
    """A log that cannot be used, told in one sentence.

    The sentence reads `<source>, row <row>, column <column>: <problem>; <remedy>.`; the parts that do not
    apply are left out. The same parts are attributes, so that a program can point at the cell.

    Args:
        problem: What is wrong, with the offending value.
        remedy: How to mend it.
        source: The file or object the log came from.
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
        super().__init__(self._sentence())

    def _sentence(self) -> str:
        place = [str(self.source)] if self.source is not None else []
        if self.episode is not None:
            place.append(f"episode {self.episode}")
        if self.row is not None:
            place.append(f"row {self.row}" if isinstance(self.row, int) else self.row)
        if self.column is not None:
            place.append(self.column if self.column.startswith("field ") else f"column {self.column}")
        where = ", ".join(place)
        sentence = f"{where}: {self.problem}; {self.remedy}." if where else f"{self.problem}; {self.remedy}."
        return " ".join(sentence.split())

    def at(self, source: str | Path) -> LogError:
        """The same error with its source filled in."""
        return LogError(
            self.problem,
            self.remedy,
            source=source,
            column=self.column,
            row=self.row,
            episode=self.episode,
        )
