"""Reads plain or compressed text files and the numbers in them; errors are one sentence."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import itertools
import json
import lzma
import zlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError

_PACKED = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}
_BEGINNINGS = {b"\xfd7zXZ\0": ".xz", b"\x1f\x8b": ".gz", b"BZh": ".bz2"}

_MOST = 1 << 30
"""Largest uncompressed size of a log [B], because a small archive could fill the memory."""


def unpacked(path: Path) -> Path:
    """The path without the compression extension: `run.csv` for `run.csv.xz`."""
    return path.with_suffix("") if path.suffix in _PACKED else path


@contextlib.contextmanager
def _log_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except UnicodeError as error:
        at = f"byte {error.start}" if isinstance(error, UnicodeDecodeError) else "the beginning"
        raise LogError(f"{at} is not UTF-8 text", "save it as UTF-8", source=path) from None
    except (lzma.LZMAError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = "the compressed data are damaged or truncated"
        raise LogError(problem, "copy or download the file again", source=path) from error
    except OSError as error:
        raise LogError(f"the file cannot be read ({error.strerror or error})", "check the path", source=path) from None


def _opened(path: Path) -> Any:
    """The bytes of a file, decompressed if its name or its first bytes indicate compression."""
    with path.open("rb") as stream:
        beginning = stream.read(6)
    if beginning[:4] == b"PK\3\4":
        remedy = "unpack it, or export the sheet as CSV"
        raise LogError("the file is a zip archive or a spreadsheet", remedy, source=path)
    kind = next((kind for start, kind in _BEGINNINGS.items() if beginning.startswith(start)), path.suffix)
    return _PACKED.get(kind, open)(path, "rb")


def read_bytes(path: Path) -> bytes:
    """The content, decompressed if necessary."""
    with _log_errors(path), _opened(path) as stream:
        raw = stream.read(_MOST)
    if len(raw) == _MOST:
        raise LogError("the file is larger than a gigabyte", "split it", source=path)
    return raw


def _encoding(beginning: bytes) -> str:
    """Encoding of a text, from its byte order mark or from zeros between letters."""
    if beginning in (b"\xff\xfe\0\0", b"\0\0\xfe\xff"):
        return "utf-32"
    if beginning[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    zeros = [byte == 0 for byte in beginning]
    spaced = {"utf-16-le": [False, True] * 2, "utf-16-be": [True, False] * 2}
    return next((name for name, pattern in spaced.items() if zeros == pattern), "utf-8-sig")


@contextlib.contextmanager
def open_text(path: Path) -> Iterator[Iterator[str]]:
    """Lines of a text in UTF-8, UTF-16 or UTF-32."""
    with _log_errors(path), _opened(path) as stream:
        beginning = stream.read(4)
        stream.seek(0)
        with io.TextIOWrapper(stream, encoding=_encoding(beginning), newline=None) as text:
            yield text


def read_text(path: Path) -> str:
    """The content as text."""
    with open_text(path) as lines:
        text = "".join(itertools.islice(lines, 10**7))
    if not text.strip():
        raise LogError("the file is empty", "write a header and at least one row", source=path)
    return text


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file."""
    again = "copy or download the file again"
    try:
        content = json.loads(read_bytes(path), object_pairs_hook=partial(_once, path))
    except json.JSONDecodeError as error:
        problem = f"the JSON is damaged or truncated at line {error.lineno} ({error.msg})"
        raise LogError(problem, again, source=path) from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, LogError):
            raise
        raise LogError("the file is not JSON", again, source=path) from None
    if not isinstance(content, dict):
        raise LogError("the JSON is not a mapping", "give a recording in the expected format", source=path)
    return content


def _once(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping; duplicate keys are refused."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise LogError("the key appears twice", "keep the correct one", source=path, column=f"field {twice}")
    return found


def numbers(cells: Sequence[Any], source: Path, column: str, width: int = 1) -> np.ndarray:
    """Cells of a column as finite numbers [row, width]; an error names the row of the first invalid cell."""
    table = _table(cells, width)
    if table is not None:
        return table
    row = next((row for row, cell in enumerate(cells) if _table([cell], width) is None), 0)
    plain = width == 1 and not isinstance(cells[row], list)
    wanted = "is not a finite number" if plain else f"is not {width} finite numbers"
    problem = "the value is missing" if cells[row] is None else f"{str(cells[row])[:40]!r} {wanted}"
    raise LogError(problem, "complete, repair or remove the row", source=source, column=column, row=row + 1)


def _table(cells: Sequence[Any], width: int) -> np.ndarray | None:
    try:
        table = np.array(cells)
    except (ValueError, OverflowError, MemoryError):
        return None
    if table.dtype.kind not in "fiub" or table.size != len(cells) * width or (np.abs(table) > 1e300).any():
        return None
    table = table.reshape(len(cells), width).astype(float)
    return table if np.isfinite(table).all() else None
