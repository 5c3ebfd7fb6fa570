"""TIMESYNC with the two target fields of MAVLink 2, which pymavlink's dialects do not have.

Source: MAVLink common, TIMESYNC: `target_system` and `target_component` are extensions behind
`ts1`, so a receiver that does not know them reads the same message.
"""

from __future__ import annotations

from companion.mav.dialect import Message, mavlink
from companion.mav.framing import CRC_LENGTH, HEADER_LENGTH, SIGNATURE_LENGTH
from companion.mav.signing import is_signed

TARGETS_AT = 16
"""Where the target fields are in the payload."""


class TargetedTimesync(mavlink.MAVLink_timesync_message):
    """A TIMESYNC for one component."""

    def __init__(self, tc1: int, ts1: int, target_system: int, target_component: int) -> None:
        super().__init__(tc1, ts1)
        self.target_system = target_system
        self.target_component = target_component

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes; MAVLink 1 has no room for the targets and leaves them out."""
        payload = self.unpacker.pack(self.tc1, self.ts1)
        if not force_mavlink1:
            payload += bytes((self.target_system, self.target_component))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


def targets_of(message: Message) -> tuple[int, int]:
    """Target system and component of a received TIMESYNC; (0, 0) if it names none."""
    payload = payload_of(bytes(message.get_msgbuf())).ljust(TARGETS_AT + 2, b"\0")
    return payload[TARGETS_AT], payload[TARGETS_AT + 1]


def payload_of(frame: bytes) -> bytes:
    """The payload of one whole frame as it was on the wire, cut zeros and all."""
    end = len(frame) - CRC_LENGTH - (SIGNATURE_LENGTH if is_signed(frame) else 0)
    return frame[HEADER_LENGTH[frame[0]] : end]
