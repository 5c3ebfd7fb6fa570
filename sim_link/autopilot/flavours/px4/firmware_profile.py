"""How PX4 1.15 is set up and speaks: its parameters, streams and protocol rules.

Names, types, defaults and ranges of COM_*, NAV_*_ACT, GF_* and MPC_* were compared with the sources
of its modules; the rest is set after the sense of its Parameter Reference: ask the real one where
it matters. PX4 has only INT32 and REAL32.

Every link has the streams of PX4's onboard link (MAV_x_MODE 2); its ground station link (mode 0) is
slower in some (GPS 5, VFR_HUD 4 Hz) and faster in others. One port serves stations and companions
here, so that there is no telling which of the two a link is.
"""

from __future__ import annotations

from companion.mav.dialect import mavlink
from companion.mav.param_encoding import ParamType
from sim_link.autopilot.flavours.base import ProtocolRules
from sim_link.autopilot.pilot import STEP_S, SpeedLimits
from sim_link.autopilot.protocols import parameter_protocol, plan_rules
from sim_link.autopilot.protocols.command_protocol import CommandForms
from sim_link.autopilot.protocols.message_streams import PX4_REQUESTS, StreamRules, message_ids
from sim_link.autopilot.protocols.parameter_store import ParameterStore, ParamSpec, spec_of
from sim_link.autopilot.scenario import LossAction, Scenario

_whole, _real = spec_of(ParamType.INT32), spec_of(ParamType.REAL32)

