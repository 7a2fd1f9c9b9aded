"""Objects of one kind in processes of their own, each of which does a part of the work.

The simulations of a batch leave processors idle between the steps of the physics; two halves of it side by side do not.
"""

import multiprocessing
import os
import pickle
import traceback
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
        self._recipe = pickle.dumps((make, dict(arguments))) if self.size > 1 else b""
        self.worker = make(**arguments)
        self._others: list[_Other] = []

    def run(self, method: str, parts: Sequence[Mapping[str, Any]]) -> list[Any]:
        """Call a method once per part, at most `size` of them, side by side.

        Args:
            method: name.
            parts: keyword arguments of each call; the first is done here.

        Returns:
            The results, in the order of the parts.

        Raises:
            ChildProcessError: if another process ended before its work, or could not begin.
        """
        if not 0 < len(parts) <= self.size:
            raise ValueError(f"a crew of {self.size} cannot do {len(parts)} parts at once")
        if len(parts) > 1 and not self._others:
            self._others = [_Other(self._recipe) for _ in range(self.size - 1)]
            weakref.finalize(self, _dismiss, self._others)
        busy = self._others[: len(parts) - 1]
        try:
            for other, part in zip(busy, parts[1:], strict=True):
                other.tell((method, part))
            own = getattr(self.worker, method)(**parts[0])
            answers = [other.hear() for other in busy]
        except BaseException:
            _dismiss(self._others)  # what they still have to say belongs to no later call
            self._others = []
            raise
        for error, _ in answers:
            if error is not None:
                raise error
        return [own, *(result for _, result in answers)]


class _Other:
    """A process with an object of its own; it imports what it needs while this process begins its part.

    What is said is pickled plainly: torch would share the memory of every tensor, and keep a file open for each.

    Args:
        recipe: of the object, pickled.
    """

    def __init__(self, recipe: bytes):
        # a fork would have the locks of this process's threads without the threads; children of a fork server would
        # be no children of this process, which counts their processor time
        context = multiprocessing.get_context("spawn")
        self.line, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there, recipe), daemon=True)
        self.process.start()
        there.close()

    def tell(self, what: tuple[str, Mapping[str, Any]]) -> None:
        """Ask for a call."""
        said = pickle.dumps(what)
        with _listening():
            self.line.send_bytes(said)

    def hear(self) -> tuple[Exception | None, Any]:
        """What came of it."""
        with _listening():
            said = self.line.recv_bytes()
        return pickle.loads(said)


@contextmanager
def _listening() -> Iterator[None]:
    """A broken line means that the process at its other end has gone."""
    try:
        yield
    except (EOFError, OSError) as error:
        raise ChildProcessError(
            "a process that shared the work has ended, which happens where memory runs out; the same command goes on,"
            " with processes=1 in this process alone"
        ) from error


def _dismiss(others: Sequence[_Other]) -> None:
    for other in others:
        other.line.close()
        other.process.terminate()
        other.process.join()


def _serve(line: Connection, recipe: bytes) -> None:
    """Do what is asked until the other end is closed, which the end of that process does too."""
    torch.set_num_threads(1)
    worker, broken = None, None
    try:
        make, arguments = pickle.loads(recipe)
        worker = make(**arguments)
    except Exception as error:
        broken = error
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            method, part = pickle.loads(line.recv_bytes())
            try:
                if broken is not None:
                    raise broken
                answer = pickle.dumps((None, getattr(worker, method)(**part)))
            except Exception as error:
                answer = pickle.dumps((_sendable(error), None))
            line.send_bytes(answer)


def _sendable(error: Exception) -> Exception:
    """An error that can be raised in another process, with where it was raised in this one."""
    try:
        sent = pickle.loads(pickle.dumps(error))
    except Exception:
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    sent.add_note("In a process that shared the work:\n" + "".join(traceback.format_exception(error)))
    return sent
