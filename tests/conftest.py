"""What holds for every test.

Kernels run as the vehicle runs them, as plain Python: what is compiled is the same source
(`tests/oracle/test_kernels_compiled.py` compares the two in processes of their own). Checkpoints
and locks of companions that are started go to a place of their own, which is removed at the end.
"""

from __future__ import annotations

import os
import shutil
import tempfile

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")

_STATE = tempfile.mkdtemp(prefix="companion-tests-")
os.environ["XDG_STATE_HOME"] = _STATE


def pytest_unconfigure() -> None:
    """Remove that place, in every worker, too; they end without running what `atexit` keeps."""
    shutil.rmtree(_STATE, ignore_errors=True)
