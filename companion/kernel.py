"""The `kernel` decorator, compiled where numba is installed, and the arrays that kernels take.

The inner arithmetic of the filters is written once, over floats and small float64 arrays. Where it
was compiled ahead from these very sources (`companion.kernel_cache`), that machine code is called.
Else the very same functions run as they are in a process that flies, and in others are compiled by
`numba.njit(cache=True)` where numba is installed.

Kernels that numba compiles are kept in the user's cache, in a folder named after the state of the
sources: numba notices when a kernel's own file has changed, but not when a kernel that it calls
has.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from companion import kernel_cache

F = TypeVar("F", bound=Callable[..., Any])

IS_SWITCHED_OFF = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
"""True if kernels shall run as plain Python; then no compiler is loaded either."""

_native = None if IS_SWITCHED_OFF else kernel_cache.installed()
numba: Any = None  # its types differ between versions
if _native is None and not IS_SWITCHED_OFF:
    if kernel_cache.forgoes_compiler:
        _native = kernel_cache.kept()
    else:
        os.environ.setdefault("NUMBA_OPT", "1")  # as fast as with its 3, compiled in half the time
        with contextlib.suppress(ImportError):
            numba = importlib.import_module("numba")

PACKAGES = ("companion", "sim_link")
"""Packages that define kernels."""


def _use_separate_cache() -> None:
    """Point numba's cache at a folder for these sources, and drop those long unused."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    cache = kernel_cache.cache_folder()
    numba.config.CACHE_DIR = ""
    if cache is None:
        return
    root = Path(__file__).resolve().parent.parent
    current = cache / f"kernels-{kernel_cache.digest_of(root, PACKAGES)}"
    with contextlib.suppress(OSError):
        current.mkdir(parents=True, exist_ok=True)
        os.utime(current)
        kernel_cache.drop_unused(cache)
        numba.config.CACHE_DIR = str(current)


if numba is not None:
    _use_separate_cache()

IS_NATIVE: bool = _native is not None
"""True if kernels were compiled ahead."""
IS_COMPILED: bool = IS_NATIVE or (numba is not None and not numba.config.DISABLE_JIT)
"""True if kernels are compiled; with numba the first call of each takes up to seconds."""
IS_COMPILED_ON_CALL: bool = IS_COMPILED and not IS_NATIVE
"""True if the first call of a kernel compiles it, or loads it from the cache."""


def kernel(function: F) -> F:
    """Return the compiled `function` if there is one; numba's has the plain one as `py_func`."""
    if _native is not None:
        code, variants = _native
        table = variants.get(f"{function.__module__}.{function.__name__}", {})
        compiled = {kinds: getattr(code, name) for kinds, name in table.items()}
        return cast(F, _dispatcher(function, compiled)) if compiled else function
    if numba is None:
        return function
    return cast(F, numba.njit(cache=True)(function))


def _dispatcher(
    function: Callable[..., Any], compiled: dict[tuple[object, ...], Callable[..., Any]]
) -> Callable[..., Any]:
    """Return a function that calls the code compiled for its arguments, else `function` itself."""

    @functools.wraps(function)
    def dispatched(*arguments: Any) -> Any:
        kinds = [
            (each.dtype.char, each.ndim, each.flags.num & _FLAGS)
            if type(each) is np.ndarray
            else _KINDS.get(type(each)) or kind_of(each)
            for each in arguments
        ]
        return compiled.get(tuple(kinds), function)(*arguments)

    return dispatched


_FLAGS = 0x401
"""Flags of an array in C order that may be written to."""
_KINDS: dict[type, str] = {
    **dict.fromkeys((float, np.float64), "float"),
    **dict.fromkeys((int, np.int64), "int"),
    **dict.fromkeys((bool, np.bool_), "bool"),
}


def kind_of(argument: Any) -> object:
    """Return the properties of an argument that compiled code depends on."""
    kind = type(argument)
    if kind is np.ndarray:
        return argument.dtype.char, argument.ndim, argument.flags.num & _FLAGS
    if kind is tuple:
        return f"tuple {len(argument)}"
    if kind not in _KINDS:
        _KINDS[kind] = f"{kind.__module__}.{kind.__qualname__}"
    return _KINDS[kind]


Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the same array, made read-only before it is stored in a value."""
    array.setflags(write=False)
    return array
