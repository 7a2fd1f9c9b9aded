"""Images as PNG inside HTML, for rendered frames."""

import base64
import struct
import zlib
from html import escape

import numpy as np


def png(image: np.ndarray) -> bytes:
    """An image as PNG (W3C Portable Network Graphics, 2nd edition; truecolour, 8 bit, no filter).

    Args:
        image: uint8 ``[height, width, 3]``, as MuJoCo's renderer gives it.

    Raises:
        ValueError: if shape or type differ.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    height, width, _ = image.shape
    # every row starts with the number of its filter, 0
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    rows[:, 1:] = image.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in parts)


def png_element(image: np.ndarray, text: str) -> str:
    """An ``<img>`` element that holds the image; the text is what a reader without eyes hears."""
    data = base64.b64encode(png(image)).decode()
    return f'<img class="card" alt="{escape(text)}" src="data:image/png;base64,{data}">'


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
