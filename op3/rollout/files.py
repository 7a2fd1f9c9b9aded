"""Files that are there whole or not at all, and memory-mapped TensorDicts that cannot be spoilt by reading.

TensorDict's own loader maps files shared and writable: an in-place operation on loaded data changes the file,
and a file cut short is silently grown with zeros. The loader here checks the size and maps copy-on-write.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from op3.rollout.errors import LogError

_DTYPES = {"torch.float64": np.dtype(np.float64), "torch.bool": np.dtype(np.bool_)}


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def write_text(path: Path, text: str) -> None:
    """Write a file so that a reader finds the old text or the new, never a part."""
    temporary = _temporary(path)
    try:
        with temporary.open("w", encoding="utf-8", newline="") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def write_folder(path: Path, fill: Callable[[Path], None], overwrite: bool = False) -> None:
    """Make a folder by `fill(temporary folder)` and put it in place by renaming.

    Args:
        path: Where the folder shall be.
        fill: Writes the contents into the empty folder it is given.
        overwrite: Whether a folder already there is replaced.
    """
    if path.exists() and not overwrite:
        raise LogError("there is something already", "choose another folder or pass overwrite=True", source=path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        fill(temporary)
        for file in temporary.rglob("*"):
            sync(file)
        sync(temporary)
        old = path.with_name(f".{path.name}.{os.getpid()}.old")
        shutil.rmtree(old, ignore_errors=True)
        if path.exists():
            os.rename(path, old)
        os.rename(temporary, path)
        sync(path.parent)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def save_tensordict(data: TensorDictBase, folder: Path) -> None:
    """Write in TensorDict's memory-map format (also read by `TensorDict.load_memmap`)."""
    data.clone().memmap(str(folder))


def map_tensordict(folder: Path) -> TensorDict:
    """Memory-map a saved TensorDict copy-on-write; changes stay in memory."""
    if not folder.is_dir():
        _broken(folder)
    entries, shape = _map_folder(folder), _meta(folder)["shape"]
    try:
        return TensorDict(entries, batch_size=shape, device="cpu")
    except (RuntimeError, ValueError, TypeError):
        return _broken(folder / "meta.json", f"the channels do not share the batch size {shape}")


def _broken(path: Path, problem: str = "the file is missing or broken") -> Any:
    raise LogError(problem, "copy the rollout folder again or restore it from a backup", source=path)


def _meta(folder: Path) -> dict[str, Any]:
    path = folder / "meta.json"
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return _broken(path)
    return meta if isinstance(meta, dict) and isinstance(meta.get("shape"), list) else _broken(path)


def _map_folder(folder: Path) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, entry in _meta(folder).items():
        if not isinstance(entry, dict):
            continue
        if "dtype" not in entry:
            entries[name] = _map_folder(folder / name)
            continue
        path, dtype, shape = folder / f"{name}.memmap", _DTYPES.get(str(entry["dtype"])), entry.get("shape")
        if dtype is None or not isinstance(shape, list) or not all(type(n) is int and n >= 0 for n in shape):
            return _broken(folder / "meta.json", f"channel {name} has dtype {entry['dtype']} and shape {shape}")
        size = path.stat().st_size if path.is_file() else -1
        wanted = math.prod(shape) * dtype.itemsize
        if size != wanted:
            _broken(path, f"the file has {max(size, 0)} bytes where {wanted} belong")
        entries[name] = torch.from_numpy(np.memmap(path, dtype=dtype, mode="c", shape=tuple(shape)))
    return entries
