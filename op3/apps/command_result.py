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
        files: files whose paths the command prints last; None: the page and the numbers, if they exist.
    """

    folder: Path
    headline: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    objective: float | None = None
    files: tuple[Path, ...] | None = None

    def __str__(self) -> str:
        """The last lines of a command: the headline, up to five key numbers, and the paths."""
        key_numbers = [f"  {line}" for line in self.numbers.get("key_numbers", ())]
        files = self.files
        if files is None:
            usual = (self.folder / "index.html", self.folder / "result.yaml")
            files = tuple(path for path in usual if path.is_file())
        return "\n".join([self.headline, *key_numbers, *map(str, files)])
