"""How ArduCopter 4.5 is set up and speaks: its parameters, protocol rules, and no streams unasked.

Names, types and defaults were compared one by one with what an ArduCopter 4.5.5 shows, and with
SITL's `copter.parm` (battery monitor, flight modes, fence radius, throttle failsafe); ranges are
those of the Copter Parameter List by sense. ArduPilot checks no ranges; here a value out of range
is refused, because a simulator that flies on with a wrapped integer teaches nobody anything.
"""

from __future__ import annotations

from dataclasses import replace

from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink
from companion.mav.param_encoding import ParamType
from sim_link.autopilot.flavours.base import ProtocolRules
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols import parameter_protocol, plan_rules
from sim_link.autopilot.protocols.command_protocol import CommandForms
from sim_link.autopilot.protocols.message_streams import (
    ARDUPILOT_REQUESTS,
    StreamRules,
    message_ids,
)
from sim_link.autopilot.protocols.parameter_store import ParameterStore, ParamSpec, spec_of
from sim_link.autopilot.scenario import Scenario

_int8, _int16 = spec_of(ParamType.INT8), spec_of(ParamType.INT16)
_int32, _real = spec_of(ParamType.INT32), spec_of(ParamType.REAL32)

_STREAM_GROUPS = "RAW_SENS EXT_STAT RC_CHAN RAW_CTRL POSITION EXTRA1 EXTRA2 EXTRA3 PARAMS ADSB"
_STREAM_RATES = tuple(
    _int16(f"SR{link}_{group}", 0, 0, 50, "Hz")
    for link in (0, 1)
    for group in _STREAM_GROUPS.split()
)

