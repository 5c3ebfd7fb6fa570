"""Environment and fixtures of every test.

Kernels run as the vehicle runs them, as plain Python: what is compiled is the same source
(`tests/oracle/test_kernels_compiled.py` compares the two in processes of their own). Checkpoints
and locks of companions that are started go to a folder of their own, which is removed at the end.
Modules that wait for real processes are spread among those that calculate, and a worker more than
there are cores fills the time of their waiting. An example of hypothesis may take as long as a busy
machine makes it.
"""

from __future__ import annotations

import gc
import itertools
import logging
import os
import shutil
import signal
import tempfile
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
gc.disable()  # while tests are collected: a fifth of that time

settings.register_profile(
    "busy machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("busy machine")

_STATE = tempfile.mkdtemp(prefix="companion-tests-")
os.environ["XDG_STATE_HOME"] = _STATE
_WAITING = Path(__file__).parent / "e2e"


def pytest_unconfigure() -> None:
    """Remove that folder, in every worker, too; they end without running what `atexit` keeps."""
    shutil.rmtree(_STATE, ignore_errors=True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """Leave logging as it was: commands that a test calls set it up for their whole process."""
    ours = logging.getLogger("companion")
    before = (ours.propagate, ours.level, list(ours.handlers), logging.root.manager.disable)
    try:
        return (yield)
    finally:
        ours.propagate, ours.level, ours.handlers, level = before
        logging.disable(level)


@pytest.hookimpl
def pytest_collection_finish() -> None:
    """Thousands of tests are kept to the end: the collector need not look at them every time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)  # a twentieth of the time of a flight
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers that `-n auto` starts."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the modules that wait: workers get tests in long pieces, one would get all of them."""
    modules = [list(module) for _, module in itertools.groupby(items, lambda item: item.path)]
    waiting = [module for module in modules if module[0].path.is_relative_to(_WAITING)]
    others = [module for module in modules if not module[0].path.is_relative_to(_WAITING)]
    every = max(1, len(others) // (len(waiting) + 1))
    order: list[list[pytest.Item]] = []
    for number, module in enumerate(others, start=1):
        order.append(module)
        if number % every == 0 and waiting:
            order.append(waiting.pop(0))
    items[:] = itertools.chain.from_iterable(order + waiting)
