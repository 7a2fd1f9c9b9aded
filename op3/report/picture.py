"""Images as PNG inside HTML, for rendered frames."""

import base64
import struct
import zlib
from collections.abc import Sequence
from html import escape

import numpy as np


def png(image: np.ndarray) -> bytes:
    """An image as PNG (W3C Portable Network Graphics, 2nd edition; truecolour, 8 bit, no filter).

    Args:
        image: uint8 ``[height, width, 3]``, as MuJoCo's renderer gives it.

    Raises:
        ValueError: if shape or type differ.
    """
    parts = ((b"IHDR", _header(image)), (b"IDAT", _rows(image, 9)), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in parts)


def animated_png(frames: Sequence[np.ndarray], rate: float) -> bytes:
    """Frames as an animated PNG (W3C PNG, 3rd edition), which every browser plays; it repeats for ever.

    Args:
        frames: uint8 ``[height, width, 3]`` each, all of one size.
        rate: frames per second [Hz].

    Raises:
        ValueError: if there is no frame, or shapes or types differ.
    """
    if not frames or len({frame.shape for frame in frames}) != 1:
        raise ValueError("an animation needs frames of one size")
    height, width, _ = frames[0].shape
    parts = [(b"IHDR", _header(frames[0])), (b"acTL", struct.pack(">II", len(frames), 0))]
    number = 0
    for index, frame in enumerate(frames):
        control = struct.pack(">IIIIIHHBB", number, width, height, 0, 0, round(1000 / rate), 1000, 0, 0)
        data, number = _rows(frame, 6), number + 1
        parts.append((b"fcTL", control))
        if index == 0:
            parts.append((b"IDAT", data))
        else:
            parts.append((b"fdAT", struct.pack(">I", number) + data))
            number += 1
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in [*parts, (b"IEND", b"")])


def png_element(image: np.ndarray, text: str) -> str:
    """An ``<img>`` element that holds the image; the text is what a reader without eyes hears."""
    data = base64.b64encode(png(image)).decode()
    return f'<img class="card" alt="{escape(text)}" src="data:image/png;base64,{data}">'


_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def _header(image: np.ndarray) -> bytes:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    height, width, _ = image.shape
    return struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)


def _rows(image: np.ndarray, level: int) -> bytes:
    """The pixels, compressed; every row starts with the number of its filter, 0."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = image.reshape(height, -1)
    return zlib.compress(rows.tobytes(), level)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
