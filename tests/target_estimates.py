"""Reader of estimates as a ground station receives them."""

from __future__ import annotations

from companion.mav.dialect import MAVLink_target_estimate_message, Message, mavlink
from companion.mav.ranging import CORE_LENGTH


def estimate_in(message: Message) -> MAVLink_target_estimate_message | None:
    """Return the TARGET_ESTIMATE that a message is or, as a TUNNEL, contains; None otherwise."""
    if isinstance(message, MAVLink_target_estimate_message):
        return message
    if not isinstance(message, mavlink.MAVLink_tunnel_message):
        return None
    kind = MAVLink_target_estimate_message
    if message.payload_type != kind.id or message.payload_length < CORE_LENGTH:
        return None
    values = kind.unpacker.unpack(bytes(message.payload[: kind.unpacker.size]))
    return kind(**dict(zip(kind.ordered_fieldnames, values, strict=True)))
