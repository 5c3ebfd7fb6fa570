"""RADIO_RANGING (45010), the message class for `radio_ranging.xml`.

It follows the protocol of pymavlink's generated classes, so that the generated codec packs and
decodes it. A test generates the class from the XML with mavgen and compares CRC_EXTRA, length and
bytes: change the XML and this file together.
"""

from __future__ import annotations

import struct
from enum import IntFlag

from pymavlink.dialects.v20 import development as mavlink


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
