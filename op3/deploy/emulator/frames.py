"""Files of what went over the wire: one line per frame, with its time, direction and bytes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal

Direction = Literal[">", "<"]
"""From the computer to the devices, or back."""


@dataclass(frozen=True)
class Frame:
    """Bytes that went over the wire together.

    Attributes:
        time: when the first bit left [s].
        direction: ">" from the computer, "<" to it.
        data: as they were on the wire, or reached the computer if a fault hit them.
    """

    time: float
    direction: Direction
    data: bytes


class FrameRecorder:
    """Writes frames to a text file, ``<time in s> <direction> <bytes in hexadecimal>``.

    Args:
        path: of the file; what is there is replaced.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("w", encoding="ascii")

    def write(self, time: float, direction: Direction, data: bytes) -> None:
        """Add a frame."""
        self._file.write(f"{time:.7f} {direction} {data.hex(' ')}\n")

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def __enter__(self) -> FrameRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_frames(path: str | Path) -> list[Frame]:
    """The frames of a file that `FrameRecorder` wrote.

    Raises:
        ValueError: naming the line that is not a frame.
    """
    frames = []
    for number, line in enumerate(Path(path).read_text(encoding="ascii").splitlines(), 1):
        try:
            time, direction, data = line.split(" ", 2)
            if direction not in (">", "<"):
                raise ValueError(direction)
            frames.append(Frame(float(time), direction, bytes.fromhex(data)))  # type: ignore[arg-type]
        except ValueError:
            raise ValueError(f"{path}, line {number}: not a frame `<time> <direction> <bytes>`: {line!r}") from None
    return frames
