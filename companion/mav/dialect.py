"""The only import of pymavlink: the generated dialect, with more messages registered in it.

Ours are RADIO_RANGING and TARGET_ESTIMATE; EKF_STATUS_REPORT is ArduPilot's; COMMAND_CANCEL is
missing from pymavlink's.

Everyone else takes message classes and enum values from here. `development` is the dialect that
holds RANGING_BEACON (513) beside all of `common`.

RADIO_RANGING (45010), the message class for `radio_ranging.xml`.

It follows the protocol of pymavlink's generated classes, so that the generated codec packs and
decodes it. A test generates the class from the XML with mavgen and compares CRC_EXTRA, length and
bytes: change the XML and this file together.

TARGET_ESTIMATE (45011), the message class for `radio_ranging.xml`.

Like RADIO_RANGING it follows the protocol of pymavlink's generated classes; the test that generates
both from the XML with mavgen compares them.

EKF_STATUS_REPORT (193) of the ArduPilotMega dialect, which `development` does not include.

ArduPilot tells the health of its estimator only this way. A test compares the class with the one
that pymavlink generates for that dialect.

COMMAND_CANCEL (80) of MAVLink common, which the dialects of pymavlink 2.4.50 do not have.

It follows the protocol of the generated classes; see RADIO_RANGING. Source: MAVLink common.

POSITION_TARGET_TYPEMASK values, built from the enum (a set bit means: ignore this field).

Source: MAVLink common, POSITION_TARGET_TYPEMASK; PX4 user guide, offboard mode.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag

from pymavlink.dialects.v20 import development as mavlink


class MAVLink_command_cancel_message(mavlink.MAVLink_message):
    """Ends a long-running command; its ACK, with CANCELLED, is the original command's."""

    id = 80
    msgname = "COMMAND_CANCEL"
    fieldnames = ["target_system", "target_component", "command"]
    ordered_fieldnames = ["command", "target_system", "target_component"]
    fieldtypes = ["uint8_t", "uint8_t", "uint16_t"]
    fielddisplays_by_name: dict[str, str] = {}
    fieldenums_by_name = {"command": "MAV_CMD"}
    fieldunits_by_name: dict[str, str] = {}
    native_format = bytearray(b"<HBB")
    orders = [1, 2, 0]
    lengths = [1, 1, 1]
    array_lengths = [0, 0, 0]
    crc_extra = 14
    unpacker = struct.Struct("<HBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, target_system: int, target_component: int, command: int) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self.target_system = target_system
        self.target_component = target_component
        self.command = command

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes, with `mav`'s ids and sequence number (which it does not advance)."""
        payload = self.unpacker.pack(self.command, self.target_system, self.target_component)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class MAVLink_ekf_status_report_message(mavlink.MAVLink_message):
    """Flags and variance ratios of ArduPilot's estimator."""

    id = 193
    msgname = "EKF_STATUS_REPORT"
    fieldnames = [
        "flags",
        "velocity_variance",
        "pos_horiz_variance",
        "pos_vert_variance",
        "compass_variance",
        "terrain_alt_variance",
        "airspeed_variance",
    ]
    ordered_fieldnames = [*fieldnames[1:6], "flags", "airspeed_variance"]
    fieldtypes = ["uint16_t", *["float"] * 6]
    fielddisplays_by_name: dict[str, str] = {"flags": "bitmask"}
    fieldenums_by_name: dict[str, str] = {"flags": "EKF_STATUS_FLAGS"}
    fieldunits_by_name: dict[str, str] = {}
    native_format = bytearray(b"<fffffHf")
    orders = [5, 0, 1, 2, 3, 4, 6]
    lengths = [1] * 7
    array_lengths = [0] * 7
    crc_extra = 71
    unpacker = struct.Struct("<fffffHf")
    instance_field = None
    instance_offset = -1

    def __init__(
        self,
        flags: int,
        velocity_variance: float,
        pos_horiz_variance: float,
        pos_vert_variance: float,
        compass_variance: float,
        terrain_alt_variance: float,
        airspeed_variance: float = 0.0,
    ) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field = self.instance_field
        self._instance_offset = self.instance_offset
        self.flags = flags
        self.velocity_variance = velocity_variance
        self.pos_horiz_variance = pos_horiz_variance
        self.pos_vert_variance = pos_vert_variance
        self.compass_variance = compass_variance
        self.terrain_alt_variance = terrain_alt_variance
        self.airspeed_variance = airspeed_variance

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes, with `mav`'s ids and sequence number (which it does not advance)."""
        payload = self.unpacker.pack(*(getattr(self, name) for name in self.ordered_fieldnames))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class RangingFlag(IntFlag):
    """Bits of RADIO_RANGING.flags."""

    BODY_FRAME = 1
    LINE_OF_SIGHT = 2
    NON_LINE_OF_SIGHT = 4


class MAVLink_radio_ranging_message(mavlink.MAVLink_message):
    """One answer of a radio emitter: slant range, bearing, or both; NaN means not measured."""

    id = 45010
    msgname = "RADIO_RANGING"
    fieldnames = [
        "time_usec",
        "range",
        "range_std",
        "bearing",
        "bearing_std",
        "elevation",
        "elevation_std",
        "emitter_id",
        "quality",
        "flags",
    ]
    ordered_fieldnames = list(fieldnames)
    fieldtypes = [
        "uint64_t",
        *["float"] * 6,
        "uint16_t",
        "uint8_t",
        "uint8_t",
    ]
    fielddisplays_by_name: dict[str, str] = {}
    fieldenums_by_name: dict[str, str] = {}
    fieldunits_by_name = {
        "time_usec": "us",
        "range": "m",
        "range_std": "m",
        "bearing": "rad",
        "bearing_std": "rad",
        "elevation": "rad",
        "elevation_std": "rad",
        "quality": "%",
    }
    native_format = bytearray(b"<QffffffHBB")
    orders = list(range(10))
    lengths = [1] * 10
    array_lengths = [0] * 10
    crc_extra = 164
    unpacker = struct.Struct("<QffffffHBB")
    instance_field = "emitter_id"
    instance_offset = 32

    def __init__(
        self,
        time_usec: int,
        range: float,
        range_std: float,
        bearing: float,
        bearing_std: float,
        elevation: float,
        elevation_std: float,
        emitter_id: int,
        quality: int,
        flags: int,
    ) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field = self.instance_field
        self._instance_offset = self.instance_offset
        self.time_usec = time_usec
        self.range = range
        self.range_std = range_std
        self.bearing = bearing
        self.bearing_std = bearing_std
        self.elevation = elevation
        self.elevation_std = elevation_std
        self.emitter_id = emitter_id
        self.quality = quality
        self.flags = flags

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes, with `mav`'s ids and sequence number (which it does not advance)."""
        payload = self.unpacker.pack(*(getattr(self, name) for name in self.ordered_fieldnames))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


INT32_UNKNOWN = 0x7FFFFFFF


class TargetState(IntEnum):
    """TARGET_ESTIMATE.state."""

    SEARCHING = 0
    AMBIGUOUS = 1
    LOCALISED = 2
    DIVERGED = 3


class MAVLink_target_estimate_message(mavlink.MAVLink_message):
    """Where an emitter is believed to be, with the whole covariance; NaN means not known."""

    id = 45011
    msgname = "TARGET_ESTIMATE"
    fieldnames = [
        "time_boot_ms",
        "lat",
        "lon",
        "north",
        "east",
        "var_north",
        "cov_north_east",
        "var_east",
        "r95",
        "alt_north",
        "alt_east",
        "height",
        "height_std",
        "range_offset",
        "bearing_offset",
        "measurements",
        "emitter_id",
        "state",
    ]
    ordered_fieldnames = list(fieldnames)
    fieldtypes = [
        "uint32_t",
        "int32_t",
        "int32_t",
        *["float"] * 12,
        "uint32_t",
        "uint16_t",
        "uint8_t",
    ]
    fielddisplays_by_name: dict[str, str] = {}
    fieldenums_by_name: dict[str, str] = {}
    fieldunits_by_name = {
        "time_boot_ms": "ms",
        "lat": "degE7",
        "lon": "degE7",
        "north": "m",
        "east": "m",
        "r95": "m",
        "alt_north": "m",
        "alt_east": "m",
        "height": "m",
        "height_std": "m",
        "range_offset": "m",
        "bearing_offset": "rad",
    }
    native_format = bytearray(b"<IiiffffffffffffIHB")
    orders = list(range(18))
    lengths = [1] * 18
    array_lengths = [0] * 18
    crc_extra = 133
    unpacker = struct.Struct("<IiiffffffffffffIHB")
    instance_field = "emitter_id"
    instance_offset = 64

    def __init__(
        self,
        time_boot_ms: int,
        lat: int,
        lon: int,
        north: float,
        east: float,
        var_north: float,
        cov_north_east: float,
        var_east: float,
        r95: float,
        alt_north: float,
        alt_east: float,
        height: float,
        height_std: float,
        range_offset: float,
        bearing_offset: float,
        measurements: int,
        emitter_id: int,
        state: int,
    ) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field = self.instance_field
        self._instance_offset = self.instance_offset
        self.time_boot_ms = time_boot_ms
        self.lat = lat
        self.lon = lon
        self.north = north
        self.east = east
        self.var_north = var_north
        self.cov_north_east = cov_north_east
        self.var_east = var_east
        self.r95 = r95
        self.alt_north = alt_north
        self.alt_east = alt_east
        self.height = height
        self.height_std = height_std
        self.range_offset = range_offset
        self.bearing_offset = bearing_offset
        self.measurements = measurements
        self.emitter_id = emitter_id
        self.state = state

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes, with `mav`'s ids and sequence number (which it does not advance)."""
        payload = self.unpacker.pack(*(getattr(self, name) for name in self.ordered_fieldnames))
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


X_IGNORE, Y_IGNORE, Z_IGNORE = 1, 2, 4
VX_IGNORE, VY_IGNORE, VZ_IGNORE = 8, 16, 32
AX_IGNORE, AY_IGNORE, AZ_IGNORE = 64, 128, 256
FORCE_SET = 512
YAW_IGNORE, YAW_RATE_IGNORE = 1024, 2048

POSITION_IGNORE = X_IGNORE | Y_IGNORE | Z_IGNORE
VELOCITY_IGNORE = VX_IGNORE | VY_IGNORE | VZ_IGNORE
ACCELERATION_IGNORE = AX_IGNORE | AY_IGNORE | AZ_IGNORE

POSITION_ONLY = VELOCITY_IGNORE | ACCELERATION_IGNORE | YAW_IGNORE | YAW_RATE_IGNORE
"""0x0DF8"""
POSITION_AND_YAW = VELOCITY_IGNORE | ACCELERATION_IGNORE | YAW_RATE_IGNORE
"""0x09F8"""


Message = mavlink.MAVLink_message

mavlink.mavlink_map[MAVLink_radio_ranging_message.id] = MAVLink_radio_ranging_message
mavlink.mavlink_map[MAVLink_target_estimate_message.id] = MAVLink_target_estimate_message
mavlink.mavlink_map[MAVLink_ekf_status_report_message.id] = MAVLink_ekf_status_report_message
mavlink.mavlink_map[MAVLink_command_cancel_message.id] = MAVLink_command_cancel_message

__all__ = [
    "MAVLink_command_cancel_message",
    "MAVLink_ekf_status_report_message",
    "MAVLink_radio_ranging_message",
    "MAVLink_target_estimate_message",
    "Message",
    "mavlink",
]
