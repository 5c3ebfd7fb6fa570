"""The `kernel` decorator: compiled where numba is installed, the plain function otherwise.

The inner arithmetic of the filters is written once, over floats and small float64 arrays. With
the `fast` extra it is compiled by `numba.njit(cache=True)`; on a vehicle without numba the very
same functions run as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

try:
    import numba
except ImportError:
    numba = None

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` if numba is there; `function.py_func` is the plain one only then."""
    if numba is None:
        return function
    return cast(F, numba.njit(cache=True)(function))
