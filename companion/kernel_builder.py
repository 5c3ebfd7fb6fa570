"""Compiles the kernels ahead of time, so that a flight loads neither numba nor LLVM.

    python -m companion.kernel_builder FOLDER

writes `companion_kernels` into FOLDER, for this Python and this kind of processor. `companion
warm-up` runs it for the user's cache, `make deb` for the Debian package.

First flights of every filter, planner and antenna are made in plain Python, and each call of a
kernel from outside the kernels is recorded with the types of its arguments; any others run as plain
Python. Then those are compiled, together with the kernels that they call. It uses only instructions
that every processor of the kind has. Products and solutions of these small matrices are compiled
from loops, because numba would ask scipy for its BLAS.

Needs numba, setuptools, a C compiler, 500 MB of memory and some half a minute of one core.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, get_args

os.environ.pop("NUMBA_DISABLE_JIT", None)
os.environ |= {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_OPT": "1"}

import msgspec
import numba
import numpy as np

from companion import kernel as kernel_module
from companion.kernel import kind_of
from companion.kernel_cache import CODE, PACKAGE, Variants, describe

typeof: Any = numba.typeof  # has no type hints


class Recorder:
    """Kernel in plain Python that records the types of its arguments, when called from outside."""

    depth = 0
    """Number of kernels that are being called."""
    all: ClassVar[list[Recorder]] = []

    def __init__(self, plain: Callable[..., Any]) -> None:
        functools.update_wrapper(self, plain)
        self.plain = plain
        self.calls: dict[tuple[object, ...], tuple[Any, ...]] = {}
        """numba's types of the arguments, by their kinds."""
        Recorder.all.append(self)

    @property
    def name(self) -> str:
        """Return the name of the kernel, with its module."""
        return f"{self.plain.__module__}.{self.plain.__name__}"

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel; `TypeError`: with other types that `kind_of` cannot distinguish."""
        if Recorder.depth == 0:
            key, signature = tuple(map(kind_of, arguments)), tuple(map(type_of, arguments))
            if self.calls.setdefault(key, signature) != signature:
                raise TypeError(f"{self.name}: {signature} and {self.calls[key]} are one: {key}")
        Recorder.depth += 1
        try:
            return self.plain(*arguments)
        finally:
            Recorder.depth -= 1


def type_of(argument: Any) -> Any:
    """Return numba's type of an argument, one for all arrays that are not in C order."""
    kind: Any = typeof(argument)
    is_fortran = isinstance(kind, numba.types.Array) and kind.layout == "F"
    return kind.copy(layout="A") if is_fortran else kind


