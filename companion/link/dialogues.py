"""What the companion asks the autopilot by itself, outside of any mission.

Each dialogue hears the autopilot's messages and says when a question is due: for the streams that
are needed, for a parameter, for the time. At most one command leaves per control tick, the streams'
first, so that a slow line is not flooded.
"""

from __future__ import annotations

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.clock_sync import ClockSync
from companion.link.freshness import PATIENCE_S, StreamFreshness
from companion.link.px4_check import Px4FailsafeCheck
from companion.link.rate_limit import RateLimit
from companion.link.streams import StreamRequester, request_message
from companion.mav.dialect import Message, mavlink

TEXTS_PER_S = 0.2
"""About streams."""


class Dialogues:
    """All of them.

    Args:
        binding: The autopilot that is asked.
    """

    def __init__(self, binding: AutopilotBinding) -> None:
        self.clock = ClockSync()
        self.freshness = StreamFreshness()
        self._binding = binding
        self._streams = StreamRequester(self.freshness)
        self._px4_check = Px4FailsafeCheck()
        self._asks_mode = False
        self._stale: tuple[str, ...] = ()
        self._may_tell = RateLimit(TEXTS_PER_S)

    def heard(self, message: Message, now_s: float) -> list[Announce]:
        """Take in a message of the autopilot; what the operator is to be told."""
        self.freshness.heard(message, now_s)
        self.clock.heard(message, now_s)
        warning = self._px4_check.heard(message)
        return [] if warning is None else [Announce(Severity.WARNING, warning)]

    def due(self, now_s: float) -> list[Message]:
        """The questions to ask now."""
        binding = self._binding
        if binding.system_id is None:
            return []
        ids = (binding.system_id, binding.component_id)
        request = self._streams.due(now_s, *ids)
        request = request or self._px4_check.due(now_s, binding.autopilot, *ids)
        mode = request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT, *ids) if self._asks_mode else None
        self._asks_mode = False
        time = self.clock.due(now_s, *ids)
        return [question for question in (mode, request, time) if question is not None]

    def ask_mode(self) -> None:
        """Ask for a HEARTBEAT, once, instead of waiting for the next one."""
        self._asks_mode = True

    def news(self, now_s: float) -> list[Announce]:
        """What the operator is to be told about streams, while others still flow."""
        stale = self.freshness.stale(now_s)
        stopped = [name for name in stale if name not in self._stale]
        heard_s = self._binding.heard_s
        is_silent = heard_s is None or now_s - heard_s > min(p for _, p in PATIENCE_S.values())
        if is_silent or not stopped:
            self._stale = tuple(name for name in self._stale if name in stale)
            return []
        if not self._may_tell.allows(now_s):
            return []
        self._stale = stale
        return [Announce(Severity.WARNING, f"no {' and '.join(stopped)} any more: asking again")]

    def restart(self) -> None:
        """Begin anew, because the autopilot forgot what it was asked."""
        self.freshness.restart()
        self.clock.restart()
        self._streams.restart()
