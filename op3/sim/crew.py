"""Objects of one kind in separate processes that share the work.

A batch of simulations leaves processors idle between physics steps; two halves in parallel do not.
"""

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Crew(Generic[T]):
    """Equal objects that share work: `worker` in this process, and one in each further process; these processes start
    with the first call and end with this process.

    Args:
        make: makes the object; a function or class of a module, which is called in each process.
        size: number of objects, including the one in this process; 0: one per processor.
    """

    def __init__(self, make: Callable[..., T], arguments: Mapping[str, Any], size: int = 0):
        if size < 0:
            raise ValueError(f"processes must be at least 1, or 0 for one per processor, got {size}")
        self.size = size or processors()
        self._recipe = pickle.dumps((make, dict(arguments))) if self.size > 1 else b""
        self.worker = make(**arguments)
        self._others: ProcessPoolExecutor | None = None

    def run(self, method: str, parts: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Call a method once per part in parallel, for at most `size` parts.

        Args:
            parts: keyword arguments of each call; the first is done here.

        Returns:
            The results, in the order of the parts.

        Raises:
            ChildProcessError: if another process ended before its work, or could not begin.
        """
        if not 0 < len(parts) <= self.size:
            raise ValueError(f"{self.size} processes cannot run {len(parts)} parts at once")
        if len(parts) > 1 and self._others is None:
            spawn = multiprocessing.get_context("spawn")  # a fork has the locks of threads without the threads
            self._others = ProcessPoolExecutor(self.size - 1, spawn, _begin, (self._recipe,))
        try:
            # pickled plainly: torch would share the memory of every tensor, and keep a file open for each
            asked = [self._others.submit(_do, pickle.dumps((method, part))) for part in parts[1:] if self._others]
            own = getattr(self.worker, method)(**parts[0])
            return [own, *(pickle.loads(one.result()) for one in asked)]
        except BrokenProcessPool as error:
            self._others = None
            raise ChildProcessError(
                "a worker process has ended, usually because memory ran out; run the same command"
                " again to continue, with processes=1 if memory is short"
            ) from error


_here: dict[str, Any] = {}
"""The object of a worker process, and before the first part the function that makes it."""


def _begin(recipe: bytes) -> None:
    torch.set_num_threads(1)
    _here["recipe"] = recipe
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End the process when the parent process ends for any reason."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(said: bytes) -> bytes:
    if "worker" not in _here:
        make, arguments = pickle.loads(_here["recipe"])
        _here["worker"] = make(**arguments)
    method, part = pickle.loads(said)
    return pickle.dumps(getattr(_here["worker"], method)(**part))
