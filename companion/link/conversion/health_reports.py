"""The autopilot's reports of its health and control as events: EKF, GNSS, battery, RC, target.

An estimate is poor where the autopilot's own check says so. ArduPilot: two of compass, velocity and
horizontal position at FS_EKF_THRESH (0.8), or the velocity at twice that. PX4: velocity or
horizontal position at a test ratio of 1. Neither judges by the compass or the height alone.

Source: MAVLink common, messages 1, 24 (accuracies are one sigma, 0 is unknown), 65, 74, 85,
124, 147, 230; ardupilotmega, EKF_STATUS_REPORT; ArduCopter `ekf_check.cpp`, ekf_over_threshold; PX4
`commander`, navigation test.
"""

from __future__ import annotations

import math

from companion.domain import MAX_COORDINATE_M, BatteryLevel
from companion.geometry.coordinates import enu_from_ned
from companion.guidance.events import (
    AccuracySource,
    BatteryReported,
    EstimatorStatusReported,
    Event,
    FixReported,
    PositionAccuracyReported,
    RcStatusReported,
    SetpointEchoed,
    SticksReported,
    ThrottleReported,
)
from companion.mav import dialect
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
NO_POSITION = mavlink.ESTIMATOR_CONST_POS_MODE
SOME_POSITION = mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_POS_HORIZ_REL
"""EKF_STATUS_FLAGS has the same bits."""
FIRST_BATTERY = 0
CENTRE_US, HALF_TRAVEL_US = 1500.0, 500.0
PULSES_US = range(800, 2201)
"""Valid range of RC pulses."""
RC_BIT = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
FULL_THROTTLE_PCT = 100


class HealthReports:
    """Reader of health messages; BATTERY_STATUS, once received, replaces SYS_STATUS's charge."""

    def __init__(self) -> None:
        self._has_battery_status = False
        self._has_flags = False
        """True once the estimator reported flags: from then on, none is a verdict, too."""

    def events(self, message: Message, now_s: float) -> list[Event]:
        """Return the events of a message, none for other kinds and for unknown values."""
        event: Event | None = None
        match message:
            case mavlink.MAVLink_sys_status_message():
                return self._status_events(message, now_s)
            case mavlink.MAVLink_estimator_status_message():
                event = self._verdict(message, _px4_ratio(message), now_s)
            case MAVLink_ekf_status_report_message():
                event = self._verdict(message, _ardupilot_ratio(message), now_s)
            case mavlink.MAVLink_gps_raw_int_message():
                event = _fix(message.fix_type, 0, now_s)
            case mavlink.MAVLink_gps2_raw_message():
                event = _fix(message.fix_type, 1, now_s)
            case mavlink.MAVLink_vfr_hud_message() if message.throttle <= FULL_THROTTLE_PCT:
                event = ThrottleReported(now_s, message.throttle / FULL_THROTTLE_PCT)
            case mavlink.MAVLink_battery_status_message() if message.id == FIRST_BATTERY:
                self._has_battery_status = True
                level = LEVELS.get(message.charge_state, BatteryLevel.UNKNOWN)
                event = BatteryReported(now_s, _percent(message.battery_remaining), level)
            case mavlink.MAVLink_rc_channels_message():
                event = _sticks(message, now_s)
            case mavlink.MAVLink_position_target_local_ned_message():
                event = _echo(message, now_s)
        return [*([] if event is None else [event]), *_position_accuracy(message, now_s)]

    def _verdict(
        self,
        message: mavlink.MAVLink_estimator_status_message | MAVLink_ekf_status_report_message,
        worst: float | None,
        now_s: float,
    ) -> EstimatorStatusReported | None:
        """Return the estimator's verdict; None if unknown."""
        flags, has_position = message.flags, None
        self._has_flags = self._has_flags or flags != 0
        if self._has_flags:
            has_position = bool(flags & SOME_POSITION) and not flags & NO_POSITION
        if worst is None and has_position is None:
            return None
        return EstimatorStatusReported(now_s, worst or 0.0, has_position)

    def _status_events(
        self, message: mavlink.MAVLink_sys_status_message, now_s: float
    ) -> list[Event]:
        """Return the charge, unless BATTERY_STATUS reports it, and the health of the RC input."""
        found: list[Event] = []
        if not self._has_battery_status:
            charge_pct = _percent(message.battery_remaining)
            found.append(BatteryReported(now_s, charge_pct, BatteryLevel.UNKNOWN))
        if message.onboard_control_sensors_present & RC_BIT:
            is_healthy = bool(message.onboard_control_sensors_health & RC_BIT)
            found.append(RcStatusReported(now_s, is_healthy))
        return found


