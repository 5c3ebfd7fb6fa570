"""How ArduCopter 4.5 speaks each of MAVLink's services: no streams until somebody asks."""

from __future__ import annotations

from dataclasses import replace

from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink
from sim_link.autopilot.flavours.base import ProtocolRules
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols import parameters, plan_transfers
from sim_link.autopilot.protocols.commands import CommandForms
from sim_link.autopilot.protocols.message_requests import ARDUPILOT_REQUESTS
from sim_link.autopilot.protocols.streams import StreamRules

EKF_STATUS_REPORT = MAVLink_ekf_status_report_message.id
ON_REQUEST = (
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
    mavlink.MAVLINK_MSG_ID_VFR_HUD,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS,
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    mavlink.MAVLINK_MSG_ID_POWER_STATUS,
    mavlink.MAVLINK_MSG_ID_VIBRATION,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    EKF_STATUS_REPORT,
)
DATA_STREAMS: dict[int, tuple[int, ...]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,
    ),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_POWER_STATUS,
        mavlink.MAVLINK_MSG_ID_MISSION_CURRENT,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT,
    ),
    mavlink.MAV_DATA_STREAM_RC_CHANNELS: (
        mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
        mavlink.MAVLINK_MSG_ID_RC_CHANNELS,
    ),
    mavlink.MAV_DATA_STREAM_POSITION: (
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    ),
    mavlink.MAV_DATA_STREAM_EXTRA1: (mavlink.MAVLINK_MSG_ID_ATTITUDE,),
    mavlink.MAV_DATA_STREAM_EXTRA2: (mavlink.MAVLINK_MSG_ID_VFR_HUD,),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_BATTERY_STATUS,
        mavlink.MAVLINK_MSG_ID_VIBRATION,
        EKF_STATUS_REPORT,
    ),
}
"""Messages of each MAV_DATA_STREAM group, ArduPilot `GCS_Mavlink.cpp`."""

RULES = ProtocolRules(
    commands=CommandForms(
        int_only=frozenset({mavlink.MAV_CMD_DO_REPOSITION}), splits_custom_mode=False
    ),
    requests=ARDUPILOT_REQUESTS,
    streams=StreamRules(
        {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0} | dict.fromkeys(ON_REQUEST, 0.0),
        STEP_S,
        groups=DATA_STREAMS,
    ),
    # ArduPilot is silent about what does not exist; clients wait for PARAM_ERROR
    parameters=replace(parameters.ARDUPILOT_RULES, tells_errors=True),
    plans=plan_transfers.ARDUPILOT_RULES,
    names_timesync_target=False,
    answers_ping=False,
    timesync_period_s=10.0,
    ping_period_s=None,
    tells_mode_at_once=True,
    first_mission_item=1,
)
