"""Kernels compiled ahead of time: each signature once, under a name of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
KERNELS = """
import sys
import numba, numpy as np
from types import SimpleNamespace
from tools.release.build_kernels import CC, export_variants

@numba.njit
def scaled(x, factor):
    return x * factor

@numba.njit
def shifted(x, factor):
    return scaled(x, 2) + factor

@numba.njit
def summed(x, factor):
    return scaled(x, 3) + shifted(x, factor)

rows = np.ones(3)
summed(rows, 5), scaled(rows, 4), scaled(rows, 0.5), shifted(rows, 1)
compiler = CC("_native")
compiler.output_dir = sys.argv[1]
variants = export_variants(compiler, [scaled, shifted, summed])
compiler.compile()
sys.path.insert(0, sys.argv[1])
import _native
names = [name for table in variants.values() for name in table.values()]
assert len(set(names)) == len(names) == 4, variants
by_int, by_float = (
    getattr(_native, variants["__main__.scaled"][("d", 1, 0x401), kind])
    for kind in ("int", "float")
)
assert by_int(rows, 7).tolist() == [7.0, 7.0, 7.0]
assert by_float(rows, 0.25).tolist() == [0.25, 0.25, 0.25]
"""
TWO_OF_ONE_KEY = """
import numba
from tools.release.build_kernels import export_variants

@numba.njit
def first(pair):
    return pair[0]

first((1.0, 2.0)), first((1, 2))
export_variants(None, [first])
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run it in a process of its own: the tool sets up numba for the whole process."""
    environment = dict(os.environ, PYTHONPATH=str(ROOT), NUMBA_DISABLE_JIT="0")
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, str(folder)],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_literal_arguments_share_one_variant_and_names_do_not_collide(tmp_path: Path) -> None:
    """An int that is known while compiling is typed as a literal: one key with any other int."""
    done = run(KERNELS, tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_signatures_that_a_call_could_not_tell_apart_are_refused(tmp_path: Path) -> None:
    done = run(TWO_OF_ONE_KEY, tmp_path)
    assert done.returncode == 1
    assert "__main__.first: " in done.stderr
    assert "have one key" in done.stderr