def _px4_ratio(message: mavlink.MAVLink_estimator_status_message) -> float | None:
    """Return the worst ratio by which PX4 judges, 1 at its limit; None: unknown."""
    ratios = [r for r in (message.vel_ratio, message.pos_horiz_ratio) if math.isfinite(r)]
    return max(ratios) / BAD_RATIO if ratios else None


def _ardupilot_ratio(message: MAVLink_ekf_status_report_message) -> float | None:
    """Return the ratio of ArduPilot's votes, 1 at its limit; None: unknown."""
    velocity = message.velocity_variance
    votes = (velocity, message.pos_horiz_variance, message.compass_variance)
    known = sorted((vote for vote in votes if math.isfinite(vote)), reverse=True)
    if not known:
        return None
    second = known[1] if len(known) > 1 else 0.0
    doubled = velocity / 2.0 if math.isfinite(velocity) else 0.0
    return max(second, doubled) / BAD_VARIANCE


def _fix(fix_type: int, receiver: int, now_s: float) -> FixReported | None:
    if fix_type not in FIXES and fix_type not in NO_FIXES:
        return None
    return FixReported(now_s, fix_type in FIXES, receiver)


def _percent(value: int) -> float | None:
    return float(value) if 0 <= value <= 100 else None


def _sticks(message: mavlink.MAVLink_rc_channels_message, now_s: float) -> SticksReported | None:
    """Return the stick positions; None if no channels are received (chancount 0)."""
    pulses = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
    if not message.chancount or not all(pulse in PULSES_US for pulse in pulses):
        return None
    return SticksReported(now_s, tuple((p - CENTRE_US) / HALF_TRAVEL_US for p in pulses))


UINT32_MAX = 0xFFFF_FFFF
BEST_SIGMA_M, WORST_SIGMA_M = 0.01, 1000.0
"""Limits of a reported accuracy: no receiver is better, and beyond the other one it is useless."""


def _position_accuracy(message: Message, now_s: float) -> list[Event]:
    """Return the position accuracy that a message reports, or that it is unknown."""
    match message:
        case mavlink.MAVLink_gps_raw_int_message():
            reported_mm = (message.h_acc, message.v_acc) if message.fix_type in FIXES else (0, 0)
            known = (math.nan if mm == UINT32_MAX else mm / 1000.0 for mm in reported_mm)
            return [PositionAccuracyReported(now_s, AccuracySource.RECEIVER, *map(_sigma_m, known))]
        case mavlink.MAVLink_estimator_status_message():
            reported_m = (message.pos_horiz_accuracy, message.pos_vert_accuracy)
            return [
                PositionAccuracyReported(
                    now_s, AccuracySource.ESTIMATOR, *map(_sigma_m, reported_m)
                )
            ]
    return []


def _sigma_m(reported_m: float) -> float | None:
    """Return a plausible standard deviation; None for 0 and less, NaN and infinity."""
    if not 0.0 < reported_m < math.inf:
        return None
    return min(max(reported_m, BEST_SIGMA_M), WORST_SIGMA_M)


def _echo(
    message: mavlink.MAVLink_position_target_local_ned_message, now_s: float
) -> SetpointEchoed | None:
    """Return the echoed target; None for one in another frame, which cannot be compared."""
    if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None
    position_ned_m = (message.x, message.y, message.z)
    is_position = not message.type_mask & dialect.POSITION_IGNORE
    if any(abs(v) > MAX_COORDINATE_M for v in position_ned_m):
        return None
    if is_position and all(map(math.isfinite, position_ned_m)):
        return SetpointEchoed(now_s, enu_from_ned(position_ned_m))
    return SetpointEchoed(now_s, None)