PX4_PARAMETERS: tuple[ParamSpec, ...] = (
    _real("BAT1_CAPACITY", -1.0, -1.0, 100_000.0, "mAh"),
    _whole("BAT1_N_CELLS", 4, 0, 16),
    _whole("BAT1_SOURCE", 0, -1, 2),
    _real("BAT1_V_CHARGED", 4.05, 0.0, 5.0, "V"),
    _real("BAT1_V_EMPTY", 3.6, 0.0, 5.0, "V"),
    _real("BAT_CRIT_THR", 0.07, 0.05, 0.5),
    _real("BAT_EMERGEN_THR", 0.05, 0.03, 0.5),
    _real("BAT_LOW_THR", 0.15, 0.12, 0.5),
    _whole("CAL_ACC0_ID", 1_310_988),
    _whole("CAL_GYRO0_ID", 1_310_988),
    _whole("CAL_MAG0_ID", 197_388),
    _whole("CBRK_IO_SAFETY", 22_027, 0, 22_027),
    _whole("CBRK_SUPPLY_CHK", 894_281, 0, 894_281),
    _whole("CBRK_USB_CHK", 197_848, 0, 197_848),
    _whole("COM_ARM_WO_GPS", 1, 0, 2),
    _real("COM_DISARM_LAND", 2.0, -1.0, 20.0, "s"),
    _real("COM_DISARM_PRFLT", 10.0, -1.0, 60.0, "s"),
    _whole("COM_DL_LOSS_T", 10, 5, 300, "s"),
    _real("COM_FAIL_ACT_T", 5.0, 0.0, 25.0, "s"),
    *(_whole(f"COM_FLTMODE{n}", -1, -1, 15) for n in range(1, 7)),
    _whole("COM_LOW_BAT_ACT", 0, 0, 3),
    _whole("COM_OBL_RC_ACT", 0, 0, 7),
    _real("COM_OF_LOSS_T", 1.0, 0.0, 60.0, "s"),
    _whole("COM_POSCTL_NAVL", 0, 0, 1),
    _real("COM_POS_FS_EPH", 5.0, -1.0, 400.0, "m"),
    _whole("COM_PREARM_MODE", 0, 0, 2),
    _whole("COM_RCL_EXCEPT", 0, 0, 31),
    _whole("COM_RC_IN_MODE", 3, 0, 4),
    _real("COM_RC_LOSS_T", 0.5, 0.0, 35.0, "s"),
    _whole("COM_RC_OVERRIDE", 1, 0, 3),
    _real("COM_RC_STICK_OV", 30.0, 5.0, 80.0, "%"),
    _whole("COM_TAKEOFF_ACT", 0, 0, 1),
    _whole("EKF2_GPS_CTRL", 7, 0, 15),
    _whole("EKF2_HGT_REF", 1, 0, 3),
    _whole("GF_ACTION", 2, 0, 5),
    _real("GF_MAX_HOR_DIST", 0.0, 0.0, 10_000.0, "m"),
    _real("GF_MAX_VER_DIST", 0.0, 0.0, 10_000.0, "m"),
    _whole("GF_PREDICT", 0, 0, 1),
    _whole("GF_SOURCE", 0, 0, 1),
    _whole("MAV_COMP_ID", 1, 1, 250),
    _whole("MAV_PROTO_VER", 0, 0, 2),
    _whole("MAV_SYS_ID", 1, 1, 250),
    _whole("MAV_TYPE", 2, 0, 22),
    _real("MIS_DIST_1WP", 10_000.0, -1.0, 100_000.0, "m"),
    _real("MIS_TAKEOFF_ALT", 2.5, 0.0, 80.0, "m"),
    _whole("MIS_TAKEOFF_REQ", 0, 0, 4),
    _real("MIS_YAW_ERR", 12.0, 0.0, 90.0, "deg"),
    _real("MPC_ACC_DOWN_MAX", 3.0, 2.0, 15.0, "m/s^2"),
    _real("MPC_ACC_HOR", 3.0, 2.0, 15.0, "m/s^2"),
    _real("MPC_ACC_HOR_MAX", 5.0, 2.0, 15.0, "m/s^2"),
    _real("MPC_ACC_UP_MAX", 4.0, 2.0, 15.0, "m/s^2"),
    _real("MPC_JERK_AUTO", 4.0, 1.0, 80.0, "m/s^3"),
    _real("MPC_JERK_MAX", 8.0, 0.5, 500.0, "m/s^3"),
    _real("MPC_LAND_SPEED", 0.7, 0.6, 8.0, "m/s"),
    _real("MPC_THR_HOVER", 0.5, 0.1, 0.8),
    _real("MPC_TILTMAX_AIR", 45.0, 20.0, 89.0, "deg"),
    _real("MPC_TKO_SPEED", 1.5, 1.0, 5.0, "m/s"),
    _real("MPC_VEL_MANUAL", 10.0, 3.0, 20.0, "m/s"),
    _real("MPC_XY_CRUISE", 5.0, 3.0, 20.0, "m/s"),
    _real("MPC_XY_VEL_MAX", 12.0, 0.0, 20.0, "m/s"),
    _real("MPC_YAWRAUTO_MAX", 45.0, 5.0, 360.0, "deg/s"),
    _real("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4.0, "m/s"),
    _real("MPC_Z_VEL_MAX_UP", 3.0, 0.5, 8.0, "m/s"),
    _real("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4.0, "m/s"),
    _real("MPC_Z_V_AUTO_UP", 3.0, 0.5, 8.0, "m/s"),
    _real("NAV_ACC_RAD", 10.0, 0.05, 200.0, "m"),
    _whole("NAV_DLL_ACT", 0, 0, 6),
    _real("NAV_LOITER_RAD", 80.0, -10_000.0, 10_000.0, "m"),
    _real("NAV_MC_ALT_RAD", 0.8, 0.05, 200.0, "m"),
    _whole("NAV_RCL_ACT", 2, 0, 6),
    _whole("RC_MAP_FLTMODE", 0, 0, 18),
    _real("RTL_DESCEND_ALT", 30.0, 0.0, 10_000.0, "m"),
    _real("RTL_LAND_DELAY", 0.0, -1.0, 3600.0, "s"),
    _real("RTL_RETURN_ALT", 60.0, 0.0, 10_000.0, "m"),
    _whole("RTL_TYPE", 0, 0, 4),
    _whole("SENS_BOARD_ROT", 0, -1, 40),
    _real("SIM_BAT_DRAIN", 60.0, 1.0, 86_400.0, "s"),
    _real("SIM_BAT_MIN_PCT", 50.0, 0.0, 100.0, "%"),
    _whole("SYS_AUTOCONFIG", 0, 0, 1),
    _whole("SYS_AUTOSTART", 10_040, 0, 9_999_999),
    _whole("SYS_HAS_GPS", 1, 0, 1),
    _whole("SYS_HAS_MAG", 1, 0, 4),
)
"""In the order of their names, as PX4 numbers them. 10040 is its simulated quadrotor."""


LOSS_ACTION_NUMBER: dict[LossAction, int] = {
    "position": 0,
    "return": 3,
    "land": 4,
    "hold": 5,
    "disarm": 7,
}
"""COM_OBL_RC_ACT."""


def speed_limits(parameters: ParameterStore) -> SpeedLimits:
    """How fast it goes to a place; the vehicle's own limits are no higher by default."""
    return SpeedLimits(
        parameters["MPC_XY_VEL_MAX"],
        parameters["MPC_Z_VEL_MAX_UP"],
        parameters["MPC_Z_VEL_MAX_DN"],
    )


def px4_parameters(scenario: Scenario) -> ParameterStore:
    """PX4's parameters as a scenario has them.

    Without a scenario's say the battery failsafe returns and lands (COM_LOW_BAT_ACT).

    Raises:
        ConfigError: The scenario names a parameter that does not exist, or a value that may not be.
    """
    autopilot = scenario.autopilot
    initial: dict[str, float] = {
        "COM_DISARM_LAND": autopilot.disarm_after_landing_s,
        "COM_LOW_BAT_ACT": 3,
        "COM_OBL_RC_ACT": LOSS_ACTION_NUMBER[autopilot.offboard_loss_action],
        "COM_OF_LOSS_T": autopilot.offboard_loss_timeout_s,
        "MAV_SYS_ID": scenario.system_id,
        "MIS_TAKEOFF_ALT": autopilot.takeoff_altitude_m,
        "NAV_ACC_RAD": 2.0,
        "RTL_RETURN_ALT": autopilot.return_altitude_m,
    }
    return ParameterStore(PX4_PARAMETERS, initial | autopilot.parameters)


_BY_RATE_HZ = {
    1.0: "HEARTBEAT ESTIMATOR_STATUS MISSION_CURRENT SYSTEM_TIME",
    50.0: "ATTITUDE ATTITUDE_QUATERNION GLOBAL_POSITION_INT HIGHRES_IMU",
    30.0: "LOCAL_POSITION_NED ODOMETRY",
    10.0: "ALTITUDE ATTITUDE_TARGET DISTANCE_SENSOR POSITION_TARGET_LOCAL_NED SERVO_OUTPUT_RAW "
    "VFR_HUD",
    8.0: "GPS_RAW_INT",
    5.0: "EXTENDED_SYS_STATE RC_CHANNELS SYS_STATUS",
    0.5: "BATTERY_STATUS HOME_POSITION",
    0.0: "AUTOPILOT_VERSION GPS_GLOBAL_ORIGIN NAV_CONTROLLER_OUTPUT POSITION_TARGET_GLOBAL_INT",
}
DEFAULT_RATE_HZ = {
    number: rate_hz for rate_hz, names in _BY_RATE_HZ.items() for number in message_ids(names)
}
"""As measured on the onboard link, ATTITUDE's 99 Hz limited to a message per physics step; 0: only
on request. RC_CHANNELS come while there is a remote control."""

RULES = ProtocolRules(
    commands=CommandForms(),
    requests=PX4_REQUESTS,
    streams=StreamRules(DEFAULT_RATE_HZ, STEP_S),
    parameters=parameter_protocol.PX4_RULES,
    plans=plan_rules.PX4_RULES,
    names_timesync_target=True,
    answers_ping=True,
    timesync_period_s=0.1,
    ping_period_s=1.0,
    tells_mode_at_once=False,
    first_mission_item=0,
)

HEARTBEAT_ONLY = dict.fromkeys(DEFAULT_RATE_HZ, 0.0) | {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0}
CUSTOM_RULES = RULES._replace(streams=StreamRules(HEARTBEAT_ONLY, STEP_S))
"""On links in mode Custom (PX4 MAV_1_MODE 1): whoever wants a stream asks for it."""
