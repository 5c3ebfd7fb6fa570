"""What the process takes of its machine, for the event log, and what operators must know of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

from companion.guidance.commands import Announce, Severity
from companion.io.accounting import process_use
from companion.io.checkpoint_store import CheckpointStore
from companion.io.journal import BlackBox
from companion.io.link_base import Link
from companion.io.shell import TimerStatistics
from companion.link.endpoint import CompanionEndpoint

RECORD_PERIOD_S = 10.0
SILENT_DISK_S = 2.0
MISSED_TICKS = 10
"""Within a period, before anybody is told."""
TICK_S = 0.05


class Accounts:
    """Counts and tells.

    Args:
        endpoint: Whose operator is told.
        journal: Where records go, and what is watched.
        timing: Of the shell.
        links: Of the shell.
        store: Where checkpoints go; None: nowhere.
        speed: Seconds of the clock per wall second.
    """

    def __init__(
        self,
        endpoint: CompanionEndpoint,
        journal: BlackBox,
        timing: TimerStatistics,
        links: Sequence[Link],
        store: CheckpointStore | None,
        speed: float,
    ) -> None:
        self._endpoint = endpoint
        self._journal = journal
        self._timing = timing
        self._links = links
        self._store = store
        self._speed = speed
        self._next_s = -math.inf
        self._told_dropped = 0
        self._is_disk_silent = False
        self._late_total_s = 0.0

    def run(self, now_s: float) -> None:
        """Record and tell what is due."""
        self._check_disk(now_s)
        if now_s / self._speed < self._next_s:
            return
        self._next_s = now_s / self._speed + RECORD_PERIOD_S
        self._check_losses(now_s)
        self._check_punctuality(now_s)
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
            "links": [{"name": link.name, **asdict(link.counters)} for link in self._links],
        }
        writer = None if self._store is None else self._store.writer
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
            self._tell(Severity.WARNING, text, now_s)
        else:
            self._tell(Severity.NOTICE, "the disk answers again", now_s)

    def _check_losses(self, now_s: float) -> None:
        dropped = self._journal.health.dropped
        writer = None if self._store is None else self._store.writer
        dropped += 0 if writer is None else writer.failed
        if dropped > self._told_dropped:
            self._told_dropped = dropped
            text = f"{dropped} log entries lost: the disk is full, broken or too slow; flying on"
            self._tell(Severity.WARNING, text, now_s)

    def _check_punctuality(self, now_s: float) -> None:
        missed = round((self._timing.late_total_s - self._late_total_s) / TICK_S)
        self._late_total_s = self._timing.late_total_s
        if missed > MISSED_TICKS:
            text = f"the computer is too slow: {missed} control ticks missed in 10 s"
            self._tell(Severity.WARNING, text, now_s)

    def _tell(self, severity: Severity, text: str, now_s: float) -> None:
        self._endpoint.executor.execute(Announce(severity, text), now_s)
