"""One source of arithmetic: the kernels as plain Python and compiled give the same numbers.

Two processes run `kernel_runs`, one of them with the compiler switched off. After a change of the
sources the other compiles everything anew, which takes half a minute.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.kernel import Matrix
from tests.oracle.kernel_runs import IS_COMPILED

pytestmark = pytest.mark.slow

pytest.importorskip("numba", reason="kernels are compiled only with the extra `fast`")

ROOT = Path(__file__).resolve().parents[2]


def _results(path: Path, *, compiled: bool) -> dict[str, Matrix]:
    jit = {"NUMBA_DISABLE_JIT": "0" if compiled else "1"}
    subprocess.run(
        [sys.executable, "-m", "tests.oracle.kernel_runs", str(path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **jit},
        check=True,
    )
    with np.load(path) as file:
        return dict(file)


def test_plain_and_compiled_kernels_agree(tmp_path: Path) -> None:
    plain = _results(tmp_path / "plain.npz", compiled=False)
    compiled = _results(tmp_path / "compiled.npz", compiled=True)
    assert not plain.pop(IS_COMPILED).any()
    assert compiled.pop(IS_COMPILED).all()
    assert plain.keys() == compiled.keys()
    for name, expected in plain.items():
        np.testing.assert_allclose(compiled[name], expected, rtol=1e-12, atol=1e-15, err_msg=name)
