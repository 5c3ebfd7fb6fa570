"""PX4's streams: which are sent unasked and how often.

Between the rates that PX4 1.15 was seen to use on its onboard and its ground station link, with
those lowered that only fill the link; a client asks for more with SET_MESSAGE_INTERVAL.
"""

from __future__ import annotations

from companion.mav.dialect import mavlink

DEFAULT_RATE_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 20.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 10.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 10.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 4.0,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: 2.0,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: 1.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 0.0,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: 0.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: 0.0,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: 0.0,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 0.0,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: 0.0,
}
