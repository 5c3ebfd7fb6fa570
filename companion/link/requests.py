"""Requests to the autopilot: one at a time, resent, and answered or given up.

Source: MAVLink guide, "Command Protocol": no ACK means resend with `confirmation` + 1; IN_PROGRESS
means wait. All in all at most 2 s, or 10 s with progress, never a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.guidance.events import Outcome, RequestAnswered, RequestKind
from companion.mav.dialect import Message, mavlink

RESEND_S = 0.5
SENDS = 4
IN_PROGRESS_S = 3.0
MAX_PROGRESS_S = 10.0
"""An autopilot that only ever makes progress does not answer."""

CommandMessage = mavlink.MAVLink_command_long_message


@dataclass(slots=True)
class _Pending:
    kind: RequestKind
    command: int
    build: Callable[[int], CommandMessage]
    """The message for a `confirmation` number."""
    sends: int = 0
    next_s: float = 0.0
    first_s: float | None = None


class RequestClient:
    """The request in flight; a new one replaces it, because only the latest wish counts."""

    def __init__(self) -> None:
        self._pending: _Pending | None = None

    def submit(self, kind: RequestKind, build: Callable[[int], CommandMessage]) -> None:
        """Ask for something from the next `due` on."""
        self._pending = _Pending(kind, build(0).command, build)

    def cancel(self) -> None:
        """Forget the request in flight."""
        self._pending = None

    def due(self, now_s: float) -> Message | RequestAnswered | None:
        """The message to send now, or the news that nobody answers."""
        pending = self._pending
        if pending is None or now_s < pending.next_s:
            return None
        if pending.sends >= SENDS:
            self._pending = None
            return RequestAnswered(now_s, pending.kind, Outcome.NO_ANSWER)
        if pending.first_s is None:
            pending.first_s = now_s
        message = pending.build(pending.sends)
        pending.sends += 1
        pending.next_s = now_s + RESEND_S
        return message

    def answered(
        self, ack: mavlink.MAVLink_command_ack_message, now_s: float
    ) -> RequestAnswered | None:
        """What an ACK of the autopilot means for the request in flight."""
        pending = self._pending
        if pending is None or pending.sends == 0 or ack.command != pending.command:
            return None  # not asked yet: the answer belongs to a request that was replaced
        if ack.result == mavlink.MAV_RESULT_IN_PROGRESS:
            pending.sends = SENDS
            last_s = now_s if pending.first_s is None else pending.first_s + MAX_PROGRESS_S
            pending.next_s = min(now_s + IN_PROGRESS_S, last_s)
            return None
        self._pending = None
        if ack.result == mavlink.MAV_RESULT_ACCEPTED:
            return RequestAnswered(now_s, pending.kind, Outcome.ACCEPTED)
        name, is_repeated = result_name(ack.result), pending.sends > 1
        return RequestAnswered(now_s, pending.kind, Outcome.REJECTED, name, is_repeated=is_repeated)


def result_name(result: int) -> str:
    """MAV_RESULT in words."""
    entry = mavlink.enums["MAV_RESULT"].get(result)
    name = f"result {result}" if entry is None else str(entry.name)
    return name.removeprefix("MAV_RESULT_").lower().replace("_", " ")
