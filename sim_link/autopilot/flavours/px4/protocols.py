"""How PX4 1.15 speaks each of MAVLink's services.

Streams lie between the rates that PX4 was seen to use on its onboard and its ground station link,
with those lowered that only fill the link; a client asks for more with SET_MESSAGE_INTERVAL.
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
"""0: only on request."""

RULES = ProtocolRules(
    commands=CommandForms(),
    requests=PX4_REQUESTS,
    streams=StreamRules(DEFAULT_RATE_HZ, STEP_S),
    parameters=parameters.PX4_RULES,
    plans=plan_transfers.PX4_RULES,
    names_timesync_target=True,
    answers_ping=True,
    asks_timesync=False,
    tells_mode_at_once=False,
    first_mission_item=0,
)
