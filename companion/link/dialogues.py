"""What the companion asks the autopilot by itself, outside of any mission: streams, parameters.

Each dialogue hears the autopilot's messages and says when a question is due. At most one question
leaves per control tick, the streams' first, so that a slow line is not flooded.
"""

from __future__ import annotations

from companion.guidance.commands import Announce, Severity
from companion.link.binding import AutopilotBinding
from companion.link.px4_check import Px4FailsafeCheck
from companion.link.streams import StreamRequester
from companion.mav.dialect import Message


class Dialogues:
    """All of them.

    Args:
        binding: The autopilot that is asked.
    """

    def __init__(self, binding: AutopilotBinding) -> None:
        self._binding = binding
        self._streams = StreamRequester()
        self._px4_check = Px4FailsafeCheck()

    def heard(self, message: Message, now_s: float) -> list[Announce]:
        """Take in a message of the autopilot; what the operator is to be told."""
        self._streams.heard(message, now_s)
        warning = self._px4_check.heard(message)
        return [] if warning is None else [Announce(Severity.WARNING, warning)]

    def due(self, now_s: float) -> Message | None:
        """The question to ask now, if any."""
        binding = self._binding
        if binding.system_id is None:
            return None
        ids = (binding.system_id, binding.component_id)
        request = self._streams.due(now_s, *ids)
        return request or self._px4_check.due(now_s, binding.autopilot, *ids)

    def restart(self) -> None:
        """Ask for every stream again, because the autopilot forgot."""
        self._streams.restart()
