"""Dialect: the only import of pymavlink, with more messages registered in it.

All other modules take message classes and enum values from here. `development` is the dialect that
holds RANGING_BEACON (513) in addition to all of `common`. Added are our RADIO_RANGING and
TARGET_ESTIMATE (`radio_ranging.xml`: change the XML and this file together), ArduPilot's
EKF_STATUS_REPORT, and COMMAND_CANCEL, which pymavlink 2.4.50 lacks. They follow the protocol of
pymavlink's generated classes, so that the generated codec packs and decodes them; tests compare
them with mavgen's output.

Source: MAVLink developer guide, "Serialization" (order of fields); MAVLink common,
POSITION_TARGET_TYPEMASK and COMMAND_CANCEL; ArduPilot dialect, EKF_STATUS_REPORT.

It also builds RADIO_RANGING from a measurement, and carries TARGET_ESTIMATE in a TUNNEL.

`companion.link.ranging_sources` is the inverse for a ranging. Conversion to degrees, NED and the
sentinels (NaN, UINT8_MAX) happens here.

ArduPilot forwards only messages that it knows (observed on ArduCopter 4.5.7), so it gets an
estimate inside a TUNNEL, whose type is the id of the message that it carries.

Source: MAVLink common, TUNNEL: types above 32767 are free to use.
"""

from __future__ import annotations

import inspect
import math
import struct
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from itertools import accumulate
from types import MappingProxyType
from typing import Annotated, dataclass_transform

from pymavlink.dialects.v20 import development as mavlink

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import bearing_ned_from_enu

Message = mavlink.MAVLink_message

Uint8 = Annotated[int, "uint8_t", "B"]
Uint16 = Annotated[int, "uint16_t", "H"]
Uint32 = Annotated[int, "uint32_t", "I"]
Uint64 = Annotated[int, "uint64_t", "Q"]
Int32 = Annotated[int, "int32_t", "i"]
Float = Annotated[float, "float", "f"]
_NONE: Mapping[str, str] = MappingProxyType({})


@dataclass_transform()
class DeclaredMessage(mavlink.MAVLink_message):
    """Message class generated from the fields that its body declares, in the order of the XML."""

    def __init_subclass__(
        cls,
        *,
        number: int,
        crc_extra: int,
        extensions: int = 0,
        instance_field: str | None = None,
        units: Mapping[str, str] = _NONE,
        enums: Mapping[str, str] = _NONE,
        displays: Mapping[str, str] = _NONE,
    ) -> None:
        hints = inspect.get_annotations(cls, eval_str=True)
        names = list(hints)
        code = {name: hint.__metadata__[1] for name, hint in hints.items()}
        size = {name: struct.calcsize(f"<{code[name]}") for name in names}
        core = names[: len(names) - extensions]
        # on the wire the larger types come first, and extensions last
        ordered = [*sorted(core, key=lambda name: -size[name]), *names[len(core) :]]
        layout = "<" + "".join(code[name] for name in ordered)
        starts = accumulate((size[name] for name in ordered), initial=0)
        offsets = dict(zip(ordered, starts, strict=False))
        cls.id = number
        cls.msgname = cls.__name__.removeprefix("MAVLink_").removesuffix("_message").upper()
        cls.fieldnames, cls.ordered_fieldnames = names, ordered
        cls.fieldtypes = [hint.__metadata__[0] for hint in hints.values()]
        cls.fielddisplays_by_name = dict(displays)
        cls.fieldenums_by_name, cls.fieldunits_by_name = dict(enums), dict(units)
        cls.native_format = bytearray(layout, "ascii")
        cls.orders = [ordered.index(name) for name in names]
        cls.lengths, cls.array_lengths = [1] * len(names), [0] * len(names)
        cls.crc_extra = crc_extra
        cls.unpacker = struct.Struct(layout)
        cls.instance_field = instance_field
        cls.instance_offset = -1 if instance_field is None else offsets[instance_field]
        mavlink.mavlink_map[number] = cls

    def __init__(self, *values: float, **named: float) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field = self.instance_field
        self._instance_offset = self.instance_offset
        self.__dict__.update(zip(self.fieldnames, values, strict=False), **named)

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """Return the frame's bytes, with `mav`'s ids and sequence number (not advanced)."""
        payload = self.unpacker.pack(*(getattr(self, name) for name in self.ordered_fieldnames))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class MAVLink_command_cancel_message(
    DeclaredMessage, number=80, crc_extra=14, enums={"command": "MAV_CMD"}
):
    """Request to end a long-running command; its ACK, with CANCELLED, is the original command's."""

    target_system: Uint8
    target_component: Uint8
    command: Uint16


