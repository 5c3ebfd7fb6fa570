"""Compiles the kernels ahead of time, so that a flight loads neither numba nor LLVM.

    .venv/bin/python tools/release/build_kernels.py FOLDER

writes the package `companion_kernels` into FOLDER, for this Python and this kind of processor; if
it is on the path beside `companion`, `companion.kernel` finds it. Warm-ups with every preset,
filter and planner determine a kernel's argument types; any others run as plain Python.

Needs numba, a C compiler and some five minutes of one core. It uses only instructions that every
processor of the kind has. Products and solutions of these small matrices are compiled from loops,
because numba would ask scipy for its BLAS.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import importlib
import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

os.environ |= {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="kernels-")

import msgspec
import numba
import numpy as np
from numba import types

from companion.entry import ignore_broken_pipe

CC: Any = importlib.import_module("numba.pycc").CC  # has no type hints
ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "companion_kernels"
Variants = dict[str, dict[tuple[object, ...], str]]
"""Exported names, by kernel and by the kinds of its arguments."""
WRITEABLE_C, READ_ONLY_C = 0x401, 0x001
"""Flags of numpy: C order, and whether it may be written to."""


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


def main() -> int:
    """Build the package and print the number of kernels."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    place = parser.parse_args().folder / PACKAGE
    place.mkdir(parents=True, exist_ok=True)
    from companion.kernel import KERNELS, sources_digest

    import_kernels()
    for function in KERNELS:
        function.py_func.__globals__["np"] = numpy_without_blas()
    warm_everything_up()
    compiler = CC("_native")
    compiler.output_dir = str(place)
    variants = export_variants(compiler, KERNELS)
    compile_reproducibly(compiler)
    for module in place.glob("_native.*.so"):  # names of the folders that it was compiled in
        subprocess.run(["strip", "--strip-unneeded", str(module)], check=True)
    text = f'"""Kernels compiled by tools/release/{Path(__file__).name}."""\n\n'
    text += f"DIGEST = {sources_digest()!r}\nTOOL = {digest_of_tool()!r}\n"
    text += f"VARIANTS = {variants!r}\n"
    (place / "__init__.py").write_text(text)
    print(f"{place}: {len(variants)} kernels, {sum(map(len, variants.values()))} variants")
    return 0


def export_variants(compiler: Any, kernels: Iterable[Any]) -> Variants:
    """Export every signature that was called, each under a name of its own.

    A literal argument (an int known while its caller was compiled) counts as its type: at run time
    `companion.kernel.kind_of` sees no difference.

    Raises:
        SystemExit: a kernel has two signatures that `kind_of` cannot distinguish.
    """
    variants: Variants = {}
    numbers = itertools.count()
    for function in (each for each in kernels if each.nopython_signatures):
        plain = function.py_func
        kernel = f"{plain.__module__}.{plain.__name__}"
        signatures: dict[tuple[object, ...], tuple[Any, ...]] = {}
        for signature in function.nopython_signatures:
            arguments = tuple(map(types.unliteral, signature.args))
            key = tuple(map(kind_of, arguments))
            if signatures.setdefault(key, arguments) != arguments:
                raise SystemExit(f"{kernel}: {arguments} and {signatures[key]} have one key, {key}")
        variants[kernel] = {key: f"k{next(numbers)}" for key in signatures}
        for key, name in variants[kernel].items():
            compiler.export(name, signatures[key])(plain)
    return variants


def digest_of_tool() -> str:
    """Return a short digest of this file, because another version's kernels must be rebuilt."""
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]


def compile_reproducibly(compiler: Any) -> None:
    """Compile without the names of inner functions: some contain an address of this process."""
    with tempfile.NamedTemporaryFile("w", suffix=".map") as exported:
        exported.write("{ global: PyInit_*; local: *; };")
        exported.flush()
        flags = (f"-Wl,--version-script={exported.name}", "-Wl,--build-id=none")
        compiler._get_extra_ldflags = lambda: flags
        compiler.compile()


def import_kernels() -> None:
    """Import every module that a flight may need."""
    import companion.flight_setup
    import companion.warm_up  # noqa: F401


@functools.cache
def numpy_without_blas() -> ModuleType:
    """Return a numpy with the two functions above, for the modules of the kernels."""
    changed, algebra = ModuleType("numpy"), ModuleType("numpy.linalg")
    vars(algebra).update(vars(np.linalg), solve=solve)
    vars(changed).update(vars(np), dot=dot, linalg=algebra)
    return changed


def warm_everything_up() -> None:
    """Call every kernel as flights do."""
    from companion.flight_setup import build_planner
    from companion.warm_up import warm_up

    for number, config in enumerate(configurations()):
        warm_up(config.tracking, build_planner(config))
        print(f"\r{number + 1} configurations", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)


def configurations() -> Iterator[Any]:
    """Yield the presets, and the defaults with every filter and planner."""
    from companion.config.schema import CompanionConfig, CrossingKind, load_config
    from companion.estimation.filters.kalman import FilterKind

    for folder in ("companion", "radios"):
        for path in sorted((ROOT / "configs" / folder).rglob("*.yaml")):
            yield load_config(path)
    replace, default = msgspec.structs.replace, CompanionConfig()
    for kind in get_args(FilterKind):
        yield replace(default, estimation=replace(default.estimation, kind=kind))
    for kind in get_args(CrossingKind):
        yield replace(default, planner=replace(default.planner, kind=kind))


def kind_of(kind: Any) -> object:
    """Return the result of `companion.kernel.kind_of` for an argument of a numba type."""
    if isinstance(kind, types.Array):
        is_c = kind.layout == "C"
        flags = (WRITEABLE_C if kind.mutable else READ_ONLY_C) if is_c else -1
        return np.dtype(str(kind.dtype)).char, kind.ndim, flags
    named = getattr(kind, "instance_class", None)
    if named is not None:
        return f"{named.__module__}.{named.__qualname__}"
    if isinstance(kind, types.BaseTuple):
        return f"tuple {len(kind)}"
    names = {types.Float: "float", types.Integer: "int", types.Boolean: "bool"}
    return next(name for base, name in names.items() if isinstance(kind, base))


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
