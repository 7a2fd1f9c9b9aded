"""Functions in machine code, without objects and allocations, which a GPU could run too."""

from collections.abc import Callable
from typing import Any

import numba

OPTIONS: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
"""Numbers are divided by zero as numpy does it; arrays are looked at, never made or counted."""

INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "no_rewrites": True, "forceinline": True}


def scalar(function: Callable[..., Any]) -> Any:
    """A function of numbers that machine code and Python can call."""
    return numba.njit(**OPTIONS)(function)


def part(function: Callable[..., Any]) -> Any:
    """A function that only machine code calls, always inlined: half the time to compile and to run."""
    return numba.njit(**OPTIONS, **INNER)(function)


def entry(function: Callable[..., Any]) -> Any:
    """A function over arrays that Python calls, compiled at its first call and kept on disk where that can be.

    What is kept counts as long as its file and the law are what they were: other functions it calls stand in that file.

    Where neither the package's folder nor the user's cache can be written, each process recompiles; the environment
    variable `NUMBA_CACHE_DIR` names another folder. Other threads run meanwhile.
    """
    try:
        return numba.njit(cache=True, nogil=True, **OPTIONS)(function)
    except RuntimeError:
        return numba.njit(nogil=True, **OPTIONS)(function)
