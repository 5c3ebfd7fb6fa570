"""Where the link reports what happened, and what it was told, for a log to fly it again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import OperatorCommand, SessionMemory
from companion.mav.endpoint import Address


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


class InputRecorder(Protocol):
    """Takes the inputs in their order; never raises and never waits."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """A valid frame that was not our own."""

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Bytes of a radio that does not speak MAVLink."""

    def tick(self, now_s: float) -> None:
        """The timer fired."""

    def stop(self, now_s: float) -> None:
        """The process was asked to end."""

    def operator_command(self, command: OperatorCommand, now_s: float) -> None:
        """The operator asked for something."""

    def earlier_run(self, now_s: float) -> None:
        """An earlier process did not end in order."""

    def recall(self, memory: SessionMemory, age_s: float, now_s: float) -> None:
        """What that process knew is taken up."""