ARDUPILOT_PARAMETERS: tuple[ParamSpec, ...] = (
    _int16("FORMAT_VERSION", 120, is_read_only=True),
    _int16("SYSID_THISMAV", 1, 1, 255),
    _int16("SYSID_MYGCS", 255, 1, 255),
    _real("PILOT_TKOFF_ALT", 0.0, 0.0, 1000.0, "cm"),
    _int16("PILOT_THR_BHV", 0, 0, 7),
    _int16("GCS_PID_MASK", 0, 0, 63),
    _int32("RTL_ALT", 1500, 30, 300_000, "cm"),
    _real("RTL_CONE_SLOPE", 3.0, 0.0, 10.0),
    _int16("RTL_SPEED", 0, 0, 2000, "cm/s"),
    _int16("RTL_ALT_FINAL", 0, 0, 1000, "cm"),
    _int16("RTL_CLIMB_MIN", 0, 0, 3000, "cm"),
    _int32("RTL_LOIT_TIME", 5000, 0, 60_000, "ms"),
    _int8("RTL_ALT_TYPE", 0, 0, 1),
    _int8("FS_GCS_ENABLE", 0, 0, 7),
    _real("FS_GCS_TIMEOUT", 5.0, 2.0, 120.0, "s"),
    _int16("GPS_HDOP_GOOD", 140, 100, 900),
    _int8("SUPER_SIMPLE", 0, 0, 63),
    _int8("SIMPLE", 0, 0, 63),
    _int8("WP_YAW_BEHAVIOR", 2, 0, 3),
    _int16("LAND_SPEED", 50, 30, 200, "cm/s"),
    _int16("LAND_SPEED_HIGH", 0, 0, 500, "cm/s"),
    _int16("LAND_ALT_LOW", 1000, 100, 10_000, "cm"),
    _int8("LAND_REPOSITION", 1, 0, 1),
    _int16("PILOT_SPEED_UP", 250, 50, 500, "cm/s"),
    _int16("PILOT_SPEED_DN", 0, 0, 500, "cm/s"),
    _int16("PILOT_ACCEL_Z", 250, 50, 500, "cm/s^2"),
    _int8("FS_THR_ENABLE", 1, 0, 7),
    _int16("FS_THR_VALUE", 975, 910, 1100, "PWM"),
    _int16("THR_DZ", 100, 0, 300, "PWM"),
    *(_int8(f"FLTMODE{n}", mode, 0, 28) for n, mode in enumerate((7, 9, 6, 3, 5, 0), 1)),
    _int8("FLTMODE_CH", 5, 0, 16),
    _int8("INITIAL_MODE", 0, 0, 28),
    _real("CIRCLE_RADIUS", 1000.0, 0.0, 200_000.0, "cm"),
    _real("CIRCLE_RATE", 20.0, -90.0, 90.0, "deg/s"),
    _int32("LOG_BITMASK", 176_126, 0, None),
    _int16("ANGLE_MAX", 3000, 1000, 8000, "cdeg"),
    _int8("DISARM_DELAY", 10, 0, 127),
    _int8("FS_EKF_ACTION", 1, 1, 3),
    _real("FS_EKF_THRESH", 0.8, 0.6, 1.0),
    _int8("FS_CRASH_CHECK", 1, 0, 1),
    _int8("FS_VIBE_ENABLE", 1, 0, 1),
    _int32("FS_OPTIONS", 16, 0, 127),
    _int8("FRAME_CLASS", 1, 0, 17),
    _int8("FRAME_TYPE", 0, 0, 19),
    _real("GUID_TIMEOUT", 3.0, 0.1, 5.0, "s"),
    _int32("GUID_OPTIONS", 0, 0, 255),
    _int32("ARMING_CHECK", 1, 0, 2_097_151),
    _int8("ARMING_RUDDER", 2, 0, 2),
    _int8("AHRS_EKF_TYPE", 3, 0, 11),
    _int8("EK3_ENABLE", 1, 0, 1),
    _int8("COMPASS_USE", 1, 0, 1),
    _int8("GPS_TYPE", 1, 0, 26),
    _int8("AVOID_ENABLE", 3, 0, 7),
    _int8("TERRAIN_ENABLE", 1, 0, 1),
    _int8("RALLY_INCL_HOME", 1, 0, 1),
    _int8("RALLY_TOTAL", 0, 0, 127),
    _real("RALLY_LIMIT_KM", 0.3, 0.0, 100.0, "km"),
    _int8("FENCE_ENABLE", 0, 0, 1),
    _int8("FENCE_TYPE", 7, 0, 15),
    _int8("FENCE_ACTION", 1, 0, 5),
    _real("FENCE_ALT_MAX", 100.0, 10.0, 1000.0, "m"),
    _real("FENCE_RADIUS", 150.0, 30.0, 10_000.0, "m"),
    _real("FENCE_MARGIN", 2.0, 1.0, 10.0, "m"),
    _int8("FENCE_TOTAL", 0, 0, 84),
    _real("FENCE_ALT_MIN", -10.0, -100.0, 100.0, "m"),
    _int8("BATT_MONITOR", 4, 0, 30),
    _int32("BATT_CAPACITY", 3300, 0, None, "mAh"),
    _int8("BATT_LOW_TIMER", 10, 0, 120),
    _real("BATT_LOW_VOLT", 10.5, 0.0, 120.0, "V"),
    _real("BATT_LOW_MAH", 0.0, 0.0, 100_000.0, "mAh"),
    _real("BATT_CRT_VOLT", 0.0, 0.0, 120.0, "V"),
    _real("BATT_CRT_MAH", 0.0, 0.0, 100_000.0, "mAh"),
    _int8("BATT_FS_LOW_ACT", 0, 0, 7),
    _int8("BATT_FS_CRT_ACT", 0, 0, 7),
    _real("BATT_ARM_VOLT", 0.0, 0.0, 120.0, "V"),
    _real("WPNAV_SPEED", 1000.0, 10.0, 2000.0, "cm/s"),
    _real("WPNAV_RADIUS", 200.0, 5.0, 1000.0, "cm"),
    _real("WPNAV_SPEED_UP", 250.0, 10.0, 1000.0, "cm/s"),
    _real("WPNAV_SPEED_DN", 150.0, 10.0, 500.0, "cm/s"),
    _real("WPNAV_ACCEL", 250.0, 50.0, 500.0, "cm/s^2"),
    _real("WPNAV_ACCEL_Z", 100.0, 50.0, 500.0, "cm/s^2"),
    _int8("WPNAV_RFND_USE", 1, 0, 1),
    _real("LOIT_SPEED", 1250.0, 20.0, 3500.0, "cm/s"),
    _real("LOIT_ACC_MAX", 500.0, 100.0, 981.0, "cm/s^2"),
    _int16("MIS_TOTAL", 0, is_read_only=True),
    _int8("MIS_RESTART", 0, 0, 1),
    _int16("MIS_OPTIONS", 0, 0, 7),
    _int16("SCHED_LOOP_RATE", 400, 50, 400, "Hz"),
    _int8("SERIAL0_PROTOCOL", 2, -1, 49),
    _int32("SERIAL0_BAUD", 115, 1, 2000),
    *_STREAM_RATES,
    _int16("STAT_BOOTCNT", 1, is_read_only=True),
    _int32("STAT_FLTTIME", 0, unit="s", is_read_only=True),
    _int32("STAT_RUNTIME", 0, unit="s", is_read_only=True),
)
"""The battery failsafes are BATT_FS_*, as since Copter 3.6; FS_BATT_* no longer exists."""


def ardupilot_parameters(scenario: Scenario) -> ParameterStore:
    """ArduCopter's parameters as a scenario has them.

    The voltages of the battery failsafe are those of the simulated four-cell pack at 15 and 7 %;
    what is done about it is ArduPilot's default: a text.

    Raises:
        ConfigError: The scenario names a parameter that does not exist, or a value that may not be.
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

RULES = ProtocolRules(
    commands=CommandForms(
        int_only=frozenset({mavlink.MAV_CMD_DO_REPOSITION}), splits_custom_mode=False
    ),
    requests=ARDUPILOT_REQUESTS,
    streams=StreamRules(
        {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0}
        | dict.fromkeys((*ON_REQUEST, EKF_STATUS_REPORT), 0.0),
        STEP_S,
        groups=DATA_STREAMS,
    ),
    # ArduPilot is silent about what does not exist; clients wait for PARAM_ERROR
    parameters=replace(parameter_protocol.ARDUPILOT_RULES, tells_errors=True),
    plans=plan_rules.ARDUPILOT_RULES,
    names_timesync_target=False,
    answers_ping=False,
    timesync_period_s=10.0,
    ping_period_s=None,
    tells_mode_at_once=True,
    first_mission_item=1,
)
