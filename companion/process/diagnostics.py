"""Diagnostics of the process and its links, for the event log and the operator.

Memory, descriptors, threads and processor time are read from /proc where there is one, otherwise as
far as the standard library provides them. A link that refuses frames is reported; a refused frame
is not sent again: the next control tick sends a newer one.
"""

from __future__ import annotations

import math
import os
import resource
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from companion.guidance.commands import Severity
from companion.guidance.events import ProcessMessage
from companion.io.background_output import BackgroundReplacer
from companion.io.links.byte_streams import StreamLink
from companion.io.links.link import Link
from companion.io.logs.flight_recorder import BlackBox
from companion.io.shell import TimerStatistics
from companion.io.state.checkpoints import CheckpointStore
from companion.link.endpoint import CompanionEndpoint
from companion.link.intake import RateLimit
from companion.link.interface import Journal

_STATM = Path("/proc/self/statm")
_DESCRIPTORS = Path("/proc/self/fd")


@dataclass(frozen=True, slots=True)
class ProcessUse:
    """Resources of the process at a moment."""

    resident_mb: float
    """Memory in RAM now; the peak where the system does not say."""
    descriptors: int | None
    """Open files and sockets; None where the system does not say."""
    threads: int
    processor_s: float
    """User and system time since the start."""


def process_use() -> ProcessUse:
    """Return the present resources of this process."""
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
LOOK_PERIOD_S = 0.5
SILENT_DISK_S = 2.0
MISSED_TICKS = 10
"""Within a period, before it is reported."""
TICK_S = 0.05


@dataclass(frozen=True, slots=True)
class ProcessParts:
    """Parts of the process beside the endpoint."""

    journal: BlackBox
    timing: TimerStatistics
    links: Sequence[Link]
    store: CheckpointStore | None
    """Store of the checkpoints; None: none are kept."""

    @property
    def checkpoint_writer(self) -> BackgroundReplacer | None:
        """Return the writer of checkpoints, once one was saved."""
        return None if self.store is None else self.store.writer


class ProcessDiagnostics:
    """Counts, records and reports; `speed` is seconds of the clock per wall second."""

    def __init__(self, endpoint: CompanionEndpoint, parts: ProcessParts, speed: float) -> None:
        self._endpoint = endpoint
        self._parts = parts
        self._journal = parts.journal
        self._timing = parts.timing
        self._speed = speed
        self._next_s = self._next_look_s = -math.inf
        self._reported_dropped = 0
        self._is_disk_silent = False
        self._late_total_s = 0.0

    def run(self, now_s: float) -> None:
        """Record and report what is due."""
        wall_s = now_s / self._speed
        if wall_s >= self._next_look_s:
            self._next_look_s = wall_s + LOOK_PERIOD_S
            self._check_disk(now_s)
        if wall_s < self._next_s:
            return
        self._next_s = wall_s + RECORD_PERIOD_S
        self._check_losses(now_s)
        missed = round((self._timing.late_total_s - self._late_total_s) / TICK_S)
        self._late_total_s = self._timing.late_total_s
        if missed > MISSED_TICKS:
            text = f"the computer is too slow: {missed} control ticks missed in 10 s"
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
            text = f"the disk has not answered for {SILENT_DISK_S:g} s: flying on, the log waits"
            self._announce(Severity.WARNING, text, now_s)
        else:
            self._announce(Severity.NOTICE, "the disk answers again", now_s)

    def _check_losses(self, now_s: float) -> None:
        dropped = self._journal.health.dropped
        writer = self._parts.checkpoint_writer
        dropped += 0 if writer is None else writer.failed
        if dropped > self._reported_dropped:
            self._reported_dropped = dropped
            text = f"{dropped} log entries lost: the disk is full, broken or too slow; flying on"
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
        self._next_look_s = 0.0
        self._next_record_s = 0.0

    def check(self, now_s: float) -> None:
        """Announce changes of the links' counters, and record all counters, each at its period."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LINK_CHECK_PERIOD_S
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