class MAVLink_ekf_status_report_message(
    DeclaredMessage,
    number=193,
    crc_extra=71,
    extensions=1,
    enums={"flags": "EKF_STATUS_FLAGS"},
    displays={"flags": "bitmask"},
):
    """Flags and variance ratios of ArduPilot's estimator."""

    flags: Uint16
    velocity_variance: Float
    pos_horiz_variance: Float
    pos_vert_variance: Float
    compass_variance: Float
    terrain_alt_variance: Float
    airspeed_variance: Float = 0.0


class RangingFlag(IntFlag):
    """Bits of RADIO_RANGING.flags."""

    BODY_FRAME = 1
    LINE_OF_SIGHT = 2
    NON_LINE_OF_SIGHT = 4
    ARRAY_ANGLE = 8
    """Angles are arcsines of components, as from a line or two-axis array; no azimuth."""


class MAVLink_radio_ranging_message(
    DeclaredMessage,
    number=45010,
    crc_extra=164,
    extensions=1,
    instance_field="emitter_id",
    units={
        "time_usec": "us",
        **dict.fromkeys(("range", "range_std"), "m"),
        **dict.fromkeys(("bearing", "bearing_std", "elevation", "elevation_std"), "rad"),
        "quality": "%",
        "power": "dBm",
    },
):
    """Response of an emitter: slant range, bearing, power (an extension; 0: none); NaN: none."""

    time_usec: Uint64
    range: Float
    range_std: Float
    bearing: Float
    bearing_std: Float
    elevation: Float
    elevation_std: Float
    emitter_id: Uint16
    quality: Uint8
    flags: Uint8
    power: Float = 0.0


INT32_UNKNOWN = 0x7FFFFFFF


class TargetState(IntEnum):
    """Values of TARGET_ESTIMATE.state."""

    SEARCHING = 0
    AMBIGUOUS = 1
    LOCALISED = 2
    DIVERGED = 3


class MAVLink_target_estimate_message(
    DeclaredMessage,
    number=45011,
    crc_extra=133,
    extensions=3,
    instance_field="emitter_id",
    units={
        "time_boot_ms": "ms",
        **dict.fromkeys(("lat", "lon"), "degE7"),
        **dict.fromkeys(("north", "east", "r95", "alt_north", "alt_east"), "m"),
        **dict.fromkeys(("height", "height_std", "range_offset"), "m"),
        **dict.fromkeys(("absolute_r95", "own_std", "own_height_std"), "m"),
        "bearing_offset": "rad",
    },
):
    """Estimated position with covariance; NaN: unknown; the last three are extensions, else 0."""

    time_boot_ms: Uint32
    lat: Int32
    lon: Int32
    north: Float
    east: Float
    var_north: Float
    cov_north_east: Float
    var_east: Float
    r95: Float
    alt_north: Float
    alt_east: Float
    height: Float
    height_std: Float
    range_offset: Float
    bearing_offset: Float
    measurements: Uint32
    emitter_id: Uint16
    state: Uint8
    absolute_r95: Float
    own_std: Float
    own_height_std: Float


