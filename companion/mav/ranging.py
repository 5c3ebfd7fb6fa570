"""Ranging on the wire: encode and decode side by side.

RADIO_RANGING is our own message; LANDING_TARGET of type RADIO_BEACON and RANGING_BEACON are read
as well. Degrees, millimetres, NED and the sentinels (NaN, UINT8_MAX, UINT32_MAX) end here.
Infinities and absurd numbers pass through on purpose: refusing them, with a counted reason, is
the tracker's task.
"""

from __future__ import annotations

import math

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import bearing_enu_from_ned, bearing_ned_from_enu
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, RangingFlag, mavlink

UINT8_MAX = 0xFF
UINT32_MAX = 0xFFFFFFFF
MAX_BEARING_RAD = math.pi + 1e-6
"""Half a turn, which in 32 bits is a little more than one."""


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _enu_or_none(bearing_ned_rad: float) -> float | None:
    if not math.isfinite(bearing_ned_rad):
        return _or_none(bearing_ned_rad)
    if abs(bearing_ned_rad) > MAX_BEARING_RAD:  # most likely degrees: shown as sent, refused later
        return bearing_ned_rad
    return bearing_enu_from_ned(bearing_ned_rad)


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


def ranging_from_message(message: Message, measured_at_s: float) -> RangingMeasurement | None:
    """The measurement in a ranging message, or None if it is no ranging message.

    Args:
        measured_at_s: Its `time_usec` on the companion's clock.
    """
    match message:
        case MAVLink_radio_ranging_message():
            return _from_radio_ranging(message, measured_at_s)
        case mavlink.MAVLink_landing_target_message():
            if message.type == mavlink.LANDING_TARGET_TYPE_RADIO_BEACON:
                return _from_landing_target(message, measured_at_s)
        case mavlink.MAVLink_ranging_beacon_message():
            return _from_ranging_beacon(message, measured_at_s)
    return None


def _from_radio_ranging(
    message: MAVLink_radio_ranging_message, measured_at_s: float
) -> RangingMeasurement:
    flags = RangingFlag(message.flags & 0x07)
    is_body = RangingFlag.BODY_FRAME in flags
    line_of_sight = None
    if RangingFlag.LINE_OF_SIGHT in flags:
        line_of_sight = True
    elif RangingFlag.NON_LINE_OF_SIGHT in flags:
        line_of_sight = False
    return RangingMeasurement(
        emitter_id=message.emitter_id,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=_or_none(message.range),
        range_sigma_m=_or_none(message.range_std),
        bearing_enu_rad=None if is_body else _enu_or_none(message.bearing),
        bearing_body_rad=_or_none(message.bearing) if is_body else None,
        bearing_sigma_rad=_or_none(message.bearing_std),
        elevation_rad=_or_none(message.elevation),
        elevation_sigma_rad=_or_none(message.elevation_std),
        quality=None if message.quality == UINT8_MAX else message.quality / 100.0,
        line_of_sight=line_of_sight,
    )


def _from_landing_target(
    message: mavlink.MAVLink_landing_target_message, measured_at_s: float
) -> RangingMeasurement:
    """LANDING_TARGET: `distance` is the slant range, 0 unknown; `angle_x` is from the nose."""
    range_m = _or_none(message.distance)
    return RangingMeasurement(
        emitter_id=message.target_num,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=None if range_m == 0.0 else range_m,
        bearing_body_rad=_or_none(message.angle_x),
    )


def _from_ranging_beacon(
    message: mavlink.MAVLink_ranging_beacon_message, measured_at_s: float
) -> RangingMeasurement:
    """RANGING_BEACON: range and its accuracy in millimetres, UINT32_MAX (or accuracy 0) unknown.

    Its beacon position is not read: this project looks for the position of an emitter.
    """
    unknown_sigma = message.range_accuracy in (0, UINT32_MAX)
    return RangingMeasurement(
        emitter_id=message.beacon_id,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=None if message.range == UINT32_MAX else message.range / 1000.0,
        range_sigma_m=None if unknown_sigma else message.range_accuracy / 1000.0,
    )
