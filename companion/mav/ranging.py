"""RADIO_RANGING of a measurement; `companion.link.ranging_sources` reads it back.

Degrees, NED and the sentinels (NaN, UINT8_MAX) begin here.
"""

from __future__ import annotations

import math

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import bearing_ned_from_enu
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, RangingFlag

UINT8_MAX = 0xFF


def message_from_ranging(measurement: RangingMeasurement, time_usec: int) -> Message:
    """RADIO_RANGING of a measurement; `time_usec` is the sender's clock at its time."""
    flags = RangingFlag(0)
    bearing_rad = measurement.bearing_body_rad
    if bearing_rad is not None:
        flags |= RangingFlag.BODY_FRAME
    elif measurement.bearing_enu_rad is not None:
        bearing_rad = bearing_ned_from_enu(measurement.bearing_enu_rad)
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
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
