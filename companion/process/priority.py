"""Scheduling priority of the thread that flies: requested at the start, given up where it harms.

Theory of operation. Real-time priority, even the lowest, goes before every program of normal
priority, so that none of them makes a setpoint late. Only the main thread gets it: a thread or
process that it starts begins with normal priority (SCHED_RESET_ON_FORK), so that log writers, the
threads of numba and the live map do not compete with it. A computation that does not end would keep
the shell and the network from that core; after `LONGEST_RUN_S` without a wait the kernel sends
SIGXCPU, and the thread goes on with normal priority.

Source: Linux sched(7) and getrlimit(2).
"""

from __future__ import annotations

import logging
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

LOWEST_REAL_TIME = 1
NICENESS = -10
LONGEST_RUN_S = 1.0
"""Processor time. A loop that is due every 50 ms has stalled by then, whatever its priority."""
RLIMIT_RTTIME = 15
"""Microseconds of processor time between two waits; Python's `resource` has no name for it."""
NORMAL_PRIORITY = "normal priority: on a busy computer setpoints may come late"
HOW_TO_ALLOW = "run it as the service, or type before: sudo prlimit --pid $$ --rtprio=1"

log = logging.getLogger("companion.process")


@contextmanager
def raised_priority() -> Iterator[str | None]:
    """Give the main thread the highest priority that the system grants, until the end.

    Yields:
        A description of it; None where it is that of any other program.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and sys.platform.startswith("linux")):
        yield None
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    limits, handler = resource.getrlimit(RLIMIT_RTTIME), signal.getsignal(signal.SIGXCPU)
    _become_nice()
    _become_real_time()
    try:
        yield _description()
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
        with suppress(OSError, ValueError):
            os.sched_setscheduler(0, policy, parameters)
            resource.setrlimit(RLIMIT_RTTIME, limits)
        signal.signal(signal.SIGXCPU, handler)


def _become_nice() -> None:
    """Take the lowest niceness that is allowed; it counts where real-time priority is refused."""
    for niceness in range(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)):
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, niceness)
            return


def _become_real_time() -> None:
    signal.signal(signal.SIGXCPU, _become_normal)
    with suppress(OSError, ValueError):
        _, most = resource.getrlimit(RLIMIT_RTTIME)
        resource.setrlimit(RLIMIT_RTTIME, (round(1e6 * LONGEST_RUN_S), most))
        priority = max(LOWEST_REAL_TIME, os.sched_getparam(0).sched_priority)
        policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))


def _become_normal(*_: object) -> None:
    os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    log.warning("computed for %g s without a wait: %s", LONGEST_RUN_S, NORMAL_PRIORITY)


def _description() -> str | None:
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_RR, os.SCHED_FIFO):
        return f"real-time priority {os.sched_getparam(0).sched_priority}"
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    return f"nice {niceness}" if niceness < 0 else None
