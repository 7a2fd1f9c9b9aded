"""A thin wrapper of wandb: offline, quiet and without an account unless asked otherwise."""

import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.private import scrub


def sweep_group(folder: str | Path) -> str:
    """The group of a run by its folder.

    Jobs of a Hydra multirun are numbered folders inside the sweep's, whose name (with the day's folder above it)
    is the group; any other folder is a group of its own.
    """
    folder = Path(folder).resolve()
    sweep = folder.parent if folder.name.isdecimal() else folder
    return f"{sweep.parent.name}/{sweep.name}".strip("/")


class RunLogger:
    """Logs one run to wandb.

    By default the run is written to ``<folder>/wandb`` and nothing leaves the machine; ``wandb sync`` uploads it
    later. Use it as a context manager, or call `close`.

    Args:
        folder: of the run.
        project: wandb project.
        group: runs to be shown together; `sweep_group` of the folder by default.
        name: of the run; the folder's name by default.
        config: plain settings of the run.
        mode: ``offline``, ``online`` or ``disabled``; by default the environment's WANDB_MODE, else offline.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        project: str = "op3",
        group: str | None = None,
        name: str | None = None,
        config: Mapping[str, Any] | None = None,
        mode: str | None = None,
    ):
        mode = mode or os.environ.get("WANDB_MODE") or "offline"
        if mode not in ("offline", "online", "disabled"):
            raise ValueError(f"wandb mode {mode!r}: choose offline, online or disabled")
        if mode != "online":
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb  # after the line above, which it reads once; and half a second that other uses need not pay

        self._wandb = wandb
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        quiet = mode != "online"
        self._run = wandb.init(
            project=project,
            group=group or sweep_group(folder),
            name=name or folder.resolve().name,
            dir=str(folder),
            config=scrub(dict(config or {})),
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(
                silent=quiet,
                console="off",
                disable_code=True,
                disable_git=True,
                x_disable_meta=quiet,
                x_disable_stats=quiet,
            ),
        )
        self.group: str = group or sweep_group(folder)
        self.folder = None if mode == "disabled" else Path(self._run.dir).parent

    def log(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Log numbers; steps must not decrease. Without a step, wandb counts calls."""
        self._run.log(dict(values), step=step)

    def figure(self, name: str, figure: go.Figure, step: int | None = None) -> None:
        """Log a plotly figure."""
        self._run.log({name: self._wandb.Plotly(figure)}, step=step)

    def image(self, name: str, image: np.ndarray, step: int | None = None) -> None:
        """Log an image, uint8 ``[height, width, 3]``."""
        self._run.log({name: self._wandb.Image(image)}, step=step)

    def summary(self, values: Mapping[str, Any]) -> None:
        """Set the numbers that stand for the whole run in wandb's tables."""
        self._run.summary.update(dict(values))

    def close(self, failed: bool = False) -> None:
        """Write everything and end the run."""
        self._run.finish(exit_code=int(failed))

    def __enter__(self) -> "RunLogger":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(failed=kind is not None)
