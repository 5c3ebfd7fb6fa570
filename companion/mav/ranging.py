"""RADIO_RANGING from a measurement; TARGET_ESTIMATE in a TUNNEL past an autopilot, and out of it.

`companion.link.ranging_sources` is the inverse for a ranging. Conversion to degrees, NED and the
sentinels (NaN, UINT8_MAX) happens here.

ArduPilot forwards only messages that it knows (observed on ArduCopter 4.5.7), so it gets an
estimate inside a TUNNEL, whose type is the id of the message that it carries.

Source: MAVLink common, TUNNEL: types above 32767 are free to use.
"""

from __future__ import annotations

import math

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import bearing_ned_from_enu
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
    Message,
    RangingFlag,
    mavlink,
)

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
