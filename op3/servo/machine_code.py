"""Functions in machine code, kept on disk where that can be."""

from collections.abc import Callable
from typing import Any

import numba


def machine_code(function: Callable[..., Any]) -> Any:
    """The function, compiled when it is first called with arguments of a kind, as numpy would compute it.

    Where neither the package's folder nor the user's cache can be written, each process compiles anew; the environment
    variable `NUMBA_CACHE_DIR` names another folder.
    """
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:
        return numba.njit(error_model="numpy")(function)
