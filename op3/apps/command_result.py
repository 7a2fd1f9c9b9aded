"""Result of a command."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class CommandResult:
    """Result of a command.

    Attributes:
        folder: folder of the run.
        headline: the result in a sentence or two, with units.
        numbers: all numbers by dotted key, as in ``result.yaml``.
        objective: number that a sweep of the command optimises.
        files: files whose paths the command prints; None: the page and the numbers, if they exist.
        following: the next command, printed last; empty if there is none.
    """

    folder: Path
    headline: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    objective: float | None = None
    files: tuple[Path, ...] | None = None
    following: str = ""

    def __str__(self) -> str:
        """The last lines of a command: the headline, up to five key numbers, and the paths."""
        key_numbers = [f"  {line}" for line in self.numbers.get("key_numbers", ())]
        files = self.files
        if files is None:
            usual = (self.folder / name for name in ("index.html", "result.yaml"))
            files = tuple(path for path in usual if path.is_file())
        following = [f"next: {self.following}"] if self.following else []
        return "\n".join([self.headline, *key_numbers, *map(str, files), *following])
