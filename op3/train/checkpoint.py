"""Checkpoints that are written atomically, and stopping between steps."""

import pickle
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from op3.common.writing import write_file

FORMAT = "op3-checkpoint/2"


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write tensors and plain values atomically: after a kill the old or the new file exists.

    Args:
        path: path of the file.
        state: nested dictionaries and lists of tensors, numbers and texts.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, lambda temporary: torch.save({"format": FORMAT, **state}, temporary))


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint; nothing in the file is executed.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is not a checkpoint of this version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no checkpoint; start without resume")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = " ".join(str(error).split())[:80]
        raise ValueError(f"{path}: truncated, or not a checkpoint ({reason}); start again in another folder") from None
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise ValueError(f"{path}: not a checkpoint of this version ({FORMAT}); start again in another folder")
    return state


@contextmanager
def stop_requested() -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set instead of ending the process; a second SIGINT interrupts at once.

    Signals can only be caught in the main thread; elsewhere the event is never set.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def note(number: int, frame: FrameType | None) -> None:
        if event.is_set() and number == signal.SIGINT:  # a second SIGTERM may come while a checkpoint is written
            raise KeyboardInterrupt
        if number == signal.SIGINT:
            print("\nStopping with a checkpoint; Ctrl-C again ends at once.", file=sys.stderr)
        event.set()

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
