"""What the operator is told about strangers and floods: at once, and then rarely.

Watches counters that others keep, so that nothing a stranger sends makes a text of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.intake import Intake
from companion.link.rate_limit import RateLimit

PER_S = 0.1
"""Texts of one kind."""


class LinkAlarms:
    """Looks at the counters once per control tick.

    Args:
        binding: Who the autopilot is, and who else says so.
        intakes: Of all links.
    """

    def __init__(self, binding: AutopilotBinding, intakes: Sequence[Intake]) -> None:
        self._binding = binding
        self._intakes = intakes
        self._strangers = 0
        self._moves = 0
        self._others = 0
        self._dropped = 0
        self._may_tell_strangers = RateLimit(PER_S)
        self._may_tell_moves = RateLimit(PER_S)
        self._may_tell_floods = RateLimit(PER_S)

    def tick(self, now_s: float) -> list[Announce]:
        """What is news."""
        binding, texts = self._binding, []
        dropped = sum(intake.budget.dropped_unread for intake in self._intakes)
        for other in binding.others[self._others :]:
            texts.append(
                f"another autopilot is on this link, system {other}; ours is {binding.system_id} "
                "(vehicle.system_id chooses)"
            )
        self._others = len(binding.others)
        if binding.moves > self._moves and self._may_tell_moves.allows(now_s):
            self._moves = binding.moves
            texts.append(f"the autopilot is heard from another address now: {_place(binding)}")
        if binding.strangers > self._strangers and self._may_tell_strangers.allows(now_s):
            count, self._strangers = binding.strangers - self._strangers, binding.strangers
            texts.append(f"{count} frames with the autopilot's ids from elsewhere were ignored")
        if dropped > self._dropped and self._may_tell_floods.allows(now_s):
            count, self._dropped = dropped - self._dropped, dropped
            texts.append(f"flood: {count} datagrams or frames were dropped unread")
        return [Announce(Severity.WARNING, text) for text in texts]


def _place(binding: AutopilotBinding) -> str:
    return "the line" if binding.peer is None else f"{binding.peer[0]}:{binding.peer[1]}"
