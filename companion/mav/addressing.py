"""Target ids of a frame, read from its bytes: a router need neither decode nor trust it.

Also TIMESYNC with the two target fields and MISSION_CURRENT with the plans' ids, which pymavlink's
dialects lack: they are extensions behind the other fields, so a receiver that does not know them
reads the same message.

Source: MAVLink common, TIMESYNC and MISSION_CURRENT; MAVLink developer guide, "Routing" and
"Serialization".
"""

from __future__ import annotations

import struct
from typing import Protocol

from companion.mav.dialect import mavlink
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, SIGNATURE_LENGTH, message_id
from companion.mav.signing import is_signed

TARGETS_AT = 16
"""Offset of TIMESYNC's target fields in the payload."""


class TargetedTimesync(mavlink.MAVLink_timesync_message):
    """TIMESYNC for one component."""

    def __init__(self, tc1: int, ts1: int, target_system: int, target_component: int) -> None:
        super().__init__(tc1, ts1)
        self.target_system = target_system
        self.target_component = target_component

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """Return the frame's bytes; MAVLink 1 has no extensions and omits the targets."""
        payload = self.unpacker.pack(self.tc1, self.ts1)
        if not force_mavlink1:
            payload += bytes((self.target_system, self.target_component))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class IdentifiedMissionCurrent(mavlink.MAVLink_mission_current_message):
    """MISSION_CURRENT with the extension fields for the ids of mission, fence and rally points.

    An id of 0 means no plan, or an autopilot that does not support ids.
    """

    def __init__(
        self, seq: int, total: int, state: int, mode: int, plan_ids: tuple[int, int, int]
    ) -> None:
        super().__init__(seq, total, state, mode)
        self.plan_ids = plan_ids

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """Return the frame's bytes; MAVLink 1 has no extensions and omits the ids."""
        fields = [getattr(self, name) for name in self.ordered_fieldnames]
        payload = self.unpacker.pack(*fields)
        if not force_mavlink1:
            payload += _PLAN_IDS.pack(*self.plan_ids)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


_PLAN_IDS = struct.Struct("<III")
PLAN_IDS_AT = 6
"""Offset of the plan ids in the payload of MISSION_CURRENT, bytes."""


def fence_id_of(frame: bytes) -> int:
    """Return MISSION_CURRENT.fence_id of a whole frame; 0: no fence, or ids are not supported."""
    payload = payload_of(frame).ljust(PLAN_IDS_AT + _PLAN_IDS.size, b"\0")
    fence_id: int = _PLAN_IDS.unpack_from(payload, PLAN_IDS_AT)[1]
    return fence_id


def payload_of(frame: bytes) -> bytes:
    """Return the payload of one whole frame as on the wire, trailing zeros truncated."""
    end = len(frame) - CRC_LENGTH - (SIGNATURE_LENGTH if is_signed(frame) else 0)
    return frame[HEADER_LENGTH[frame[0]] : end]


EVERYONE = (0, 0)


class Targeted(Protocol):
    """Message with target fields."""

    target_system: int
    target_component: int


def is_for(message: Targeted, own: tuple[int, int]) -> bool:
    """Return True if a message is for a system and component, or broadcast to them."""
    return message.target_system in (0, own[0]) and message.target_component in (0, own[1])


def _offsets() -> dict[int, tuple[int, int | None]]:
    """Return the offsets of target system and component in the payload, by message id."""
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


def targets_of_frame(frame: bytes) -> tuple[int, int]:
    """Return target system and component of a whole frame; 0 without a target, or unknown."""
    offsets = _OFFSETS.get(message_id(frame))
    if offsets is None:
        return EVERYONE
    start, length = HEADER_LENGTH[frame[0]], frame[1]

    def byte(offset: int | None) -> int:
        """Return a byte of the payload; 0 where it was truncated or does not exist."""
        # MAVLink 2 truncates zeros at the end of a payload
        return 0 if offset is None or offset >= length else frame[start + offset]

    return byte(offsets[0]), byte(offsets[1])


def boot_ms_of(frame: bytes) -> int | None:
    """Return SYSTEM_TIME.time_boot_ms of a whole frame; None for any other message."""
    if message_id(frame) != mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
        return None
    return int.from_bytes(payload_of(frame).ljust(12, b"\0")[8:12], "little")
