"""A journal that tells views what it tells the flight log."""

from __future__ import annotations

from collections.abc import Mapping

from companion.guidance.commands import ReportResult, Severity
from companion.link.journal import Journal
from companion.view.collector import Collector


class TeeJournal:
    """Passes everything on to the flight log, and what views need to a collector.

    Args:
        journal: The flight log.
        collector: For the views.
    """

    def __init__(self, journal: Journal, collector: Collector) -> None:
        self._journal = journal
        self._collector = collector

    def frame(self, data: bytes, now_s: float) -> None:
        """Pass a raw frame on."""
        self._journal.frame(data, now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Pass an event on, and show it."""
        self._journal.record(kind, fields, now_s)
        self._collector.record(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Pass a text on, and show it."""
        self._journal.text(severity, text, now_s)
        self._collector.text(severity, text, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Pass the result on."""
        self._journal.result(report, now_s)
