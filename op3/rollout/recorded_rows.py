"""The file `rows.bin` of a recording that has not been finished: a line of JSON with the channels, then chunks."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.schema import Key, normal_key

CHUNK = struct.Struct("<4sIII")
"""Before each chunk: mark, rows, bytes, CRC-32 of the bytes."""

MARK = b"rows"


def read_rows(path: str | Path) -> dict[Key, np.ndarray]:
    """Every whole chunk of a recording's `rows.bin`, by channel [time, last axis]."""
    raw = Path(path).read_bytes()
    line, _, body = raw.partition(b"\n")
    rows: list[np.ndarray] = []
    try:
        layout = [(normal_key(name), int(width)) for name, width in json.loads(line)]
        width = sum(w for _, w in layout)
        offset = 0
        while offset + CHUNK.size <= len(body):
            mark, count, size, check = CHUNK.unpack_from(body, offset)
            payload = body[offset + CHUNK.size : offset + CHUNK.size + size]
            if mark != MARK or zlib.crc32(payload) != check:
                break
            rows.append(np.frombuffer(payload).reshape(count, width))
            offset += CHUNK.size + size
    except (ValueError, TypeError, struct.error):
        rows = rows or []
    if not rows:
        remedy = "nothing reached the disk, record again"
        raise LogError("the interrupted recording holds no rows", remedy, source=path)
    table, columns, start = np.concatenate(rows), {}, 0
    for key, entries in layout:
        columns[key] = table[:, start : start + entries]
        start += entries
    return columns
