"""The flying thread's scheduling, each in a process of its own: what is granted stays with it."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
from collections.abc import Callable

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux scheduling")
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23
"""Numbers from linux/prctl.h and linux/capability.h."""
SHOW = """
import os, subprocess, sys, threading, time
from companion.diagnostics import raised_priority

def policy():
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK

child = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0), os.nice(0))"]
with raised_priority() as text:
    print(text, policy(), os.getpriority(os.PRIO_PROCESS, 0), sep="|")
    seen = []
    thread = threading.Thread(target=lambda: seen.append((policy(), os.nice(0) < 0)))
    thread.start()
    thread.join()
    print(*seen)
    print(subprocess.run(child, capture_output=True, text=True, check=True).stdout.strip())
print(policy(), os.nice(0))
"""
REFUSING = """
import os

permitted = os.setpriority

def refuse(*_):
    raise PermissionError

def refuse_below(which, who, niceness):
    permitted(which, who, niceness) if niceness >= %d else refuse()

os.sched_setscheduler, os.setpriority = refuse, refuse_below
"""
RUN_ON = """
import logging, os, time
from companion import diagnostics

logging.basicConfig(format="%(message)s")
diagnostics.LONGEST_RUN_S = 0.2
with diagnostics.raised_priority():
    began_s = time.process_time()
    while time.process_time() - began_s < 0.5:
        pass
    print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
"""
IS_ROOT = os.geteuid() == 0
by_root = pytest.mark.skipif(not IS_ROOT, reason="only root is granted a higher priority")


def without_privilege() -> None:
    """Become a process without privileges, whose limits allow nothing."""
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_NICE, (0, 0))
    if IS_ROOT:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0)


def run(code: str, become: Callable[[], None] | None = None) -> tuple[list[str], str]:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, preexec_fn=become
    )
    return done.stdout.splitlines(), done.stderr


def test_a_user_without_permission_flies_with_normal_priority() -> None:
    (first, *_, last), errors = run(SHOW, without_privilege)
    assert first == f"None|{os.SCHED_OTHER}|0"
    assert last == f"{os.SCHED_OTHER} 0"
    assert errors == ""


@by_root
def test_real_time_priority_is_taken_where_allowed_and_not_inherited() -> None:
    (first, thread, child, last), errors = run(SHOW)
    assert first == f"real-time priority 1|{os.SCHED_RR}|-10"
    assert thread == f"({os.SCHED_OTHER}, False)"
    assert child == last == f"{os.SCHED_OTHER} 0"
    assert errors == ""


@by_root
@pytest.mark.parametrize(("allowed", "taken"), [(-10, -10), (-20, -10), (-3, -3)])
def test_else_the_lowest_niceness_that_is_allowed(allowed: int, taken: int) -> None:
    (first, *_, last), _ = run(REFUSING % allowed + SHOW)
    assert first == f"nice {taken}|{os.SCHED_OTHER}|{taken}"
    assert last == f"{os.SCHED_OTHER} 0"


@by_root
def test_a_computation_that_does_not_end_loses_its_priority() -> None:
    (policy,), errors = run(RUN_ON)
    assert policy == str(os.SCHED_OTHER)
    assert errors.startswith("computed for 0.2 s without a wait: normal priority")
