"""The companion's journal: in memory, and watched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from companion.guidance.commands import ReportResult, Severity
from companion.link.recorders import Journal
from sim_link.lockstep.observer import Observer


class Notes:
    """Everything that the endpoint reports, in the order of time."""

    def __init__(self) -> None:
        self.texts: list[tuple[float, str]] = []
        self.records: list[tuple[float, str, Mapping[str, object]]] = []
        self.results: list[tuple[float, ReportResult]] = []

    def frame(self, data: bytes, now_s: float) -> None:
        """Frames are recorded by whoever watches the flight."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an event."""
        self.records.append((now_s, kind, fields))

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Keep a text."""
        del severity
        self.texts.append((now_s, text))

    def result(self, report: ReportResult, now_s: float) -> None:
        """Keep a report."""
        self.results.append((now_s, report))

    def said(self, part: str) -> bool:
        """Whether a text to the operator contained something."""
        return any(part in text for _, text in self.texts)


class WatchedJournal:
    """Passes everything on, and tells observers of it.

    Args:
        journal: Where it goes.
        observers: Who is told; may change meanwhile.
    """

    def __init__(self, journal: Journal, observers: Sequence[Observer]) -> None:
        self._journal = journal
        self._observers = observers

    def frame(self, data: bytes, now_s: float) -> None:
        """Pass a frame on."""
        self._journal.frame(data, now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Pass an event on."""
        self._journal.record(kind, fields, now_s)
        self._tell(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Pass a text on."""
        self._journal.text(severity, text, now_s)
        self._tell("text", {"severity": severity.name.lower(), "text": text}, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Pass a report on."""
        self._journal.result(report, now_s)
        self._tell("result", {"r95_m": report.estimate.r95_m}, now_s)

    def _tell(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        for observer in self._observers:
            observer.noted(kind, fields, now_s)
