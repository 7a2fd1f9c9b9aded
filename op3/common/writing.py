"""Atomic writing of files and folders."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def write_file(path: Path, fill: Callable[[Path], object]) -> None:
    """Write a file with `fill(temporary path)`, so that readers find the old or the new file, never a part."""
    temporary = _temporary(path)
    try:
        fill(temporary)
        sync(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text; see `write_file`."""
    write_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8", newline=""))


def write_folder(path: Path, fill: Callable[[Path], None], overwrite: bool = False) -> None:
    """Create a folder with `fill(temporary folder)` and rename it to its path.

    Args:
        path: path of the new folder.
        fill: function that writes the contents into an empty folder.
        overwrite: whether to replace an existing folder.
    """
    there = FileExistsError(f"{path}: it already exists; choose another folder or pass overwrite=True")
    if path.exists() and not overwrite:
        raise there
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
        if overwrite and path.exists():
            os.rename(path, old)
        try:
            os.rename(temporary, path)
        except OSError as error:  # another process was faster
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise there from None
            raise
        sync(path.parent)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
