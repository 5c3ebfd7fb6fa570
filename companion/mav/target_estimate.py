"""TARGET_ESTIMATE (45011), the message class for `radio_ranging.xml`.

Like RADIO_RANGING it follows the protocol of pymavlink's generated classes; the test that generates
both from the XML with mavgen compares them.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from pymavlink.dialects.v20 import development as mavlink

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
