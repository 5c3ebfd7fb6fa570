"""What ArduCopter 4.5 is, how it is set up and how it speaks; `streams.csv` has what it sends.

`parameters.csv` has its parameters. Names, types and defaults were compared one by one with what an
ArduCopter 4.5.5 shows, and with SITL's `copter.parm` (battery monitor, flight modes, fence radius,
throttle failsafe); ranges are those of the Copter Parameter List by sense, and bind scenarios only:
a client may set what is out of range. The battery failsafes are BATT_FS_*, as since Copter 3.6.
"""

from __future__ import annotations

import math

from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import mavlink
from companion.mav.param_encoding import ParamEncoding
from sim_link.autopilot.flavours.base import ACCEPTED, DENIED, FAILED, Firmware
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.command_protocol import CommandForms
from sim_link.autopilot.protocols.message_streams import (
    RequestRules,
    StreamRules,
    message_id,
    message_ids,
)
from sim_link.autopilot.protocols.parameter_protocol import ParameterRules
from sim_link.autopilot.protocols.parameter_store import ParameterStore, read_rows, read_specs
from sim_link.autopilot.protocols.plan_items import PlanType
from sim_link.autopilot.protocols.plan_rules import PlanChecks, PlanRules, commands_named
from sim_link.autopilot.scenario import Scenario

PACKAGE = "sim_link.autopilot.flavours.ardupilot"
ARDUPILOT_PARAMETERS = read_specs(PACKAGE)


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


STREAM_ROWS = read_rows(PACKAGE, "streams.csv")
DATA_STREAMS: dict[int, tuple[int, ...]] = {
    getattr(mavlink, f"MAV_DATA_STREAM_{group}"): tuple(
        message_id(row["message"]) for row in STREAM_ROWS if row["group"] == group
    )
    for group in dict.fromkeys(row["group"] for row in STREAM_ROWS if row["group"])
}
"""Messages of each MAV_DATA_STREAM group, ArduPilot `GCS_Mavlink.cpp`."""

NOT_ITS_OWN = message_ids(
    "MISSION_CHECKSUM RADIO_RC_CHANNELS AVAILABLE_MODES CURRENT_MODE AVAILABLE_MODES_MONITOR "
    "GNSS_INTEGRITY RANGING_BEACON COMMAND_CANCEL RADIO_RANGING TARGET_ESTIMATE"
)
"""Known here, but neither to common.xml nor to ardupilotmega.xml of that version."""
VENDORS = (range(150, 227), range(10001, 10152), range(11000, 11061))
"""Ids of ardupilotmega.xml, and of what it includes."""
DIALECT = frozenset(CRC_EXTRA_BY_ID).difference(NOT_ITS_OWN).union(*VENDORS)

FIRMWARE = Firmware(
    autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    version=0x0405_07FF,  # 4.5.7, official release: the one whose behaviour is simulated
    capabilities=0xFBEF,  # neither encoding bit, though the guide wants one of them
    refusal=FAILED,
    frame_refusal=DENIED,
    busy=FAILED,
    calibrates_at_once=True,
    termination=(mavlink.MAV_SEVERITY_EMERGENCY, "Flight termination"),
    keeps_given_home=False,
    commands=CommandForms(
        int_only=frozenset({mavlink.MAV_CMD_DO_REPOSITION}),
        splits_custom_mode=False,
        acknowledges_set_mode_as=mavlink.MAVLINK_MSG_ID_SET_MODE,
    ),
    requests=RequestRules(
        no_message=FAILED,
        no_stream=DENIED,
        no_interval=FAILED,
        has_texts=True,
        casts_id=True,
        not_on_request=frozenset({mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL}),
        tells_protocol_version=False,
        capabilities_need_one=True,
    ),
    streams=StreamRules(
        {message_id(row["message"]): float(row["hz"]) for row in STREAM_ROWS},
        STEP_S,
        fixed=frozenset(),
        groups=DATA_STREAMS,
    ),
    # Measured: 1364 values in 0.87 s.
    parameters=ParameterRules(
        ParamEncoding.C_CAST,
        checks_type=False,
        tells_index_of_named=False,
        stores_nan=False,
        has_hash_check=False,
        tells_read_only=True,
        list_rate_hz=1500.0,
    ),
    plans=PlanRules(
        capacity={PlanType.MISSION: 650, PlanType.FENCE: 84, PlanType.RALLY: 50},
        checks=PlanChecks(
            zero_is_here=True,
            nan_fourth=commands_named("NAV_WAYPOINT NAV_LAND NAV_TAKEOFF"),
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
    empty_calibration=ACCEPTED,
    names_timesync_target=False,
    answers_ping=False,
    tells_mode_at_once=True,
    obeys_rc_override=True,
    takes_origin=False,
    first_mission_item=1,
    home_orientation=(math.nan, math.nan, math.nan, math.nan),
    dialect=DIALECT,
    answers_for_others=True,
)
