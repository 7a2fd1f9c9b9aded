"""Reading files whole, packed or not, with one sentence where that fails."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from op3.rollout.errors import LogError

_UNPACK: dict[str, Callable[[Any], bytes]] = {".xz": lzma.decompress, ".gz": gzip.decompress, ".bz2": bz2.decompress}


def ending(path: Path) -> str:
    """The ending without that of the packer: `.csv` for `run.csv.xz`."""
    return (path.with_suffix("") if path.suffix in _UNPACK else path).suffix


def stem(path: Path) -> str:
    """The name without endings: `run` for `run.csv.xz`; folders keep their dots."""
    if path.is_dir():
        return path.name
    return (path.with_suffix("") if path.suffix in _UNPACK else path).stem


def read_bytes(path: Path) -> bytes:
    """Contents, unpacked where the name ends in .xz, .gz or .bz2."""
    try:
        raw = path.read_bytes()
        return _UNPACK[path.suffix](raw) if path.suffix in _UNPACK else raw
    except (lzma.LZMAError, EOFError, gzip.BadGzipFile, zlib.error, ValueError):
        problem = f"the {path.suffix[1:]} data is broken or cut short"
        raise LogError(problem, "copy or download the file again", source=path) from None
    except OSError as error:
        raise LogError(f"the file cannot be read ({error.strerror or error})", "check the path", source=path) from None


def read_text(path: Path) -> str:
    """Contents as text."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(f"byte {error.start} is not UTF-8 text", "save it as UTF-8", source=path) from None
    if not text.strip():
        raise LogError("the file is empty", "write a header and at least one row", source=path)
    return text
