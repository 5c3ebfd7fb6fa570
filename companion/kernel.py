"""The `kernel` decorator, compiled where numba is installed, and the arrays that kernels take.

The inner arithmetic of the filters is written once, over floats and small float64 arrays. With
the `fast` extra it is compiled by `numba.njit(cache=True)`; on a vehicle without numba the very
same functions run as they are.

Compiled kernels are kept in the user's cache, in a folder named after the state of the sources:
numba notices when a kernel's own file has changed, but not when a kernel that it calls has.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

numba: Any = None  # typed by nobody to the same effect in every version
with contextlib.suppress(ImportError):
    numba = importlib.import_module("numba")

F = TypeVar("F", bound=Callable[..., Any])

PACKAGES = ("companion", "sim_link")
"""Those that define kernels."""
KEPT_S = 30.0 * 86400.0
"""How long compiled kernels that nothing uses any more are kept."""


def _sources_digest() -> str:
    """A short name for the sources as they are now, by size and time of change."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parent.parent
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            status = path.stat()
            digest.update(f"{path} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _keep_compiled_apart() -> None:
    """Point numba's cache at a folder for these sources, and drop those long unused."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "companion-guidance"
    current = cache / f"kernels-{_sources_digest()}"
    numba.config.CACHE_DIR = str(current)
    try:
        current.mkdir(parents=True, exist_ok=True)
        os.utime(current)
        newest = current.stat().st_mtime
        for other in cache.glob("kernels-*"):
            if newest - other.stat().st_mtime > KEPT_S:
                shutil.rmtree(other, ignore_errors=True)
    except OSError:
        numba.config.CACHE_DIR = ""


if numba is not None:
    _keep_compiled_apart()

IS_COMPILED: bool = numba is not None and not numba.config.DISABLE_JIT
"""Whether kernels are compiled; then the first call of each takes up to seconds."""


_KERNELS: list[Any] = []


def kernel(function: F) -> F:
    """Compile `function` if numba is there; `function.py_func` is the plain one only then."""
    if numba is None:
        return function
    compiled = numba.njit(cache=True)(function)
    _KERNELS.append(compiled)
    return cast(F, compiled)


def count_compiled() -> int:
    """How many kernels were compiled, or loaded, in this process."""
    return sum(bool(getattr(each, "signatures", ())) for each in _KERNELS)


def has_compiled_cache() -> bool:
    """Whether kernels of these sources were compiled before, so that loading takes a second."""
    folder = os.environ.get("NUMBA_CACHE_DIR") or (numba.config.CACHE_DIR if numba else "")
    return bool(folder) and next(Path(folder).rglob("*.nbi"), None) is not None


Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same array, made read-only before it is stored in a value."""
    array.setflags(write=False)
    return array
