"""PX4's parameters that clients ask for and the simulator heeds or shows.

Names and types are PX4 1.15's, where only INT32 and REAL32 exist; defaults and ranges are set after
the sense of its Parameter Reference, without a line by line comparison: ask the real one where it
matters.
"""

from __future__ import annotations

from companion.mav.parameters import ParamType
from sim_link.autopilot.protocols.parameter_store import ParamSpec


def _whole(
    name: str, default: int, minimum: int | None = None, maximum: int | None = None, unit: str = ""
) -> ParamSpec:
    return ParamSpec(name, ParamType.INT32, default, minimum, maximum, unit)


def _real(
    name: str,
    default: float,
    minimum: float | None = None,
    maximum: float | None = None,
    unit: str = "",
) -> ParamSpec:
    return ParamSpec(name, ParamType.REAL32, default, minimum, maximum, unit)


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
    _whole("COM_FLTMODE1", -1, -1, 15),
    _whole("COM_FLTMODE2", -1, -1, 15),
    _whole("COM_FLTMODE3", -1, -1, 15),
    _whole("COM_FLTMODE4", -1, -1, 15),
    _whole("COM_FLTMODE5", -1, -1, 15),
    _whole("COM_FLTMODE6", -1, -1, 15),
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
    _real("MPC_XY_CRUISE", 5.0, 3.0, 20.0, "m/s"),
    _real("MPC_XY_VEL_MAX", 12.0, 0.0, 20.0, "m/s"),
    _real("MPC_YAWRAUTO_MAX", 45.0, 5.0, 360.0, "deg/s"),
    _real("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4.0, "m/s"),
    _real("MPC_Z_VEL_MAX_UP", 3.0, 0.5, 8.0, "m/s"),
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
