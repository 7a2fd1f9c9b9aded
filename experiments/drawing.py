"""What the pictures of documents share: the look of their figures, frames side by side, and how large a file may be."""

import io
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

from op3.report.style import INK, MUTED, PALETTE
from op3.report.video import write_film

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

MOST = 100_000
"""Bytes of the largest picture of the documents."""

plt.rcParams.update(
    {
        "axes.prop_cycle": matplotlib.cycler(color=PALETTE),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": MUTED,
        "axes.labelcolor": INK,
        "figure.dpi": 120,
        "figure.constrained_layout.use": True,
        "font.size": 9,
        "legend.frameon": False,
        "lines.linewidth": 1.4,
    }
)


def panels(rows: int = 1, columns: int = 1, height: float = 3.0, width: float = 8.0, **options):
    """A figure of this size in inches, and its axes."""
    return plt.subplots(rows, columns, figsize=(width, height), **options)


def drawn(figure: Figure) -> Image.Image:
    """A figure as a picture."""
    data = io.BytesIO()
    figure.savefig(data)
    plt.close(figure)
    return Image.open(data).convert("RGB")


def above(axis: Axes) -> None:
    """A legend in one row over an axis, where it hides nothing."""
    axis.legend(ncol=4, loc="lower center", bbox_to_anchor=(0.5, 0.98))


def strip(frames: np.ndarray, top: int = 40) -> Image.Image:
    """Frames ``[frame, height, width, 3]`` side by side, without their empty margins, from a row on."""
    return Image.fromarray(np.concatenate([frame[top : top + 400, 90:390] for frame in frames], axis=1))


def small(picture: Image.Image, path: Path) -> Path:
    """Write a picture."""
    picture.save(path, quality=82, method=6)
    return path


def small_film(frames: np.ndarray, path: Path, rate: float) -> Path:
    """Write frames ``[frame, height, width, 3]`` at a rate [Hz], as good as `MOST` lets them be."""
    for quality in (60, 40, 25, 12):
        if write_film(frames, path, rate, quality=quality).stat().st_size <= MOST:
            break
    return path


def told(path: Path) -> str:
    """A file and its size."""
    return f"{path}, {-(-path.stat().st_size // 1000)} kB"
