"""The studies' loop compiled against the same loop in plain Python, in another process."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.kernel import Matrix
from sim_link.world.environment import ObstacleParams
from tools.study.case import Case, run_seeds
from tools.study.systems import system_named
from tools.study.trials import run_block

pytestmark = pytest.mark.slow

SYSTEMS = (
    "ekf/passive",
    "asymmetric_huber/latched",
    "admm/fim",
    "huber/reactive",
    "map/latched",
    "huber/fim_printed",
)
BLOCK = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))


def records() -> Matrix:
    """Two short runs of every kind of filter and planner."""
    cases = (Case(steps=60), Case(steps=60, obstacles=(BLOCK,)))
    trials = [
        run_block(case, system_named(name), run_seeds(4, 2)) for name in SYSTEMS for case in cases
    ]
    return np.array([[trial.record for trial in pair] for pair in trials])


@pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="numba is not installed")
def test_compiled_and_plain_walks_agree(tmp_path: Path) -> None:
    path = tmp_path / "plain.npy"
    subprocess.run(
        [sys.executable, __file__, str(path)],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.getcwd()},
        check=True,
    )
    np.testing.assert_allclose(records(), np.load(path), rtol=1e-9, atol=1e-9)


if __name__ == "__main__":
    np.save(sys.argv[1], records())
