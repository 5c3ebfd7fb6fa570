"""Tells when a link refuses what is sent, and writes the links' counters to the event log.

A refused frame is not sent again: the next control tick brings a newer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from companion.guidance.commands import Severity
from companion.io.link_base import Link
from companion.io.streams import StreamLink
from companion.link.journal import Journal
from companion.link.rate_limit import RateLimit

LOOK_S = 1.0
RECORD_PERIOD_S = 10.0
TEXTS_PER_S = 0.1
"""About one link."""


class LinkWatch:
    """Looks at the counters once a second.

    Args:
        links: Of a shell.
        journal: Where to report.
    """

    def __init__(self, links: Sequence[Link], journal: Journal) -> None:
        self._links = links
        self._journal = journal
        self._told = [(0, 0) for _ in links]
        self._may_tell = [RateLimit(TEXTS_PER_S) for _ in links]
        self._next_look_s = 0.0
        self._next_record_s = 0.0

    def check(self, now_s: float) -> None:
        """Report what is news."""
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + LOOK_S
        for number, link in enumerate(self._links):
            self._check(number, link, now_s)
        if now_s >= self._next_record_s:
            self._next_record_s = now_s + RECORD_PERIOD_S
            fields = {link.name: asdict(link.counters) for link in self._links}
            self._journal.record("io", fields, now_s)

    def _check(self, number: int, link: Link, now_s: float) -> None:
        counters, (errors, dropped) = link.counters, self._told[number]
        is_slow = isinstance(link, StreamLink) and link.is_connected
        if not is_slow:  # nobody is there: what was dropped is no news
            dropped = counters.dropped
        refused, lost = counters.send_errors - errors, counters.dropped - dropped
        if not refused and not lost:
            self._told[number] = (errors, dropped)
            return
        if not self._may_tell[number].allows(now_s):
            return
        self._told[number] = (counters.send_errors, counters.dropped)
        parts = []
        if refused:
            parts.append(f"the system refused {refused} frames ({counters.last_error})")
        if lost:
            parts.append(f"{lost} frames were given up, the line is too slow")
        self._journal.text(Severity.WARNING, f"{link.name}: {'; '.join(parts)}", now_s)
