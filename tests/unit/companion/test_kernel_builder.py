"""Kernels compiled ahead: each call from outside once, under a name of its own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="needs the extra `fast`"),
]

ROOT = Path(__file__).resolve().parents[3]
KERNELS = """
import sys
from pathlib import Path
import numpy as np
from companion.kernel_builder import Recorder, compile_recorded
from companion.kernel_cache import describe, load

@Recorder
def scaled(x, factor):
    return x * factor

@Recorder
def summed(x, factor):
    return scaled(x, 3) + np.dot(x, x) * factor

rows = np.ones(3)
summed(rows, 5), scaled(rows, 4), scaled(rows, 0.5), scaled(np.ones((3, 2)).T[0], 1)
assert [len(each.calls) for each in (scaled, summed)] == [3, 1]
package = Path(sys.argv[1])
describe(package, compile_recorded([scaled, summed], package))
code, variants = load(package)
names = [name for table in variants.values() for name in table.values()]
assert len(set(names)) == len(names) == 4, variants
vector = ("d", 1, 0x401)
by_int, by_float = (
    getattr(code, variants["__main__.scaled"][vector, kind]) for kind in ("int", "float")
)
assert by_int(rows, 7).tolist() == [7.0, 7.0, 7.0]
assert by_float(rows, 0.25).tolist() == [0.25, 0.25, 0.25]
assert getattr(code, variants["__main__.summed"][vector, "int"])(rows, 2).tolist() == [9.0] * 3
"""
TWO_OF_ONE_KEY = """
from companion.kernel_builder import Recorder

@Recorder
def first(pair):
    return pair[0]

first((1.0, 2.0)), first((1, 2))
"""
FLIGHTS = """
from companion import kernel_builder as builder
vars(builder.kernel_module)["kernel"] = builder.Recorder
builder.record_flights()
compiled = {each.name: set(each.calls) for each in builder.Recorder.all}

from pathlib import Path
from companion.config.schema import load_config
from companion.flight_setup import build_planner
from companion.warm_up import warm_up
from tests.loop.golden_flights import FOLDER, SUFFIX, load, replayed

for path in sorted(Path("configs").glob("companion/**/*.yaml")):
    config = load_config(path)
    warm_up(config.tracking, build_planner(config))
for name in ("px4", "fim", "lawnmower", "ekf"):
    replayed(load(FOLDER / f"{name}{SUFFIX}"))
for each in builder.Recorder.all:
    others = set(each.calls) - compiled.get(each.name, set())
    assert not others or each.name.endswith(".target_height_m"), (each.name, others)
"""


def run(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own: the builder sets up numba for the whole process."""
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *words],
        env=dict(os.environ, PYTHONPATH=str(ROOT)),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_each_call_from_outside_has_one_variant_that_computes_the_same(tmp_path: Path) -> None:
    done = run(KERNELS, str(tmp_path))
    assert done.returncode == 0, done.stderr


def test_signatures_that_a_call_cannot_distinguish_are_refused() -> None:
    done = run(TWO_OF_ONE_KEY)
    assert done.returncode == 1
    assert "TypeError: __main__.first: " in done.stderr


def test_flights_call_nothing_that_was_not_compiled_ahead() -> None:
    """Presets and recorded flights; `target_height_m` only reads a number."""
    done = run(FLIGHTS)
    assert done.returncode == 0, done.stderr
