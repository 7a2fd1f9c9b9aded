"""Compiled functions without objects and allocations, which could also run on a GPU."""

from collections.abc import Callable
from typing import Any

import numba

OPTIONS: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
"""Options of the compiler: division by zero as in numpy; arrays are only viewed, without reference counts."""

INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "no_rewrites": True, "forceinline": True}


def scalar(function: Callable[..., Any]) -> Any:
    """Decorator for a function of numbers that compiled code and Python can call."""
    return numba.njit(**OPTIONS)(function)


def part(function: Callable[..., Any]) -> Any:
    """Decorator for a function that only compiled code calls; inlining halves the time to compile and to run."""
    return numba.njit(**OPTIONS, **INNER)(function)


def entry(function: Callable[..., Any]) -> Any:
    """Decorator for a function over arrays that Python calls, compiled at the first call, cached on disk if possible.

    The cache is valid while its source file and the law are unchanged; all other functions that it calls are in that
    file.

    If neither the package's folder nor the user's cache is writable, each process recompiles; the environment variable
    `NUMBA_CACHE_DIR` names another folder. The function releases the GIL.
    """
    try:
        return numba.njit(cache=True, nogil=True, **OPTIONS)(function)
    except RuntimeError:
        return numba.njit(nogil=True, **OPTIONS)(function)
