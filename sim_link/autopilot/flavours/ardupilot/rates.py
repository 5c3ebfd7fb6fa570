"""ArduPilot's streams: nothing but HEARTBEAT until somebody asks, and what can be asked for."""

from __future__ import annotations

from companion.mav.dialect import mavlink
from companion.mav.ekf_status_report import MAVLink_ekf_status_report_message

DEFAULT_RATE_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 0.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 0.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 0.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 0.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 0.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: 0.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 0.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 0.0,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: 0.0,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 0.0,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: 0.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.0,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.0,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 0.0,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: 0.0,
    MAVLink_ekf_status_report_message.id: 0.0,
}
