"""Objects of one kind in processes of their own, each of which does a part of the work.

The simulations of a batch leave processors idle between the steps of the physics; two halves of it side by side do not.
"""

import multiprocessing
import os
import pickle
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Crew(Generic[T]):
    """An object here, `worker`, and others elsewhere, which start with the first work and end with this process.

    Args:
        make: makes the object; a function or class of a module, which is called in each process.
        arguments: of it, which can be pickled.
        size: how many objects, that of this process included; 0 for as many as there are processors.
    """

    def __init__(self, make: Callable[..., T], arguments: Mapping[str, Any], size: int = 0):
        if size < 0:
            raise ValueError(f"a crew has at least one process, or 0 for one per processor, got {size}")
        self.size = size or processors()
        self._recipe = pickle.dumps((make, dict(arguments)))
        self.worker = make(**arguments)
        self._lines: list[Connection] = []

    def run(self, method: str, parts: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Call a method once per part, at most `size` of them, side by side.

        Args:
            method: name.
            parts: keyword arguments of each call; the first is done here.

        Returns:
            The results, in the order of the parts.

        Raises:
            ChildProcessError: if another process ended before its work.
        """
        if not 0 < len(parts) <= self.size:
            raise ValueError(f"a crew of {self.size} cannot do {len(parts)} parts at once")
        if len(parts) > 1 and not self._lines:
            self._lines = _recruit(self._recipe, self.size - 1)
            weakref.finalize(self, _dismiss, self._lines)
        busy = self._lines[: len(parts) - 1]
        try:
            for line, part in zip(busy, parts[1:], strict=True):
                with _listening():
                    line.send((method, part))
            own = getattr(self.worker, method)(**parts[0])
            with _listening():
                outcomes = [line.recv() for line in busy]
        except BaseException:
            _dismiss(self._lines)  # what they still have to say belongs to no later call
            self._lines = []
            raise
        for failed, result in outcomes:
            if failed:
                raise result
        return [own, *(result for _, result in outcomes)]


def _recruit(recipe: bytes, count: int) -> list[Connection]:
    """Start processes; they import what they need while this process begins its own part."""
    # a fork would have the locks of this process's threads without the threads; children of a fork server would be no
    # children of this process, which counts their processor time
    context = multiprocessing.get_context("spawn")
    lines = []
    for _ in range(count):
        here, there = context.Pipe()
        context.Process(target=_serve, args=(there, recipe), daemon=True).start()
        there.close()
        lines.append(here)
    return lines


@contextmanager
def _listening() -> Iterator[None]:
    """A broken line means that the process at its other end has gone."""
    try:
        yield
    except (EOFError, OSError) as error:
        raise ChildProcessError("a process that shared the work has ended; start again to go on") from error


def _dismiss(lines: Sequence[Connection]) -> None:
    for line in lines:
        with suppress(OSError):
            line.close()


def _serve(line: Connection, recipe: bytes) -> None:
    """Do what is asked until the other end is closed, which the end of that process does too."""
    torch.set_num_threads(1)
    make, arguments = pickle.loads(recipe)
    worker = make(**arguments)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            method, part = line.recv()
            try:
                outcome = (False, getattr(worker, method)(**part))
            except Exception as error:
                outcome = (True, error)
            line.send(outcome)
