"""Functions in machine code, kept on disk where that can be."""

from collections.abc import Callable
from typing import Any

import numba
from numba.core import cgutils, types
from numba.extending import intrinsic


def machine_code(function: Callable[..., Any]) -> Any:
    """The function, compiled when it is first called with arguments of a kind, as numpy would compute it.

    Where neither the package's folder nor the user's cache can be written, each process compiles anew; the environment
    variable `NUMBA_CACHE_DIR` names another folder.
    """
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:
        return numba.njit(error_model="numpy")(function)


def _typed(context: Any, address: Any) -> Any:
    """A number as the address of memory."""

    def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), generate


_pointer: Any = intrinsic(_typed)
_array: Any = numba.carray  # type: ignore[reportPrivateImportUsage]


@numba.njit(inline="always")
def row_at(address, count, kind):
    """Numbers that lie one behind the other, from an address on; for use in machine code."""
    return _array(_pointer(address), count, kind)
