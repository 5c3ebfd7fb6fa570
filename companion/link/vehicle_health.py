"""What the autopilot tells of its health and of what it follows, as events.

Source: MAVLink common, messages 24, 65, 85, 147, 230; ardupilotmega, EKF_STATUS_REPORT. ArduPilot
calls a variance of 0.8 bad (FS_EKF_THRESH), PX4 a test ratio of 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from companion.domain import BatteryLevel
from companion.geometry.frames import enu_from_ned
from companion.guidance.events import (
    BatteryReported,
    EstimatorRated,
    Event,
    FixReported,
    SetpointEchoed,
    SticksReported,
)
from companion.mav import type_mask
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink

BAD_RATIO = 1.0
BAD_VARIANCE = 0.8
FIXES = range(mavlink.GPS_FIX_TYPE_3D_FIX, mavlink.GPS_FIX_TYPE_PPP + 1)
NO_FIXES = range(mavlink.GPS_FIX_TYPE_NO_GPS, mavlink.GPS_FIX_TYPE_3D_FIX)
LEVELS: dict[int, BatteryLevel] = {
    mavlink.MAV_BATTERY_CHARGE_STATE_OK: BatteryLevel.GOOD,
    mavlink.MAV_BATTERY_CHARGE_STATE_LOW: BatteryLevel.LOW,
    mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL: BatteryLevel.CRITICAL,
    mavlink.MAV_BATTERY_CHARGE_STATE_EMERGENCY: BatteryLevel.CRITICAL,
    mavlink.MAV_BATTERY_CHARGE_STATE_FAILED: BatteryLevel.CRITICAL,
}
FIRST_BATTERY = 0
MAX_COORDINATE_M = 1e6
"""A target farther from the origin is no place."""
CENTRE_US, HALF_TRAVEL_US = 1500.0, 500.0
PULSES_US = range(800, 2201)
"""Anything else is no position of a stick."""


class VehicleHealthInbound:
    """Events from messages about health; two of them tell the charge, and the better one counts."""

    def __init__(self) -> None:
        self._has_battery_status = False

    def restart(self) -> None:
        """The autopilot restarted."""
        self._has_battery_status = False

    def events(self, message: Message, now_s: float) -> list[Event]:
        """What a message says; nothing for other messages, and for values that nobody knows."""
        event: Event | None = None
        match message:
            case mavlink.MAVLink_position_target_local_ned_message():
                event = _echo(message, now_s)
            case mavlink.MAVLink_estimator_status_message():
                m = message
                ratios = (m.vel_ratio, m.pos_horiz_ratio, m.pos_vert_ratio, m.mag_ratio)
                event = _rated(ratios, BAD_RATIO, now_s)
            case MAVLink_ekf_status_report_message():
                r = message
                variances = (r.velocity_variance, r.pos_horiz_variance, r.pos_vert_variance)
                event = _rated((*variances, r.compass_variance), BAD_VARIANCE, now_s)
            case mavlink.MAVLink_gps_raw_int_message():
                if message.fix_type in FIXES or message.fix_type in NO_FIXES:
                    event = FixReported(now_s, message.fix_type in FIXES)
            case mavlink.MAVLink_battery_status_message() if message.id == FIRST_BATTERY:
                self._has_battery_status = True
                level = LEVELS.get(message.charge_state, BatteryLevel.UNKNOWN)
                event = BatteryReported(now_s, _percent(message.battery_remaining), level)
            case mavlink.MAVLink_sys_status_message() if not self._has_battery_status:
                charge_pct = _percent(message.battery_remaining)
                event = BatteryReported(now_s, charge_pct, BatteryLevel.UNKNOWN)
            case mavlink.MAVLink_rc_channels_message():
                event = _sticks(message, now_s)
        return [] if event is None else [event]


def _echo(
    message: mavlink.MAVLink_position_target_local_ned_message, now_s: float
) -> SetpointEchoed | None:
    """The target; one in another frame says nothing that could be compared."""
    if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None
    place = (message.x, message.y, message.z)
    is_position = not message.type_mask & type_mask.POSITION_IGNORE
    if any(abs(v) > MAX_COORDINATE_M for v in place):
        return None
    if is_position and all(map(math.isfinite, place)):
        return SetpointEchoed(now_s, enu_from_ned(place))
    return SetpointEchoed(now_s, None)


def _rated(values: Iterable[float], bad: float, now_s: float) -> EstimatorRated | None:
    known = [value for value in values if math.isfinite(value)]
    return EstimatorRated(now_s, max(known) / bad) if known else None


def _percent(value: int) -> float | None:
    return float(value) if 0 <= value <= 100 else None


def _sticks(message: mavlink.MAVLink_rc_channels_message, now_s: float) -> SticksReported | None:
    pulses = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
    if not all(pulse in PULSES_US for pulse in pulses):
        return None
    return SticksReported(now_s, tuple((p - CENTRE_US) / HALF_TRAVEL_US for p in pulses))
