"""Health of the process: diagnostics of it and its links, service manager, watchdog, priority.

Diagnostics. Memory, descriptors, threads and processor time are read from /proc where there is one,
otherwise where the standard library provides them. A link that refuses frames is reported; a
refused frame is not sent again: the next control tick sends a newer one.

Service manager (`sd_notify`). It is notified that the process is ready, alive or stopping, and of
its status: datagrams of `KEY=VALUE` lines to the socket named by NOTIFY_SOCKET, a path or, with a
leading `@`, a name in the abstract namespace. Nothing is sent if the variable is not set. The
socket never blocks: a manager that does not read loses notifications and costs no time.

The watchdog is fed only when every part of the process responded: the control tick (it ran since
the last feed; this code itself runs on its thread), the writers of logs and checkpoints (their
threads are alive; a disk that hangs is not a reason to kill a flight), and the links (open).

Source: sd_notify(3), sd_watchdog_enabled(3); of the rule: NASA F Prime, Svc/Health, HTH-007.

Real-time priority, even the lowest, has precedence over every program of normal priority, so that
none of them delays a setpoint. Only the main thread gets it: a thread or process that it starts
begins with normal priority (SCHED_RESET_ON_FORK), so that log writers, the threads of numba and the
live map do not compete with it. A computation that does not end would keep the shell and the
network from that core; after `LONGEST_RUN_S` without a wait the kernel sends SIGXCPU, and the
thread continues with normal priority.

Source: Linux sched(7) and getrlimit(2).
"""

from __future__ import annotations

import logging
import math
import os
import resource
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from companion.guidance.commands import Severity
from companion.guidance.events import ProcessMessage
from companion.io.checkpoints import CheckpointStore
from companion.io.files import BackgroundReplacer
from companion.io.flight_recorder import BlackBox
from companion.io.links.byte_streams import StreamLink
from companion.io.links.link import Link
from companion.io.shell import TimerStatistics
from companion.link.endpoint import CompanionEndpoint
from companion.link.intake import RateLimit
from companion.link.interface import Journal

_STATM = Path("/proc/self/statm")
_DESCRIPTORS = Path("/proc/self/fd")


@dataclass(frozen=True, slots=True)
class ProcessUse:
    """Resources of the process at a moment."""

    resident_mb: float
    """Current memory in RAM; the peak if the system does not report it."""
    descriptors: int | None
    """Open files and sockets; None if the system does not report them."""
    threads: int
    processor_s: float
    """User and system time since the start."""


