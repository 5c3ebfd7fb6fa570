"""The companion's journal in memory."""

from __future__ import annotations

from collections.abc import Mapping

from companion.guidance.commands import ReportResult, Severity


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
