"""Tells of refused measurements without flooding anybody: the log by the second, people rarely."""

from __future__ import annotations

from collections import deque

from companion.estimation.refusal import Refusal
from companion.guidance.commands import Announce, Command, Record, Severity

RECORD_PERIOD_S = 1.0
"""Refusals for one reason become a line of the log at most this often, with their number."""
MANY, MANY_WITHIN_S = 20, 10.0
"""So many for one reason within that time are worth a text."""
TEXT_PERIOD_S = 60.0
HARMLESS = frozenset({Refusal.OTHER_EMITTER, Refusal.DUPLICATE})
"""Reasons that say nothing against the radio."""


class _Reason:
    """What was told of one reason."""

    def __init__(self) -> None:
        self.pending = 0
        self.recorded_s: float | None = None
        self.texted_s: float | None = None
        self.times_s: deque[float] = deque(maxlen=MANY)


class RefusalNews:
    """Collects refusals."""

    def __init__(self) -> None:
        self._reasons: dict[Refusal, _Reason] = {}

    def refused(self, reason: Refusal, now_s: float) -> list[Command]:
        """A measurement was refused; what is to be told of it now."""
        entry = self._reasons.setdefault(reason, _Reason())
        entry.pending += 1
        entry.times_s.append(now_s)
        commands: list[Command] = []
        if entry.recorded_s is None or now_s - entry.recorded_s >= RECORD_PERIOD_S:
            fields = {"reason": reason.value, "count": entry.pending}
            commands.append(Record("refused", fields))
            entry.recorded_s, entry.pending = now_s, 0
        if self._is_worth_a_text(reason, entry, now_s):
            text = f"measurements refused: {reason.value}, {MANY} within {MANY_WITHIN_S:g} s"
            commands.append(Announce(Severity.WARNING, text))
            entry.texted_s = now_s
        return commands

    def _is_worth_a_text(self, reason: Refusal, entry: _Reason, now_s: float) -> bool:
        if reason in HARMLESS or len(entry.times_s) < MANY:
            return False
        if now_s - entry.times_s[0] > MANY_WITHIN_S:
            return False
        return entry.texted_s is None or now_s - entry.texted_s >= TEXT_PERIOD_S
