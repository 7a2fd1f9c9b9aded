"""Memory-mapped TensorDicts that reading cannot change, and the rows of an unfinished recording.

TensorDict's own loader maps files shared and writable: an in-place operation on loaded data changes the file, and a
truncated file is silently extended with zeros. The loader here checks the size and maps copy-on-write.
"""

from __future__ import annotations

import json
import math
import operator
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from op3.rollout.errors import LogError
from op3.rollout.schema import Key, normal_key

_DTYPES = {"torch.float64": np.dtype(np.float64), "torch.bool": np.dtype(np.bool_)}
_RESTORE = "copy the rollout folder again or restore it from a backup"


def save_tensordict(data: TensorDictBase, folder: Path) -> None:
    """Write in TensorDict's memory-map format (also read by `TensorDict.load_memmap`)."""
    try:
        data.clone().memmap(str(folder))
    except RuntimeError as error:  # torch raises it if the disk is full
        if (code := re.search(r"\((\d+)\)$", str(error))) is None:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(folder)) from None


def map_tensordict(folder: Path) -> TensorDict:
    """Memory-map a saved TensorDict copy-on-write; changes stay in memory."""
    file = folder / "meta.json"
    try:
        meta = json.loads(file.read_text(encoding="utf-8"))
        entries = {name: _map(folder, name, entry) for name, entry in meta.items() if isinstance(entry, dict)}
        return TensorDict(entries, batch_size=meta["shape"], device="cpu")
    except LogError:
        raise
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError, OverflowError):
        raise LogError("the file is missing or damaged", _RESTORE, source=file) from None


def _map(folder: Path, name: str, entry: dict[str, Any]) -> Any:
    """A channel described in `meta.json`, or a group of channels in a subfolder."""
    if "dtype" not in entry:
        return map_tensordict(folder / name)
    dtype, path = _DTYPES[entry["dtype"]], folder / f"{name}.memmap"
    shape = [operator.index(size) for size in entry["shape"]]
    size, wanted = path.stat().st_size if path.is_file() else 0, math.prod(shape) * dtype.itemsize
    if size != wanted:
        raise LogError(f"the file has {size} bytes, expected {wanted}", _RESTORE, source=path)
    return torch.from_numpy(np.memmap(path, dtype=dtype, mode="c", shape=tuple(shape)))


class GrowingRows:
    """Rows of `rows.bin` as they are written: one JSON line with the channels, then float64 numbers.

    Every row ends with a copy of its time, so that a truncated row is detected after a crash.

    Args:
        path: path of the file.
    """

    def __init__(self, path: Path):
        self.path = path
        self._offset, self._last = 0, -np.inf
        self._layout: list[tuple[Key, int]] = []

    def more(self) -> dict[Key, np.ndarray]:
        """Every complete row not read before, by channel, [time, last axis]; empty without new rows."""
        with self.path.open("rb") as stream:
            stream.seek(self._offset)
            try:
                if not self._layout:
                    self._layout = [(normal_key(name), int(width)) for name, width in json.loads(stream.readline())]
                    self._offset = stream.tell()
                ends = np.cumsum([width for _, width in self._layout])
                raw, size = stream.read(), 8 * (int(ends[-1]) + 1)
                table = np.frombuffer(bytearray(raw[: len(raw) // size * size])).reshape(-1, size // 8)
            except (ValueError, TypeError, IndexError, ArithmeticError, MemoryError):
                return {}
        whole = (table[:, 0] == table[:, -1]) & (np.diff(table[:, 0], prepend=self._last) > 0)
        table = table[: len(table) if whole.all() else int(whole.argmin())]
        if not len(table):
            return {}
        self._offset, self._last = self._offset + table.nbytes, float(table[-1, 0])
        columns = np.split(table[:, :-1], ends[:-1], axis=1)
        return {key: values for (key, _), values in zip(self._layout, columns, strict=True)}


def read_rows(path: Path) -> dict[Key, np.ndarray]:
    """Every complete row of a recording, by channel, [time, last axis]."""
    if columns := GrowingRows(path).more():
        return columns
    raise LogError("the interrupted recording contains no rows", "record again, because nothing was saved", source=path)
