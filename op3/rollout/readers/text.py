"""Reading files whole or line by line, packed or not, with one sentence where that fails."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import itertools
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path

from op3.rollout.errors import LogError

_PACKED = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}

_MOST = 1 << 30
"""No log is so large when unpacked [B]; a few bytes can be packed so that they fill the memory."""


def ending(path: Path) -> str:
    """The ending without that of the packer: `.csv` for `run.csv.xz`."""
    return (path.with_suffix("") if path.suffix in _PACKED else path).suffix


def stem(path: Path) -> str:
    """The name without endings: `run` for `run.csv.xz`; folders keep their dots."""
    if path.is_dir():
        return path.name
    return (path.with_suffix("") if path.suffix in _PACKED else path).stem


@contextlib.contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except UnicodeError as error:
        at = f"byte {error.start}" if isinstance(error, UnicodeDecodeError) else "the beginning"
        raise LogError(f"{at} is not UTF-8 text", "save it as UTF-8", source=path) from None
    except (lzma.LZMAError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        problem = f"the {path.suffix[1:]} data is broken or cut short"
        raise LogError(problem, "copy or download the file again", source=path) from error
    except OSError as error:
        raise LogError(f"the file cannot be read ({error.strerror or error})", "check the path", source=path) from None


def read_bytes(path: Path) -> bytes:
    """Contents, unpacked where the name ends in .xz, .gz or .bz2."""
    with _told(path), _PACKED.get(path.suffix, open)(path, "rb") as stream:
        raw = stream.read(_MOST)
    if len(raw) == _MOST:
        raise LogError("the file is larger than a gigabyte", "split it", source=path)
    return raw


@contextlib.contextmanager
def open_text(path: Path) -> Iterator[Iterator[str]]:
    """Lines of a text in UTF-8, or in UTF-16 where its mark says so."""
    with _told(path), _PACKED.get(path.suffix, open)(path, "rb") as stream:
        beginning = stream.read(2)
        stream.seek(0)
        encoding = "utf-16" if beginning in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        with io.TextIOWrapper(stream, encoding=encoding, newline=None) as text:
            yield text


def read_text(path: Path) -> str:
    """Contents as text."""
    with open_text(path) as lines:
        text = "".join(itertools.islice(lines, 10**7))
    if not text.strip():
        raise LogError("the file is empty", "write a header and at least one row", source=path)
    return text
