"""What the companion asks the autopilot by itself, outside of any mission.

Each dialogue hears the autopilot's messages and says when a question is due: for its fence, for the
streams that are needed, for a parameter, for the time. At most one of the first three leaves per
control tick, so that a slow line is not flooded; that for the fence first, because nothing engages
before it is answered.
"""

from __future__ import annotations

from companion.guidance.commands import Announce, Severity
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.fencing import Fencing
from companion.link.binding import AutopilotBinding
from companion.link.clock_sync import ClockSync
from companion.link.fence_fetch import FenceFetch
from companion.link.freshness import PATIENCE_S, StreamFreshness
from companion.link.px4_check import Px4FailsafeCheck
from companion.link.rate_limit import RateLimit
from companion.link.streams import StreamRequester, request_message
from companion.mav.dialect import Message, mavlink

SHORTEST_PATIENCE_S = min(patience_s for _, patience_s in PATIENCE_S.values())
TEXTS_PER_S = 0.2
"""About streams."""


class Dialogues:
    """All of them.

    Args:
        binding: The autopilot that is asked.
        fencing: Says whether its fence is wanted.
    """

    def __init__(self, binding: AutopilotBinding, fencing: Fencing) -> None:
        self.clock = ClockSync()
        self.freshness = StreamFreshness()
        self._binding = binding
        self._fencing = fencing
        self._fence = FenceFetch()
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

    def fence_heard(
        self, message: Message, now_s: float, own_ids: tuple[int, int]
    ) -> AutopilotFenceRead | None:
        """Take in a message of the autopilot; its fence, once that is complete."""
        return self._fence.heard(message, now_s, own_ids)

    def fence_given_up(self, now_s: float) -> AutopilotFenceRead | None:
        """The news that it does not tell its fence."""
        return self._fence.gave_up(now_s)

    def due(self, now_s: float, *, is_mode_wanted: bool = False) -> list[Message]:
        """The questions to ask now.

        Args:
            now_s: The present.
            is_mode_wanted: Whether a HEARTBEAT is asked for until one comes that ends a doubt.
        """
        binding = self._binding
        if binding.system_id is None:
            return []
        ids = (binding.system_id, binding.component_id)
        request = self._fence.due(now_s, ids, is_wanted=self._fencing.wants_reading)
        request = request or self._streams.due(
            now_s, *ids, binding.autopilot, is_mode_wanted=is_mode_wanted
        )
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
        is_silent = heard_s is None or now_s - heard_s > SHORTEST_PATIENCE_S
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
        self._fence.restart()