def result_words(enum: str, value: int, prefix: str) -> str:
    """Return the name of a result as text, without its enum's prefix: `temporarily rejected`."""
    entry = mavlink.enums[enum].get(value)
    name = f"result {value}" if entry is None else str(entry.name)
    return name.removeprefix(prefix).lower().replace("_", " ")


X_IGNORE, Y_IGNORE, Z_IGNORE = 1, 2, 4
VX_IGNORE, VY_IGNORE, VZ_IGNORE = 8, 16, 32
AX_IGNORE, AY_IGNORE, AZ_IGNORE = 64, 128, 256
FORCE_SET = 512
YAW_IGNORE, YAW_RATE_IGNORE = 1024, 2048

POSITION_IGNORE = X_IGNORE | Y_IGNORE | Z_IGNORE
VELOCITY_IGNORE = VX_IGNORE | VY_IGNORE | VZ_IGNORE
ACCELERATION_IGNORE = AX_IGNORE | AY_IGNORE | AZ_IGNORE

POSITION_ONLY = VELOCITY_IGNORE | ACCELERATION_IGNORE | YAW_IGNORE | YAW_RATE_IGNORE
POSITION_AND_YAW = VELOCITY_IGNORE | ACCELERATION_IGNORE | YAW_RATE_IGNORE
SETPOINT_IDS = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    }
)
"""Messages by which a companion guides a vehicle."""

__all__ = [
    "MAVLink_command_cancel_message",
    "MAVLink_ekf_status_report_message",
    "MAVLink_radio_ranging_message",
    "MAVLink_target_estimate_message",
    "Message",
    "mavlink",
]


UINT8_MAX = 0xFF
TUNNEL_LENGTH = 128
CORE_LENGTH = 67
"""Payload length of TARGET_ESTIMATE without its extensions."""


ZERO_DBM = 1e-3
"""Value of RADIO_RANGING.power for a measured 0 dBm, because 0 is a missing extension: a thousandth
of the step in which radios measure power."""


def message_from_ranging(measurement: RangingMeasurement, time_usec: int) -> Message:
    """Return the RADIO_RANGING of a measurement; `time_usec` is the sender's clock at its time."""
    flags = RangingFlag(0)
    bearing_rad = measurement.bearing_body_rad
    if bearing_rad is not None:
        flags |= RangingFlag.BODY_FRAME
    elif measurement.bearing_enu_rad is not None:
        bearing_rad = bearing_ned_from_enu(measurement.bearing_enu_rad)
    if measurement.is_array_angle:
        flags |= RangingFlag.ARRAY_ANGLE
    if measurement.line_of_sight is not None:
        flags |= (
            RangingFlag.LINE_OF_SIGHT
            if measurement.line_of_sight
            else RangingFlag.NON_LINE_OF_SIGHT
        )
    quality = UINT8_MAX if measurement.quality is None else round(100.0 * measurement.quality)
    return MAVLink_radio_ranging_message(
        time_usec,
        _or_nan(measurement.range_m),
        _or_nan(measurement.range_sigma_m),
        _or_nan(bearing_rad),
        _or_nan(measurement.bearing_sigma_rad),
        _or_nan(measurement.elevation_rad),
        _or_nan(measurement.elevation_sigma_rad),
        measurement.emitter_id,
        quality,
        int(flags),
        0.0 if measurement.power_dbm is None else measurement.power_dbm or ZERO_DBM,
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def tunnelled(estimate: MAVLink_target_estimate_message) -> Message:
    """Return a broadcast TUNNEL with the payload of a TARGET_ESTIMATE.

    The length is that without extensions, which older readers require; the extensions lie behind
    it, where an older sender has zeros, by which MAVLink marks missing extensions.
    """
    fields = (getattr(estimate, name) for name in estimate.ordered_fieldnames)
    payload = estimate.unpacker.pack(*fields)
    data = list(payload.ljust(TUNNEL_LENGTH, b"\0"))
    return mavlink.MAVLink_tunnel_message(0, 0, estimate.id, CORE_LENGTH, data)


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
