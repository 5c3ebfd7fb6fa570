"""EKF_STATUS_REPORT (193) of the ArduPilotMega dialect, which `development` does not include.

ArduPilot tells the health of its estimator only this way. A test compares the class with the one
that pymavlink generates for that dialect.
"""

from __future__ import annotations

import struct

from pymavlink.dialects.v20 import development as mavlink


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
