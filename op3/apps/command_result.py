"""What every command has to say in the end."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class CommandResult:
    """What a command has to say in the end.

    Attributes:
        folder: of the run.
        headline: the result in a sentence or two, with units.
        numbers: the same by dotted key, as in ``result.yaml``.
        objective: what a sweep of the command optimises.
        files: that the command ends with; None: page and numbers, where they are there.
    """

    folder: Path
    headline: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    objective: float | None = None
    files: tuple[Path, ...] | None = None

    def __str__(self) -> str:
        """The headline, up to five key numbers, and the paths: a command's last lines."""
        key_numbers = [f"  {line}" for line in self.numbers.get("key_numbers", ())]
        files = self.files
        if files is None:
            usual = (self.folder / "index.html", self.folder / "result.yaml")
            files = tuple(path for path in usual if path.is_file())
        return "\n".join([self.headline, *key_numbers, *map(str, files)])
