"""What PX4's HEARTBEAT shows of mode, arming and failsafe.

Source: PX4 1.15 as observed in SITL; MAVLink common, MAV_MODE_FLAG and MAV_STATE.
"""

from __future__ import annotations

from companion.domain import FlightMode
from companion.mav.dialect import mavlink
from companion.mav.modes import CUSTOM_MODE_ENABLED, px4_custom_mode
from sim_link.autopilot.flavours.base import Shown

AUTO_FLAGS = (
    mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    | mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
)
STICK_FLAGS = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
BASE_MODE_FLAGS: dict[FlightMode, int] = {
    FlightMode.POSITION: STICK_FLAGS,
    FlightMode.ALTITUDE: STICK_FLAGS,
    FlightMode.STABILIZED: STICK_FLAGS,
    FlightMode.MANUAL: mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
    FlightMode.ACRO: mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
}
"""What a mode adds to CUSTOM_MODE_ENABLED; modes not listed are automatic (OFFBOARD apart)."""


def shown(
    mode: FlightMode, *, is_armed: bool, is_failsafe: bool, is_stream_alive: bool, can_arm: bool
) -> Shown:
    """What HEARTBEAT shows: disarmed, OFFBOARD without a stream has no flag but the first."""
    base_mode = CUSTOM_MODE_ENABLED
    if mode is FlightMode.OFFBOARD:
        if is_armed or is_stream_alive:
            base_mode |= mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    else:
        base_mode |= BASE_MODE_FLAGS.get(mode, AUTO_FLAGS)
    if is_armed:
        base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        status = mavlink.MAV_STATE_CRITICAL if is_failsafe else mavlink.MAV_STATE_ACTIVE
    else:
        status = mavlink.MAV_STATE_STANDBY if can_arm else mavlink.MAV_STATE_UNINIT
    return Shown(base_mode, px4_custom_mode(mode), status)
