"""Parameter values on the wire: four bytes that encode an integer in one of two ways.

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

from companion.mav.addressing import payload_of
from companion.mav.dialect import Message, mavlink

NAME_LENGTH = 16
"""Characters of a parameter's name; a NUL follows only a shorter one."""
VALUE_LENGTH = 4
"""Bytes of a value."""
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
        """Least and greatest value of the type."""
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
