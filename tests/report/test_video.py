"""Animated PNG."""

import struct
import zlib

import numpy as np
import pytest

from op3.report.picture import animated_png, png


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Kinds and contents, with their check sums verified."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    found, place = [], 8
    while place < len(data):
        (length,) = struct.unpack(">I", data[place : place + 4])
        kind, body = data[place + 4 : place + 8], data[place + 8 : place + 8 + length]
        assert struct.unpack(">I", data[place + 8 + length : place + 12 + length])[0] == zlib.crc32(kind + body)
        found.append((kind, body))
        place += 12 + length
    return found


def test_every_frame_is_there_in_order():
    """Frames decode to the pixels given, sequence numbers count up, and each is shown for 1 / rate."""
    frames = [np.full((4, 5, 3), value, dtype=np.uint8) for value in (0, 100, 200)]
    found = chunks(animated_png(frames, rate=20.0))
    assert dict(found)[b"acTL"] == struct.pack(">II", 3, 0)
    controls = [body for kind, body in found if kind == b"fcTL"]
    delays = [struct.unpack(">HH", body[20:24]) for body in controls]
    assert delays == [(50, 1000)] * 3
    numbers = [struct.unpack(">I", body[:4])[0] for kind, body in found if kind in (b"fcTL", b"fdAT")]
    assert numbers == list(range(5))
    data = [body if kind == b"IDAT" else body[4:] for kind, body in found if kind in (b"IDAT", b"fdAT")]
    for frame, packed in zip(frames, data, strict=True):
        rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(4, 16)
        assert not rows[:, 0].any()
        np.testing.assert_array_equal(rows[:, 1:].reshape(4, 5, 3), frame)


def test_a_reader_without_animation_sees_the_first_frame():
    """The first frame lies in the IDAT chunk, as in a still picture of it."""
    frame = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    still, moving = (dict(chunks(data)) for data in (png(frame), animated_png([frame, frame], 10.0)))
    assert zlib.decompress(still[b"IDAT"]) == zlib.decompress(moving[b"IDAT"])


def test_frames_of_different_sizes_are_refused():
    """No frame, or frames of two sizes, are refused."""
    with pytest.raises(ValueError, match="one size"):
        animated_png([], 10.0)
    with pytest.raises(ValueError, match="one size"):
        animated_png([np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3, 3), np.uint8)], 10.0)