def process_use() -> ProcessUse:
    """Return the current resources of this process."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resident_mb = peak / 1e6 if os.uname().sysname == "Darwin" else peak / 1e3
    descriptors = None
    with suppress(OSError, ValueError, IndexError):
        pages = int(_STATM.read_text().split()[1])
        resident_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        descriptors = len(os.listdir(_DESCRIPTORS)) - 1  # without the descriptor that lists them
    return ProcessUse(
        resident_mb=round(resident_mb, 3),
        descriptors=descriptors,
        threads=threading.active_count(),
        processor_s=round(time.process_time(), 3),
    )


RECORD_PERIOD_S = 10.0
CHECK_PERIOD_S = 0.5
SILENT_DISK_S = 2.0
MISSED_TICKS = 10
"""Ticks missed within a period before this is reported."""
TICK_S = 0.05


@dataclass(frozen=True, slots=True)
class ProcessParts:
    """Parts of the process besides the endpoint."""

    journal: BlackBox
    timing: TimerStatistics
    links: Sequence[Link]
    store: CheckpointStore | None
    """Store of the checkpoints; None if none are kept."""

    @property
    def checkpoint_writer(self) -> BackgroundReplacer | None:
        """Return the writer of checkpoints; None before the first one was saved."""
        return None if self.store is None else self.store.writer


class ProcessDiagnostics:
    """Counts, records and reports; `speed` is seconds of the clock per wall second."""

    def __init__(self, endpoint: CompanionEndpoint, parts: ProcessParts, speed: float) -> None:
        self._endpoint = endpoint
        self._parts = parts
        self._journal = parts.journal
        self._timing = parts.timing
        self._speed = speed
        self._next_s = self._next_check_s = -math.inf
        self._reported_dropped = 0
        self._is_disk_silent = False
        self._late_total_s = 0.0

    def run(self, now_s: float) -> None:
        """Record and report the figures that are due."""
        wall_s = now_s / self._speed
        if wall_s >= self._next_check_s:
            self._next_check_s = wall_s + CHECK_PERIOD_S
            self._check_disk(now_s)
        if wall_s < self._next_s:
            return
        self._next_s = wall_s + RECORD_PERIOD_S
        self._check_losses(now_s)
        missed = round((self._timing.late_total_s - self._late_total_s) / TICK_S)
        self._late_total_s = self._timing.late_total_s
        if missed > MISSED_TICKS:
            text = f"computer too slow: {missed} control ticks missed in 10 s"
            self._announce(Severity.WARNING, text, now_s)
        self._journal.record("process", self._record(), now_s)
        self._timing.worst_late_s = 0.0

    def _record(self) -> dict[str, object]:
        health, timing = self._journal.health, self._timing
        record: dict[str, object] = {
            **asdict(process_use()),
            "log_queued": health.queued,
            "log_dropped": health.dropped,
            "log_mb": round(health.bytes_kept / 1e6, 3),
            "disk_silent_s": round(health.silent_s, 3),
            "ticks": timing.fired,
            "late_ticks": timing.late,
            "missed_ticks": round(timing.late_total_s / TICK_S),
            "worst_late_s": round(timing.worst_late_s, 4),
            "stalls": timing.stalls,
            "links": [{"name": link.name, **asdict(link.counters)} for link in self._parts.links],
        }
        writer = self._parts.checkpoint_writer
        if writer is not None:
            record["checkpoints"] = {
                "written": writer.written,
                "failed": writer.failed,
                "overtaken": writer.overtaken,
            }
        return record

    def _check_disk(self, now_s: float) -> None:
        is_silent = self._journal.health.silent_s > SILENT_DISK_S
        if is_silent is self._is_disk_silent:
            return
        self._is_disk_silent = is_silent
        if is_silent:
            text = (
                f"the disk has not responded for {SILENT_DISK_S:g} s: "
                "the flight continues, the log waits"
            )
            self._announce(Severity.WARNING, text, now_s)
        else:
            self._announce(Severity.NOTICE, "the disk responds again", now_s)

    def _check_losses(self, now_s: float) -> None:
        dropped = self._journal.health.dropped
        writer = self._parts.checkpoint_writer
        dropped += 0 if writer is None else writer.failed
        if dropped > self._reported_dropped:
            self._reported_dropped = dropped
            text = (
                f"{dropped} log entries lost: the disk is full, broken or too slow; the flight "
                "continues"
            )
            self._announce(Severity.WARNING, text, now_s)

    def _announce(self, severity: Severity, text: str, now_s: float) -> None:
        self._endpoint.handle_event(ProcessMessage(now_s, severity, text))


LINK_CHECK_PERIOD_S = 1.0
LINK_RECORD_PERIOD_S = 10.0
LINK_TEXTS_PER_S = 0.1


class LinkWatch:
    """Checks the counters of a link once a second."""

    def __init__(self, links: Sequence[Link], journal: Journal) -> None:
        self._links = links
        self._journal = journal
        self._reported = [(0, 0) for _ in links]
        self._may_report = [RateLimit(LINK_TEXTS_PER_S) for _ in links]
        self._next_check_s = 0.0
        self._next_record_s = 0.0

    def check(self, now_s: float) -> None:
        """Announce changes of the links' counters, and record all counters, each at its period."""
        if now_s < self._next_check_s:
            return
        self._next_check_s = now_s + LINK_CHECK_PERIOD_S
        for number, link in enumerate(self._links):
            self._check(number, link, now_s)
        if now_s >= self._next_record_s:
            self._next_record_s = now_s + LINK_RECORD_PERIOD_S
            fields = {link.name: asdict(link.counters) for link in self._links}
            self._journal.record("io", fields, now_s)

    def _check(self, number: int, link: Link, now_s: float) -> None:
        counters, (errors, dropped) = link.counters, self._reported[number]
        is_slow = isinstance(link, StreamLink) and link.is_connected
        if not is_slow:  # no peer is connected: dropping is expected
            dropped = counters.dropped
        refused, lost = counters.send_errors - errors, counters.dropped - dropped
        if not refused and not lost:
            self._reported[number] = (errors, dropped)
            return
        if not self._may_report[number].acquire(now_s):
            return
        self._reported[number] = (counters.send_errors, counters.dropped)
        parts = []
        if refused:
            parts.append(f"the system rejected {refused} frames ({counters.last_error})")
        if lost:
            parts.append(f"{lost} frames dropped, the link is too slow")
        self._journal.text(Severity.WARNING, f"{link.name}: {'; '.join(parts)}", now_s)


MICROSECONDS = 1e6
MAX_STATUS = 200
READY, ALIVE, STOPPING = "READY=1", "WATCHDOG=1", "STOPPING=1"


