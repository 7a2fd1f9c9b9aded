"""The recorder: one fast call per control tick; at most a second is lost if the process is killed.

`append` only copies numbers into a buffer. A thread flushes the buffer to `rows.bin` twice a second, so a slow disk
never blocks the control loop. The file starts with one JSON line (channels and widths), followed by rows of float64
that each end with a copy of their time. After a crash it is read up to the last complete row.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from op3.common.writing import write_folder, write_text
from op3.rollout import files
from op3.rollout.errors import LogError, located
from op3.rollout.metadata import Metadata
from op3.rollout.rollout import DATA_FOLDER, METADATA_FILE, ROWS_FILE, Rollout
from op3.rollout.schema import CHANNELS, Key, key_name, normal_key
from op3.rollout.validate import check_values, known_channel, width_of

FLUSH_INTERVAL = 0.5
"""Time between writes to the disk [s]."""


class Recorder:
    """Writes a rollout row by row so that a crash loses little.

    Use it as a context manager: leaving it normally closes the log; an exception leaves an incomplete log
    that `Rollout.load` reads. The first row fixes the channels.

    Args:
        folder: New folder of the rollout.
        metadata: Metadata known at the start; the recorder sets `complete`.
    """

    def __init__(self, folder: str | Path, metadata: Metadata):
        self.folder = Path(folder)
        self.metadata = metadata.replace(complete=False)
        self.rows = 0
        self._layout: dict[Key, slice] = {}
        self._buffer = np.empty((0, 0))
        self._count = 0
        self._last_time = -np.inf
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._failure: OSError | None = None
        text = self.metadata.to_yaml()
        write_folder(self.folder, lambda f: write_text(f / METADATA_FILE, text))
        self._stream = (self.folder / ROWS_FILE).open("wb", buffering=0)
        self._thread = threading.Thread(target=self._keep_flushing, daemon=True)
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is None and not self._stop.is_set():
            self.close()
        else:
            self.abandon()

    def append(self, row: Mapping[Any, Any]) -> None:
        """Add one row; an invalid row raises `LogError` and is not added.

        Args:
            row: Values of every channel by key: a number for a scalar, otherwise an array or tensor [joint] or [3].
        """
        if self._stop.is_set():
            raise LogError("the recorder is closed", "open a new recorder", source=self.folder)
        if self._failure is not None:
            problem = f"rows can no longer be written ({self._failure.strerror})"
            raise LogError(problem, "free disk space and record again", source=self.folder)
        values = {normal_key(key): value for key, value in row.items()}
        with self._lock, located(source=self.folder, row=self.rows + 1):
            if not self._layout:
                self._set_layout(values)
            if self._count == len(self._buffer):
                self._buffer = np.concatenate([self._buffer, np.empty_like(self._buffer)])
            out = self._buffer[self._count]
            self._fill(out[:-1], values)
            self._last_time = out[-1] = out[0]
            self._count += 1
            self.rows += 1

    def _set_layout(self, row: dict[Key, Any]) -> None:
        """Fix the channels from the first row; time comes first in the packed row."""
        for key in row:
            known_channel(key)
        layout, start, low, high, binary = {}, 0, [], [], []
        for key, channel in CHANNELS.items():
            if key not in row:
                if channel.required:
                    raise LogError("the channel is missing", "give it in every row", column=channel.name)
                continue
            width, quantity = width_of(channel, self.metadata) or np.asarray(row[key]).size, channel.quantity
            layout[key] = slice(start, start + width)
            start += width
            low += [0.0 if quantity.nonnegative or quantity.binary else -np.finfo(float).max] * width
            high += [1.0 if quantity.binary else np.finfo(float).max] * width
            binary += [quantity.binary] * width
        self._low, self._high, self._binary = np.array(low), np.array(high), np.flatnonzero(binary)
        self._buffer = np.empty((max(64, int(self.metadata.rate)), start + 1))
        self._layout = layout

    def _fill(self, out: np.ndarray, row: dict[Key, Any]) -> None:
        """Copy the numbers of a row into the packed row; raise an error if they are invalid."""
        if row.keys() != self._layout.keys():
            names = ", ".join(sorted(key_name(key) for key in row.keys() ^ self._layout.keys()))
            problem = f"the row and the first row differ in {names}"
            raise LogError(problem, "give the same channels in every row")
        for key, place in self._layout.items():
            value = np.asarray(row[key], dtype=np.float64)
            if value.size != place.stop - place.start:
                problem = f"got {value.size} numbers, expected {place.stop - place.start}"
                raise LogError(
                    problem,
                    "give one number for each name of the channel's last axis (for example, each joint)",
                    column=key_name(key),
                )
            out[place] = value.reshape(-1)
        switches = out[self._binary]
        if not ((out >= self._low) & (out <= self._high)).all() or (switches * (1 - switches)).any():
            for key, place in self._layout.items():
                check_values(CHANNELS[key], out[None, None, place], self.metadata, self.rows)
        if not out[0] > self._last_time:
            problem = f"time {out[0]:.10g} s does not come after {self._last_time:.10g} s"
            raise LogError(problem, "give each row a later time", column="time")

    def _keep_flushing(self) -> None:
        while not self._stop.wait(FLUSH_INTERVAL):
            self._flush()

    def _flush(self) -> None:
        with self._lock:
            count, rows = self._count, self._buffer
            if count == 0:
                return
            self._buffer, self._count = np.empty_like(rows), 0
        chunk = rows[:count].tobytes()
        if self._stream.tell() == 0:
            widths = [[key_name(key), place.stop - place.start] for key, place in self._layout.items()]
            chunk = json.dumps(widths).encode() + b"\n" + chunk
        try:
            while chunk:
                chunk = chunk[self._stream.write(chunk) or 0 :]
            os.fsync(self._stream.fileno())
        except OSError as error:
            self._failure = error

    def abandon(self) -> None:
        """Stop recording and keep the rows written so far as an incomplete log."""
        self._stop.set()
        self._thread.join()
        if not self._stream.closed:
            self._flush()
            self._stream.close()

    def close(self, **changes: Any) -> Rollout:
        """Finish the log and load it.

        Args:
            changes: Metadata known only at the end, such as `fallen=True` or `travelled_distance=1.2`.
        """
        if self._stop.is_set():
            raise LogError("the recorder is closed", "load the rollout from its folder", source=self.folder)
        self.abandon()
        if self._failure is not None:
            problem = f"rows could not be written ({self._failure.strerror})"
            raise LogError(problem, "load the folder to recover the saved rows", source=self.folder)
        if self.rows == 0:
            shutil.rmtree(self.folder)
            raise LogError("no rows were recorded", "append rows before closing", source=self.folder)
        partial = Rollout.from_arrays(files.read_rows(self.folder / ROWS_FILE), self.metadata, self.folder)
        metadata = self.metadata.replace(**{**changes, "complete": True})
        write_folder(self.folder / DATA_FOLDER, lambda f: files.save_tensordict(partial.data, f))
        write_text(self.folder / METADATA_FILE, metadata.to_yaml())
        (self.folder / ROWS_FILE).unlink()
        return Rollout.load(self.folder)
