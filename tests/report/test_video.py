"""Animated PNG."""

import struct
import zlib

import numpy as np
import pytest

from op3.report.picture import animated_png


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
    for frame, shown in zip(frames, play(found, 4, 5), strict=True):
        np.testing.assert_array_equal(shown, frame)


def play(found, height, width):
    """What a viewer shows, frame after frame: pixels of the palette over what was there, unless they are clear."""
    palette = np.frombuffer(dict(found)[b"PLTE"], np.uint8).reshape(-1, 3)
    clear = np.frombuffer(dict(found)[b"tRNS"], np.uint8) == 0
    data = [body if kind == b"IDAT" else body[4:] for kind, body in found if kind in (b"IDAT", b"fdAT")]
    shown = np.zeros((height, width, 3), np.uint8)
    for packed in data:
        rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, width + 1)
        assert not rows[:, 0].any()
        shown = np.where(clear[rows[:, 1:]][..., None], shown, palette[rows[:, 1:]])
        yield shown


def test_pixels_that_stay_are_not_written_again():
    """A square that moves before a still ground: it is shown where it is, and the later frames are mostly clear."""
    frames = [np.full((16, 16, 3), 240, dtype=np.uint8) for _ in range(3)]
    for k, frame in enumerate(frames):
        frame[4:8, 2 + 4 * k : 6 + 4 * k] = (200, 40, 0)
    found = chunks(animated_png(frames, 10.0))
    for frame, shown in zip(frames, play(found, 16, 16), strict=True):
        np.testing.assert_array_equal(shown, frame)
    later = [zlib.decompress(body[4:]) for kind, body in found if kind == b"fdAT"]
    clear = dict(found)[b"tRNS"].index(0)
    for packed in later:
        rows = np.frombuffer(packed, np.uint8).reshape(16, 17)[:, 1:]
        assert (rows != clear).sum() == 32  # 4 x 4 pixels appear, as many give the ground free


def test_many_colours_are_brought_to_the_nearest_of_a_palette():
    """4096 colours in a frame: 255 remain, and a pixel is off by a few steps of 256."""
    rng = np.random.default_rng(0)
    frame = np.clip(rng.normal(128, 30, (64, 64, 3)), 0, 255).astype(np.uint8)
    shown = next(play(chunks(animated_png([frame, frame], 10.0)), 64, 64))
    assert np.abs(shown.astype(int) - frame).mean() < 12


def test_frames_of_different_sizes_are_refused():
    """No frame, or frames of two sizes, are refused."""
    with pytest.raises(ValueError, match="one size"):
        animated_png([], 10.0)
    with pytest.raises(ValueError, match="one size"):
        animated_png([np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3, 3), np.uint8)], 10.0)
