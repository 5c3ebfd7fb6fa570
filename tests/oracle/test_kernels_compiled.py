"""One source of arithmetic: the kernels as plain Python and compiled give the same numbers.

Two processes run `kernel_runs`, one of them with the compiler switched off. After a change of the
sources the other compiles everything again, which takes half a minute.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.kernel import Matrix
from companion.kernel_cache import BUILDER
from tests.oracle.kernel_runs import IS_COMPILED

pytestmark = pytest.mark.slow

pytest.importorskip("numba", reason="kernels are compiled only with the extra `fast`")

ROOT = Path(__file__).resolve().parents[2]


def _run(*words: str, **variables: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    subprocess.run([sys.executable, *words], cwd=ROOT, env=environment, check=True)


def _results(path: Path, *, compiled: bool, ahead: Path | None = None) -> dict[str, Matrix]:
    paths = f"{ahead}:{ROOT}" if ahead else str(ROOT)
    switch = "0" if compiled else "1"
    command = ("-m", "tests.oracle.kernel_runs", str(path))
    _run(*command, PYTHONPATH=paths, NUMBA_DISABLE_JIT=switch)
    with np.load(path) as file:
        return dict(file)


@pytest.mark.campaign
@pytest.mark.skipif(shutil.which("cc") is None, reason="compiling ahead needs a C compiler")
def test_plain_kernels_and_those_compiled_ahead_agree(tmp_path: Path) -> None:
    _run("-W", "ignore", "-m", BUILDER, str(tmp_path))
    is_native = "import companion.kernel as k; assert k.IS_NATIVE and k.numba is None"
    _run("-c", is_native, PYTHONPATH=f"{tmp_path}:{ROOT}", NUMBA_DISABLE_JIT="0")
    plain = _results(tmp_path / "plain.npz", compiled=False)
    ahead = _results(tmp_path / "ahead.npz", compiled=True, ahead=tmp_path)
    assert plain.keys() == ahead.keys()
    for name, expected in plain.items():
        np.testing.assert_allclose(ahead[name], expected, rtol=1e-12, atol=1e-15, err_msg=name)


def test_plain_and_compiled_kernels_agree(tmp_path: Path) -> None:
    plain = _results(tmp_path / "plain.npz", compiled=False)
    compiled = _results(tmp_path / "compiled.npz", compiled=True)
    assert not plain.pop(IS_COMPILED).any()
    assert compiled.pop(IS_COMPILED).all()
    assert plain.keys() == compiled.keys()
    for name, expected in plain.items():
        np.testing.assert_allclose(compiled[name], expected, rtol=1e-12, atol=1e-15, err_msg=name)
