"""Payload fields that are read without pymavlink: target ids, plan ids, parameter values.

Target ids of a frame are read from its bytes: a router need neither decode nor trust it.

TIMESYNC with the two target fields and MISSION_CURRENT with the plans' ids, which pymavlink's
dialects lack, are defined here: they are extensions behind the other fields, so a receiver that
does not know them reads the same message.

Source: MAVLink common, TIMESYNC and MISSION_CURRENT; MAVLink developer guide, "Routing" and
"Serialization".

Parameter values are four bytes on the wire, which encode an integer in one of two ways.

PX4 puts the integer's own bytes into PARAM_VALUE's float field (bytewise), ArduPilot the nearest
float (C cast); AUTOPILOT_VERSION.capabilities identifies the encoding. The bytes are read from and
written to the payload directly: as Python floats, those of small negative integers are NaNs, which
a conversion may change.

Source: MAVLink developer guide, "Parameter Protocol".
"""

from __future__ import annotations

import math
import struct
from enum import Enum, IntEnum
from typing import Protocol

from companion.mav.codec import CRC_LENGTH, HEADER_LENGTH, MAGIC_V1, SIGNATURE_LENGTH, message_id
from companion.mav.dialect import Message, mavlink
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
    """MISSION_CURRENT with the ids of mission, fence and rally points; 0: none, or unsupported."""

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


def is_mavlink1(message: Message) -> bool:
    """Return True if a received message was in MAVLink 1, without its extension fields."""
    frame = message.get_msgbuf()
    return bool(frame) and frame[0] == MAGIC_V1


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
        offset_of: dict[str, int] = {}
        at = 0
        fields = zip(
            kind.ordered_fieldnames,
            kind.native_format.decode("ascii")[1:],
            kind.array_lengths,
            strict=True,
        )
        for name, code, length in fields:
            offset_of[name] = at
            at += struct.calcsize(f"<{code}") * max(1, length)
        if "target_system" in offset_of:
            offsets[number] = (offset_of["target_system"], offset_of.get("target_component"))
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
        # MAVLink 2 truncates zeros at the end of a payload
        return 0 if offset is None or offset >= length else frame[start + offset]

    return byte(offsets[0]), byte(offsets[1])


def boot_ms_of(frame: bytes) -> int | None:
    """Return SYSTEM_TIME.time_boot_ms of a whole frame; None for any other message."""
    if message_id(frame) != mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
        return None
    return int.from_bytes(payload_of(frame).ljust(12, b"\0")[8:12], "little")


NAME_LENGTH = 16
"""Characters of a parameter's name; a NUL follows only a shorter one."""
VALUE_LENGTH = 4
CAST_ALLOWANCE = 0.01
"""Offset, away from zero, that ArduPilot adds before it truncates a float to an integer."""


class ParamType(IntEnum):
    """MAV_PARAM_TYPEs that fit four bytes."""

    UINT8 = mavlink.MAV_PARAM_TYPE_UINT8
    INT8 = mavlink.MAV_PARAM_TYPE_INT8
    UINT16 = mavlink.MAV_PARAM_TYPE_UINT16
    INT16 = mavlink.MAV_PARAM_TYPE_INT16
    UINT32 = mavlink.MAV_PARAM_TYPE_UINT32
    INT32 = mavlink.MAV_PARAM_TYPE_INT32
    REAL32 = mavlink.MAV_PARAM_TYPE_REAL32

    @property
    def is_integer(self) -> bool:
        """True if values are whole numbers."""
        return self is not ParamType.REAL32

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value of the type."""
        if self is ParamType.REAL32:
            return -MAX_REAL32, MAX_REAL32
        bits = 8 * _FORMATS[self].size
        is_signed = self in (ParamType.INT8, ParamType.INT16, ParamType.INT32)
        return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if is_signed else (0, 2**bits - 1)


class ParamEncoding(Enum):
    """Encoding of an integer in four bytes."""

    BYTEWISE = "bytewise"
    C_CAST = "C cast"


_FORMATS = {k: struct.Struct(f"<{code}") for k, code in zip(ParamType, "BbHhIif", strict=True)}
_REAL32 = _FORMATS[ParamType.REAL32]
MAX_REAL32 = float(_REAL32.unpack(b"\xff\xff\x7f\x7f")[0])


def raw_value(value: float, kind: ParamType, encoding: ParamEncoding) -> bytes:
    """Return the four bytes of a value that is within the bounds of its type."""
    if not kind.is_integer or encoding is ParamEncoding.C_CAST:
        return _REAL32.pack(value)
    return _FORMATS[kind].pack(int(value)).ljust(VALUE_LENGTH, b"\0")


def value_from_raw(raw: bytes, kind: ParamType, encoding: ParamEncoding) -> float:
    """Return the value of four bytes, an `int` for integer types; NaN and infinity are kept."""
    if not kind.is_integer:
        return float(_REAL32.unpack(raw)[0])
    if encoding is ParamEncoding.BYTEWISE:
        return int(_FORMATS[kind].unpack(raw[: _FORMATS[kind].size])[0])
    real = float(_REAL32.unpack(raw)[0])
    return int(real + math.copysign(CAST_ALLOWANCE, real)) if math.isfinite(real) else real


def nearest_real32(value: float) -> float:
    """Return the single-precision number nearest to a finite value within its bounds."""
    return float(_REAL32.unpack(_REAL32.pack(value))[0])


def raw_of(message: Message) -> bytes:
    """Return the four value bytes of a received PARAM_SET or PARAM_VALUE."""
    return payload_of(bytes(message.get_msgbuf()))[:VALUE_LENGTH].ljust(VALUE_LENGTH, b"\0")


def name_of(message: mavlink.MAVLink_param_value_message) -> str:
    """Return the parameter name in a received PARAM_VALUE."""
    name: bytes | str = message.param_id  # annotated as str, decoded as bytes
    text = name if isinstance(name, str) else name.decode("ascii", errors="replace")
    return text.rstrip("\0")


class RawParamValue(mavlink.MAVLink_param_value_message):
    """PARAM_VALUE whose value was never converted to a float; index 65535: unknown."""

    def __init__(self, name: str, raw: bytes, kind: int, count: int, index: int) -> None:
        super().__init__(name.encode("ascii"), _REAL32.unpack(raw)[0], kind, count, index)
        self.raw = raw

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """Return the frame's bytes."""
        rest = self.unpacker.pack(
            0.0, self.param_count, self.param_index, self.param_id.encode("ascii"), self.param_type
        )
        payload = self.raw + rest[VALUE_LENGTH:]
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))