class Supervisor:
    """Connection to the service manager, if there is one."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.failed = 0
        """Notifications that could not be sent."""
        self.watchdog_s = _watchdog_s(environment)
        """The manager restarts the process after silence this long; None: no watchdog."""
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @property
    def is_there(self) -> bool:
        """Return True if there is a service manager to notify."""
        return self._socket is not None

    def status(self, text: str) -> None:
        """Set the status line of `systemctl status`."""
        self.notify(f"STATUS={' '.join(text.split())[:MAX_STATUS]}")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def notify(self, words: str) -> None:
        """Notify the service manager, if it listens."""
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(words.encode("utf-8", errors="replace"), self._address)
        except OSError:
            self.failed += 1


def _address(text: str) -> bytes | None:
    if text.startswith("@") and len(text) > 1:
        return b"\0" + os.fsencode(text[1:])
    return os.fsencode(text) if text.startswith("/") else None


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """Return WATCHDOG_USEC in seconds; None if absent, invalid or for another process."""
    microseconds, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not (microseconds.isascii() and microseconds.isdigit() and int(microseconds) > 0):
        return None
    if process is not None and process != str(os.getpid()):
        return None
    return int(microseconds) / MICROSECONDS


FEEDS_PER_TIMEOUT = 4.0
"""Times that the watchdog is fed within the manager's timeout."""
STATUS_PERIOD_S = 1.0


class Watchdog:
    """Feeds the manager's watchdog and reports the status."""

    def __init__(
        self, supervisor: Supervisor, endpoint: CompanionEndpoint, parts: ProcessParts
    ) -> None:
        self._supervisor = supervisor
        self._endpoint = endpoint
        self._parts = parts
        self._timing = parts.timing
        self._is_ready = False
        self._ticks = 0
        self._next_feed_s = 0.0
        self._next_status_s = 0.0
        self._status = ""

    def run(self, now_s: float, wall_s: float) -> None:
        """Send what is due; `wall_s` is monotonic."""
        if not self._supervisor.is_there or self._timing.fired == 0:
            return
        if not self._is_ready:
            self._is_ready = True
            self._supervisor.notify(READY)
        if wall_s < min(self._next_feed_s, self._next_status_s):
            return
        missing = self.missing()
        if wall_s >= self._next_feed_s and missing is None:
            timeout_s = self._supervisor.watchdog_s or STATUS_PERIOD_S
            self._next_feed_s = wall_s + timeout_s / FEEDS_PER_TIMEOUT
            self._ticks = self._timing.fired
            self._supervisor.notify(ALIVE)
        if wall_s >= self._next_status_s:
            self._next_status_s = wall_s + STATUS_PERIOD_S
            status = self._endpoint.session.status(now_s)
            text = f"{status.phase.value}: {status.detail}" if status.detail else status.phase.value
            if missing is not None and missing != "the control tick":
                text = f"not responding: {missing}; {text}"
            if text != self._status:
                self._status = text
                self._supervisor.status(text)

    def missing(self) -> str | None:
        """Return the name of the part that did not respond since the last feed, or None."""
        if self._timing.fired == self._ticks:
            return "the control tick"
        if not self._parts.journal.health.is_alive:
            return "a writer of the log"
        writer = self._parts.checkpoint_writer
        if writer is not None and not writer.health.is_alive:
            return "the writer of checkpoints"
        closed = next((link.name for link in self._parts.links if not link.is_open), None)
        return None if closed is None else f"link {closed}"


LOWEST_REAL_TIME = 1
NICENESS = -10
LONGEST_RUN_S = 1.0
"""Processor time. A loop that is due every 50 ms has stalled by then, whatever its priority."""
RLIMIT_RTTIME = 15
"""Microseconds of processor time between two waits; Python's `resource` has no name for it."""
NORMAL_PRIORITY = "normal priority: on a busy computer setpoints may be late"
HOW_TO_ALLOW = "run it as the service, or type before: sudo prlimit --pid $$ --rtprio=1"

log = logging.getLogger("companion.process")


@contextmanager
def raised_priority() -> Iterator[str | None]:
    """Give the main thread the highest priority granted; yield its description, None for normal."""
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and sys.platform.startswith("linux")):
        yield None
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    limits, handler = resource.getrlimit(RLIMIT_RTTIME), signal.getsignal(signal.SIGXCPU)
    _set_niceness()
    _become_real_time()
    try:
        yield _description()
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
        with suppress(OSError, ValueError):
            os.sched_setscheduler(0, policy, parameters)
            resource.setrlimit(RLIMIT_RTTIME, limits)
        signal.signal(signal.SIGXCPU, handler)


def _set_niceness() -> None:
    """Set the lowest niceness that is allowed, for use without real-time priority."""
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
