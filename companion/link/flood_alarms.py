"""Floods: when to hear nobody but the autopilot, and what the operator is told of unknown peers.

Theory of operation of the shield. The filter itself is the shell's, and the kernel's; see
`companion.io.links.udp`. It is up only while unknown peers exceed their budget, because without it
they are told to the operator, and only while the autopilot speaks, because it may come back from
another address.

The alarms watch counters that others keep, so that nothing an unknown peer sends makes a
text of its own: they are told at once, and then rarely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.guidance.commands import Announce, Severity
from companion.link.intake import AutopilotBinding, Intake, RateLimit
from companion.mav.endpoint import Address

SHIELD_UP_S = 10.0
"""How long after the last flood it stays up; then it is looked whether the flood goes on."""
SHARE_OF_SILENCE = 0.5
"""Of the silence after which another address is believed: so long the autopilot may be quiet."""


class FloodShield:
    """Looks at one link's budget once per control tick."""

    def __init__(self, intake: Intake, binding: AutopilotBinding) -> None:
        self._intake = intake
        self._binding = binding
        self._dropped = 0
        self._flooded_s = -math.inf

    def tick(self, now_s: float) -> None:
        """Note whether anything was over budget."""
        dropped = self._intake.budget.dropped_unread
        if dropped > self._dropped:
            self._dropped = dropped
            self._flooded_s = now_s

    def sole_peer(self, now_s: float) -> Address | None:
        """Whom alone to hear now; None: everybody."""
        binding = self._binding
        if now_s - self._flooded_s > SHIELD_UP_S or not binding.is_bound or binding.heard_s is None:
            return None
        is_quiet = now_s - binding.heard_s > SHARE_OF_SILENCE * binding.silence_s
        return None if is_quiet else binding.peer


ALARM_TEXTS_PER_S = 0.1
"""Texts of one kind."""


class LinkAlarms:
    """Looks at the counters once per control tick.

    Args:
        binding: Who the autopilot is, and who else says so.
    """

    def __init__(self, binding: AutopilotBinding, intakes: Sequence[Intake]) -> None:
        self._binding = binding
        self._intakes = intakes
        self._unknown_senders = 0
        self._moves = 0
        self._others = 0
        self._dropped = 0
        self._may_tell_senders = RateLimit(ALARM_TEXTS_PER_S)
        self._may_tell_moves = RateLimit(ALARM_TEXTS_PER_S)
        self._may_tell_floods = RateLimit(ALARM_TEXTS_PER_S)

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
        if binding.moves > self._moves and self._may_tell_moves.acquire(now_s):
            self._moves = binding.moves
            texts.append(f"the autopilot is heard from another address now: {_place(binding)}")
        if binding.unknown_senders > self._unknown_senders and self._may_tell_senders.acquire(
            now_s
        ):
            count = binding.unknown_senders - self._unknown_senders
            self._unknown_senders = binding.unknown_senders
            texts.append(f"{count} frames with the autopilot's ids from elsewhere were ignored")
        if dropped > self._dropped and self._may_tell_floods.acquire(now_s):
            count, self._dropped = dropped - self._dropped, dropped
            texts.append(f"flood: {count} datagrams or frames were dropped unread")
        return [Announce(Severity.WARNING, text) for text in texts]


def _place(binding: AutopilotBinding) -> str:
    return "the line" if binding.peer is None else f"{binding.peer[0]}:{binding.peer[1]}"
