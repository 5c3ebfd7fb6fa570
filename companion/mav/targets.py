"""For whom a frame is, read from its bytes, so that a router need not decode or believe it.

Source: MAVLink developer guide, "Routing" and "Serialization".
"""

from __future__ import annotations

import struct

from companion.mav.dialect import mavlink
from companion.mav.framing import HEADER_LENGTH, MAGIC_V1, message_id
from companion.mav.timesync import TARGETS_AT, payload_of

EVERYONE = (0, 0)


def _offsets() -> dict[int, tuple[int, int | None]]:
    """Where target system and component are in the payload of each message that has them."""
    offsets: dict[int, tuple[int, int | None]] = {}
    for number, kind in mavlink.mavlink_map.items():
        places: dict[str, int] = {}
        at = 0
        fields = zip(
            kind.ordered_fieldnames,
            kind.native_format.decode("ascii")[1:],
            kind.array_lengths,
            strict=True,
        )
        for name, code, length in fields:
            places[name] = at
            at += struct.calcsize(f"<{code}") * max(1, length)
        if "target_system" in places:
            offsets[number] = (places["target_system"], places.get("target_component"))
    offsets[mavlink.MAVLINK_MSG_ID_TIMESYNC] = (TARGETS_AT, TARGETS_AT + 1)
    return offsets


_OFFSETS = _offsets()


def source_of(frame: bytes) -> tuple[int, int]:
    """System and component that a frame says it is from."""
    at = 3 if frame[0] == MAGIC_V1 else 5
    return frame[at], frame[at + 1]


def targets_of_frame(frame: bytes) -> tuple[int, int]:
    """Target system and component of a whole frame; 0 where it names none, or is unknown."""
    offsets = _OFFSETS.get(message_id(frame))
    if offsets is None:
        return EVERYONE
    start, length = HEADER_LENGTH[frame[0]], frame[1]

    def byte(offset: int | None) -> int:
        """A byte of the payload; 0 where it was cut or is not there."""
        # zeros at the end of a payload are cut in MAVLink 2
        return 0 if offset is None or offset >= length else frame[start + offset]

    return byte(offsets[0]), byte(offsets[1])


def boot_ms_of(frame: bytes) -> int | None:
    """SYSTEM_TIME.time_boot_ms of a whole frame; None of any other message."""
    if message_id(frame) != mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
        return None
    return int.from_bytes(payload_of(frame).ljust(12, b"\0")[8:12], "little")
