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

    All frames share a palette of their 255 most frequent colours, and a frame holds only the pixels that have changed
    since the one before: before a camera that stands still, a film takes a tenth of what it takes in true colour.

    Args:
        frames: uint8 ``[height, width, 3]`` each, all of one size.
        rate: frames per second [Hz].

    Raises:
        ValueError: if there is no frame, or shapes or types differ.
    """
    if not frames or len({frame.shape for frame in frames}) != 1:
        raise ValueError("an animation needs frames of one size")
    height, width, _ = frames[0].shape
    palette, pictures = _indexed(frames)
    opaque = bytes([255] * len(palette) + [0])
    parts = [
        (b"IHDR", _header(frames[0], indexed=True)),
        (b"acTL", struct.pack(">II", len(frames), 0)),
        (b"PLTE", palette.astype(np.uint8).tobytes() + bytes(3)),
        (b"tRNS", opaque),
    ]
    number, shown = 0, None
    for picture in pictures:
        # drawn over what is shown, where the colour behind the palette's last lets it through
        control = struct.pack(">IIIIIHHBB", number, width, height, 0, 0, round(1000 / rate), 1000, 0, 1)
        changed = picture if shown is None else np.where(picture == shown, len(palette), picture).astype(np.uint8)
        data, number = _rows(changed, 9), number + 1
        parts.append((b"fcTL", control))
        if shown is None:
            parts.append((b"IDAT", data))
        else:
            parts.append((b"fdAT", struct.pack(">I", number) + data))
            number += 1
        shown = picture
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in [*parts, (b"IEND", b"")])


def _indexed(frames: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """A palette uint8 ``[colour, 3]`` of at most 255 colours, and the frames as indices into it."""
    coarse = [_coarse(frame) for frame in frames]
    counts = np.bincount(np.concatenate([c.ravel() for c in coarse]), minlength=COARSE**3)
    kept = np.argsort(counts, kind="stable")[::-1][:255]
    kept = kept[counts[kept] > 0]
    # a palette's colour is the mean of the pixels that it stands for, so few colours are exact
    sums = np.zeros((COARSE**3, 3))
    for frame, code in zip(frames, coarse, strict=True):
        for channel in range(3):
            sums[:, channel] += np.bincount(code.ravel(), frame[..., channel].ravel(), COARSE**3)
    palette = sums[kept] / counts[kept, None]
    present = np.flatnonzero(counts)
    middles = sums[present] / counts[present, None]
    nearest = np.zeros(COARSE**3, dtype=np.uint8)
    nearest[present] = [np.square(palette - middle).sum(1).argmin() for middle in middles]
    return np.round(palette).astype(np.uint8), [nearest[code] for code in coarse]


def _coarse(frame: np.ndarray) -> np.ndarray:
    """The number of each pixel's cell in a cube of `COARSE` cells to a side."""
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(f"an image must be uint8 [height, width, 3], got {frame.dtype} {list(frame.shape)}")
    red, green, blue = (frame[..., channel].astype(np.int64) * COARSE // 256 for channel in range(3))
    return (red * COARSE + green) * COARSE + blue


def film_element(data: bytes, text: str) -> str:
    """An ``<img>`` element that plays an animated PNG."""
    return f'<img class="card" alt="{escape(text)}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'


def png_element(image: np.ndarray, text: str) -> str:
    """An ``<img>`` element that holds the image; the text is what a reader without eyes hears."""
    return film_element(png(image), text)


COARSE = 32
"""Steps per channel of the colours that a palette is chosen from."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def _header(image: np.ndarray, indexed: bool = False) -> bytes:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"an image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    height, width, _ = image.shape
    return struct.pack(">IIBBBBB", width, height, 8, 3 if indexed else 2, 0, 0, 0)


def _rows(image: np.ndarray, level: int) -> bytes:
    """The pixels, compressed; every row starts with the number of its filter, 0."""
    flat = image.reshape(len(image), -1)
    rows = np.zeros((len(flat), 1 + flat.shape[1]), dtype=np.uint8)
    rows[:, 1:] = flat
    return zlib.compress(rows.tobytes(), level)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