def main() -> int:
    """Compile the kernels of recorded flights into a package in the given folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    package = parser.parse_args().folder / PACKAGE
    package.mkdir(parents=True, exist_ok=True)
    vars(kernel_module)["kernel"] = Recorder  # before a module with kernels is imported
    record_flights()
    variants = compile_recorded(Recorder.all, package)
    describe(package, variants)
    return 0


def record_flights() -> None:
    """Call every kernel as flights do."""
    from companion.flight_setup import build_planner
    from companion.warm_up import warm_up

    for config in configurations():
        warm_up(config.tracking, build_planner(config))


def configurations() -> Iterator[Any]:
    """Yield the defaults, and those with every filter, planner and antenna, and with power."""
    from companion.config.schema import CompanionConfig, CrossingKind
    from companion.estimation.antenna import AntennaKind
    from companion.estimation.filters.kalman import FilterKind

    replace, default = msgspec.structs.replace, CompanionConfig()
    estimation, used = default.estimation, default.estimation.filter
    yield default
    for filter_kind in get_args(FilterKind):
        yield replace(default, estimation=replace(estimation, kind=filter_kind))
    for antenna_kind in get_args(AntennaKind):
        antenna = replace(used.antenna, kind=antenna_kind)
        yield replace(
            default, estimation=replace(estimation, filter=replace(used, antenna=antenna))
        )
    with_power = replace(estimation, filter=replace(used, power_at_1m_dbm=0.0))
    yield replace(default, estimation=with_power)
    for planner_kind in get_args(CrossingKind):
        yield replace(default, planner=replace(default.planner, kind=planner_kind))


def compile_recorded(recorders: Iterable[Recorder], package: Path) -> Variants:
    """Compile each kernel for the recorded types, under separate names."""
    compiler: Any = importlib.import_module("numba.pycc").CC(CODE)  # has no type hints
    compiler.output_dir = str(package)
    called = [each for each in recorders if each.calls]
    variants: Variants = {
        each.name: {key: f"k{number}_{n}" for n, key in enumerate(each.calls)}
        for number, each in enumerate(called)
    }
    call_compiled(recorders)
    for each in called:
        for key, exported in variants[each.name].items():
            compiler.export(exported, each.calls[key])(each.plain)
    compile_reproducibly(compiler)
    for module in package.glob(f"{CODE}.*.so"):  # names of the folders that it was compiled in
        if shutil.which("strip") and sys.platform == "linux":
            subprocess.run(["strip", "--strip-unneeded", str(module)], check=True)
    return variants


def call_compiled(recorders: Iterable[Recorder]) -> None:
    """Let kernels call each other as numba's, and numpy without its BLAS."""
    compiled = {id(each): numba.njit(each.plain) for each in recorders}
    for each in recorders:
        each.plain.__globals__["np"] = numpy_without_blas()
    for module in list(sys.modules.values()):
        for name, value in list(vars(module).items()):
            if id(value) in compiled:
                setattr(module, name, compiled[id(value)])


def compile_reproducibly(compiler: Any) -> None:
    """Compile without the names of inner functions: some contain an address of this process."""
    with tempfile.NamedTemporaryFile("w", suffix=".map") as exported:
        exported.write("{ global: PyInit_*; local: *; };")
        exported.flush()
        flags = (f"-Wl,--version-script={exported.name}", "-Wl,--build-id=none")
        if sys.platform == "linux":  # options of its linker
            compiler._get_extra_ldflags = lambda: flags
        compiler.compile()


@functools.cache
def numpy_without_blas() -> ModuleType:
    """Return a numpy with the two functions below, for the modules of the kernels."""
    changed, algebra = ModuleType("numpy"), ModuleType("numpy.linalg")
    vars(algebra).update(vars(np.linalg), solve=solve)
    vars(changed).update(vars(np), dot=dot, linalg=algebra)
    return changed


@numba.njit
def dot(a: Any, b: Any) -> Any:
    """Return `np.dot` of vectors and matrices, by entries."""
    if a.ndim == 1:
        total = 0.0
        for k in range(a.size):
            total += a[k] * b[k]
        return total
    if b.ndim == 1:
        vector = np.zeros(a.shape[0])
        for i in range(a.shape[0]):
            for k in range(a.shape[1]):
                vector[i] += a[i, k] * b[k]
        return vector
    matrix = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                matrix[i, j] += a[i, k] * b[k, j]
    return matrix


@numba.njit
def solve(matrix: Any, right: Any) -> Any:
    """Return `np.linalg.solve`, by elimination with partial pivoting."""
    n = matrix.shape[0]
    rows, x = matrix.copy(), right.copy()
    for column in range(n):
        pivot = column + np.argmax(np.abs(rows[column:, column]))
        if rows[pivot, column] == 0.0:
            raise np.linalg.LinAlgError("Matrix is singular to machine precision.")
        if pivot != column:
            rows[pivot], rows[column] = rows[column].copy(), rows[pivot].copy()
            x[pivot], x[column] = x[column], x[pivot]
        for row in range(column + 1, n):
            factor = rows[row, column] / rows[column, column]
            rows[row, column:] -= factor * rows[column, column:]
            x[row] -= factor * x[column]
    for row in range(n - 1, -1, -1):
        for column in range(row + 1, n):
            x[row] -= rows[row, column] * x[column]
        x[row] /= rows[row, row]
    return x


if __name__ == "__main__":
    sys.exit(main())
