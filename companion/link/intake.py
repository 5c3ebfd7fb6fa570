"""From what a link brings to messages: within a budget, cut, proved, decoded."""

from __future__ import annotations

from collections.abc import Iterator

from companion.link.binding import AutopilotBinding
from companion.link.budget import FloodBudget, Resource
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.framing import (
    CRC_LENGTH,
    HEADER_LENGTH,
    MAGIC_V2,
    SIGNATURE_LENGTH,
    message_id,
)

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
SHORTEST = HEADER_LENGTH[MAGIC_V2]
LONGEST_HEARTBEAT = HEADER_LENGTH[MAGIC_V2] + 9 + CRC_LENGTH + SIGNATURE_LENGTH


class Intake:
    """One link's way in.

    Args:
        codec: Cuts, proves and decodes.
        binding: The autopilot, whose address has the large budget; None on links without one.
    """

    def __init__(self, codec: MavCodec, binding: AutopilotBinding | None) -> None:
        self.codec = codec
        self.budget = FloodBudget()
        self._binding = binding

    def is_known(self, chunk: Chunk) -> bool:
        """Whether a chunk is from the autopilot's address, or over a line with one end."""
        if not chunk.is_datagram:
            return True
        binding = self._binding
        return binding is not None and binding.is_bound and chunk.peer == binding.peer

    def take(self, chunk: Chunk) -> Iterator[Message]:
        """The messages in a chunk, as far as the budget goes."""
        codec, admits, peer = self.codec, self.budget.admits, chunk.peer
        is_known = self.is_known(chunk)
        is_free = is_known and _is_heartbeat(chunk) and self.budget.admits_heartbeat()
        if not (is_free or admits(Resource.BYTES, len(chunk.data), peer, is_known=is_known)):
            return
        for frame in codec.split(chunk.data, is_datagram=chunk.is_datagram):
            if not (is_free or admits(Resource.FRAMES, 1, peer, is_known=is_known)):
                return
            if not codec.proves(frame):
                continue
            if not (is_free or admits(Resource.MESSAGES, 1, peer, is_known=is_known)):
                return
            message = codec.decode_proved(frame)
            if message is not None:
                yield message


def _is_heartbeat(chunk: Chunk) -> bool:
    """Whether a datagram is one HEARTBEAT by its header and its size; neither is proved yet."""
    data = chunk.data
    is_one = chunk.is_datagram and SHORTEST <= len(data) <= LONGEST_HEARTBEAT
    return is_one and data[0] in HEADER_LENGTH and message_id(data) == HEARTBEAT
