"""How PX4 1.15 speaks each of MAVLink's services.

Every link has the streams of PX4's onboard link (MAV_x_MODE 2); its ground station link (mode 0) is
slower in some (GPS 5, VFR_HUD 4 Hz) and faster in others. One port serves stations and companions
here, so that there is no telling which of the two a link is.
"""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.autopilot.flavours.base import ProtocolRules
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols import parameters, plan_transfers
from sim_link.autopilot.protocols.commands import CommandForms
from sim_link.autopilot.protocols.message_requests import PX4_REQUESTS
from sim_link.autopilot.protocols.streams import StreamRules

DEFAULT_RATE_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: 30.0,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: 10.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: 10.0,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 10.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 10.0,
    mavlink.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 10.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 10.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 8.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: 0.0,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 0.0,
    mavlink.MAVLINK_MSG_ID_NAV_CONTROLLER_OUTPUT: 0.0,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_GLOBAL_INT: 0.0,
}
"""As measured on the onboard link, ATTITUDE's 99 Hz limited to a message per physics step; 0: only
on request. RC_CHANNELS come while there is a remote control."""

RULES = ProtocolRules(
    commands=CommandForms(),
    requests=PX4_REQUESTS,
    streams=StreamRules(DEFAULT_RATE_HZ, STEP_S),
    parameters=parameters.PX4_RULES,
    plans=plan_transfers.PX4_RULES,
    names_timesync_target=True,
    answers_ping=True,
    timesync_period_s=0.1,
    ping_period_s=1.0,
    tells_mode_at_once=False,
    first_mission_item=0,
)

CUSTOM_RULES = RULES._replace(
    streams=StreamRules(
        {
            number: rate_hz if number == mavlink.MAVLINK_MSG_ID_HEARTBEAT else 0.0
            for number, rate_hz in DEFAULT_RATE_HZ.items()
        },
        STEP_S,
    )
)
"""On links in mode Custom (PX4 MAV_1_MODE 1): whoever wants a stream asks for it."""
