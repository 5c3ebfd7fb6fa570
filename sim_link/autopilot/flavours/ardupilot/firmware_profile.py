"""What ArduCopter 4.5 is, how it is set up and how it speaks; it sends no streams unasked.

`parameters.csv` has its parameters. Names, types and defaults were compared one by one with what an
ArduCopter 4.5.5 shows, and with SITL's `copter.parm` (battery monitor, flight modes, fence radius,
throttle failsafe); ranges are those of the Copter Parameter List by sense. ArduPilot checks no
ranges; here a value out of range is refused, because a simulator that flies on with a wrapped
integer teaches nobody anything. The battery failsafes are BATT_FS_*, as since Copter 3.6.
"""

from __future__ import annotations

import math

from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink
from companion.mav.param_encoding import ParamEncoding
from sim_link.autopilot.flavours.base import DENIED, FAILED, Firmware
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.command_protocol import CommandForms
from sim_link.autopilot.protocols.message_streams import RequestRules, StreamRules, message_ids
from sim_link.autopilot.protocols.parameter_protocol import ParameterRules
from sim_link.autopilot.protocols.parameter_store import ParameterStore, read_specs
from sim_link.autopilot.protocols.plan_items import PlanType
from sim_link.autopilot.protocols.plan_rules import PlanChecks, PlanRules, commands_named
from sim_link.autopilot.scenario import Scenario

ARDUPILOT_PARAMETERS = read_specs("sim_link.autopilot.flavours.ardupilot")


def ardupilot_parameters(scenario: Scenario) -> ParameterStore:
    """ArduCopter's parameters as a scenario has them.

    The voltages of the battery failsafe are those of the simulated four-cell pack at 15 and 7 %;
    what is done about it is ArduPilot's default: a text.
    """
    initial: dict[str, float] = {
        "SYSID_THISMAV": scenario.system_id,
        "BATT_LOW_VOLT": 14.42,
        "BATT_CRT_VOLT": 14.2,
    }
    return ParameterStore(ARDUPILOT_PARAMETERS, initial | scenario.autopilot.parameters)


EKF_STATUS_REPORT = MAVLink_ekf_status_report_message.id
ON_REQUEST = message_ids(
    "SYS_STATUS SYSTEM_TIME EXTENDED_SYS_STATE LOCAL_POSITION_NED ATTITUDE ATTITUDE_QUATERNION "
    "GLOBAL_POSITION_INT POSITION_TARGET_LOCAL_NED POSITION_TARGET_GLOBAL_INT GPS_RAW_INT VFR_HUD "
    "NAV_CONTROLLER_OUTPUT RC_CHANNELS SERVO_OUTPUT_RAW RAW_IMU SCALED_PRESSURE POWER_STATUS "
    "VIBRATION ATTITUDE_TARGET MISSION_CURRENT BATTERY_STATUS HOME_POSITION GPS_GLOBAL_ORIGIN "
    "AUTOPILOT_VERSION"
)
DATA_STREAMS: dict[int, tuple[int, ...]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: message_ids("RAW_IMU SCALED_PRESSURE"),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: message_ids(
        "SYS_STATUS POWER_STATUS MISSION_CURRENT GPS_RAW_INT NAV_CONTROLLER_OUTPUT"
    ),
    mavlink.MAV_DATA_STREAM_RC_CHANNELS: message_ids("SERVO_OUTPUT_RAW RC_CHANNELS"),
    mavlink.MAV_DATA_STREAM_POSITION: message_ids("LOCAL_POSITION_NED GLOBAL_POSITION_INT"),
    mavlink.MAV_DATA_STREAM_EXTRA1: message_ids("ATTITUDE"),
    mavlink.MAV_DATA_STREAM_EXTRA2: message_ids("VFR_HUD"),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        *message_ids("SYSTEM_TIME BATTERY_STATUS VIBRATION"),
        EKF_STATUS_REPORT,
    ),
}
"""Messages of each MAV_DATA_STREAM group, ArduPilot `GCS_Mavlink.cpp`."""

FIRMWARE = Firmware(
    autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    version=0x0405_07FF,  # 4.5.7, official release: the one whose behaviour is simulated
    # 4.5 sets neither encoding bit; the guide wants one of them.
    capabilities=0xFBEF | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
    refusal=FAILED,
    termination=(mavlink.MAV_SEVERITY_EMERGENCY, "Flight termination"),
    keeps_given_home=False,
    commands=CommandForms(
        int_only=frozenset({mavlink.MAV_CMD_DO_REPOSITION}), splits_custom_mode=False
    ),
    requests=RequestRules(no_message=FAILED, no_stream=DENIED, no_interval=FAILED, has_texts=True),
    streams=StreamRules(
        {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mavlink.MAVLINK_MSG_ID_TIMESYNC: 0.1}
        | dict.fromkeys((*ON_REQUEST, EKF_STATUS_REPORT), 0.0),
        STEP_S,
        groups=DATA_STREAMS,
    ),
    # Measured: 1364 values in 0.87 s. It is silent on errors; clients wait for PARAM_ERROR.
    parameters=ParameterRules(
        ParamEncoding.C_CAST,
        checks_type=False,
        tells_errors=True,
        tells_index_of_named=False,
        has_hash_check=False,
        list_rate_hz=1500.0,
    ),
    plans=PlanRules(
        capacity={PlanType.MISSION: 650, PlanType.FENCE: 84, PlanType.RALLY: 50},
        checks=PlanChecks(
            zero_is_here=True,
            more_positions=commands_named("NAV_SPLINE_WAYPOINT DO_SET_HOME"),
            more_others=commands_named("NAV_GUIDED_ENABLE DO_SET_RELAY DO_FENCE_ENABLE"),
        ),
        retry_s=1.0,
        timeout_s=8.0,
        is_atomic=False,
        is_one_at_a_time=True,
        can_be_cancelled=False,
        waits_for_ack=False,
        tells_wrong_number=True,
        asks_in_old_form=True,
        stores_less=True,
    ),
    rejects_for_others=False,
    empty_calibration=DENIED,
    names_timesync_target=False,
    answers_ping=False,
    tells_mode_at_once=True,
    obeys_rc_override=True,
    takes_origin=False,
    first_mission_item=1,
    home_orientation=(math.nan, math.nan, math.nan, math.nan),
)
