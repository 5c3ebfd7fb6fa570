"""Identity, parameters, message rates and modes of PX4 1.15; `firmware.yaml` has its rules.

`parameters.csv` has its parameters. Names, types, defaults and ranges of COM_*, NAV_*_ACT, GF_* and
MPC_* were compared with the sources of its modules; the rest follows its Parameter Reference: check
a real PX4 where it matters. PX4 has only INT32 and REAL32, and numbers parameters in the order of
their names; SYS_AUTOSTART 10040 is its simulated quadrotor.

A link has the streams of PX4's onboard link (MAV_x_MODE 2), of its ground station link (mode 0), of
its narrow one, or (mode Custom) nothing but HEARTBEAT.

Source of the modes: PX4 1.15 as observed in SITL; MAVLink common, MAV_MODE_FLAG.
"""

from __future__ import annotations

from companion.domain import FlightMode
from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import mavlink
from companion.mav.flight_modes import PX4_MAIN_AND_SUB
from sim_link.autopilot.flavour import read_firmware
from sim_link.autopilot.flight_controller import STEP_S, SpeedLimits, Task
from sim_link.autopilot.protocols.addressing import flags_of
from sim_link.autopilot.protocols.message_streams import StreamProfile, message_id, message_ids
from sim_link.autopilot.protocols.parameter_protocol import ParameterStore, read_rows, read_specs
from sim_link.autopilot.scenario import LossAction, Scenario

PACKAGE = "sim_link.autopilot.px4"
PX4_PARAMETERS = read_specs(PACKAGE)
OFFBOARD_LOSS_ACTION: dict[LossAction, int] = {
    **{"position": 0, "return": 3, "land": 4},
    **{"hold": 5, "disarm": 7},
}
"""Reactions to lost setpoints by COM_OBL_RC_ACT."""


def speed_limits(parameters: ParameterStore) -> SpeedLimits:
    """Return the speed limits on the way to a position."""
    names = ("MPC_XY_VEL_MAX", "MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN")
    return SpeedLimits(*(parameters[name] for name in names))


def px4_parameters(scenario: Scenario) -> ParameterStore:
    """Return PX4's parameters as a scenario has them.

    By default a low battery returns and lands.
    """
    autopilot = scenario.autopilot
    initial: dict[str, float] = {
        "COM_DISARM_LAND": autopilot.disarm_after_landing_s,
        "COM_LOW_BAT_ACT": 3,
        "COM_OBL_RC_ACT": OFFBOARD_LOSS_ACTION[autopilot.offboard_loss_action],
        "COM_OF_LOSS_T": autopilot.offboard_loss_timeout_s,
        "MAV_SYS_ID": scenario.system_id,
        "MIS_TAKEOFF_ALT": autopilot.takeoff_altitude_m,
        "NAV_ACC_RAD": 2.0,
        "RTL_RETURN_ALT": autopilot.return_altitude_m,
    }
    return ParameterStore(PX4_PARAMETERS, initial | autopilot.parameters)


def _rates_hz(link: str) -> dict[int, float]:
    """Return the rates of a kind of link by message id; 0 for messages on request only."""
    rows = read_rows(PACKAGE, "streams.csv")
    return {message_id(row["message"]): float(row[f"{link}_hz"]) for row in rows}


ONBOARD_HZ = _rates_hz("onboard")
"""Rates measured on 14540, ATTITUDE's 98 Hz limited to a message per physics step. RC_CHANNELS come
while there is a remote control."""
STATION_HZ = _rates_hz("station")
"""Rates measured on 14550: ATTITUDE, LOCAL_POSITION_NED, GPS_RAW_INT, VFR_HUD, HEARTBEAT, PING; the
others make up the 154 messages a second in all."""
HEARTBEAT_ONLY_HZ = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0}
NARROW_SHARE = 0.14
"""Share of the rates on 14030 (4000 bytes/s): LOCAL_POSITION_NED at 4.2 of 30 Hz, 5 at most."""
STREAMS = StreamProfile(
    ONBOARD_HZ,
    STEP_S,
    rates_by_mode_hz={
        "station": STATION_HZ,
        "narrow": {number: NARROW_SHARE * hz for number, hz in ONBOARD_HZ.items()}
        | HEARTBEAT_ONLY_HZ,
        "asked": HEARTBEAT_ONLY_HZ,
    },
    min_interval_by_mode_s={"narrow": 0.2},
    stopped_interval_us=0,
)

NOT_PASSED_ON = message_ids("RADIO_RANGING TARGET_ESTIMATE EKF_STATUS_REPORT TUNNEL")
"""Known here, but not to PX4, which cannot check their frames; and TUNNEL, none of which came
through a PX4 1.16.2."""
DIALECT = frozenset(CRC_EXTRA_BY_ID).difference(NOT_PASSED_ON)

FIRMWARE = read_firmware(PACKAGE, STREAMS, DIALECT)


MAIN_MODES = frozenset(main for main, _ in PX4_MAIN_AND_SUB.values())
WITHOUT_POSITION_CONTROL = frozenset({FlightMode.STABILIZED, FlightMode.ACRO, FlightMode.MANUAL})
STICK_MODES = WITHOUT_POSITION_CONTROL | {FlightMode.POSITION, FlightMode.ALTITUDE}
TASKS: dict[FlightMode, Task] = {
    FlightMode.HOLD: Task.STAY,
    FlightMode.TAKEOFF: Task.TAKE_OFF,
    FlightMode.LAND: Task.LAND,
    FlightMode.RETURN: Task.RETURN,
    FlightMode.MISSION: Task.FLY_MISSION,
    FlightMode.OFFBOARD: Task.FOLLOW,
}
"""Tasks of all modes but those for sticks."""
ENDED_BY_DISARMING = frozenset(TASKS) - {FlightMode.OFFBOARD}
AUTO_FLAGS = flags_of("MAV_MODE_FLAG", "STABILIZE_ENABLED GUIDED_ENABLED AUTO_ENABLED")
MANUAL_FLAGS = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
STICK_FLAGS = MANUAL_FLAGS | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
BASE_MODE_FLAGS: dict[FlightMode, int] = {
    **dict.fromkeys((FlightMode.POSITION, FlightMode.ALTITUDE, FlightMode.STABILIZED), STICK_FLAGS),
    **dict.fromkeys((FlightMode.MANUAL, FlightMode.ACRO), MANUAL_FLAGS),
}
"""Flags of a mode besides CUSTOM_MODE_ENABLED; modes not listed are automatic (OFFBOARD apart)."""
