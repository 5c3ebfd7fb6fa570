"""Tests run the kernels as the vehicle does, as plain Python: what is compiled is the same source.

`tests/oracle/test_kernels_compiled.py` compares the two in processes of their own.
"""

from __future__ import annotations

import os

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")
