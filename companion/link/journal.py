"""Where the link reports what happened; a shell writes it to disk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from companion.guidance.commands import ReportResult, Severity


class Journal(Protocol):
    """Takes reports; never raises and never waits."""

    def frame(self, data: bytes, now_s: float) -> None:
        """A raw frame that came in or went out on the vehicle link, or came in on another."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """A line for the event log."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """A text for the operator."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """The target is localised."""
