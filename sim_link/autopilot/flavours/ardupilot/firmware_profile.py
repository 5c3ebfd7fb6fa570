"""Identity, parameters and message rates of ArduCopter 4.5.

`firmware.yaml` has its rules (fields of `Firmware`), `streams.csv` what it sends.

`parameters.csv` has its parameters. Names, types and defaults were compared one by one with what an
ArduCopter 4.5.5 shows, and with SITL's `copter.parm` (battery monitor, flight modes, fence radius,
throttle failsafe); ranges are those of the Copter Parameter List by sense, and bind scenarios only:
a client may set what is out of range. The battery failsafes are BATT_FS_*, as since Copter 3.6.
"""

from __future__ import annotations

from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.dialect import mavlink
from sim_link.autopilot.flavours.base import read_firmware
from sim_link.autopilot.pilot import STEP_S
from sim_link.autopilot.protocols.message_streams import StreamProfile, message_id, message_ids
from sim_link.autopilot.protocols.parameter_store import ParameterStore, read_rows, read_specs
from sim_link.autopilot.scenario import Scenario

PACKAGE = "sim_link.autopilot.flavours.ardupilot"
ARDUPILOT_PARAMETERS = read_specs(PACKAGE)


def ardupilot_parameters(scenario: Scenario) -> ParameterStore:
    """Return ArduCopter's parameters as a scenario has them.

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

STREAMS = StreamProfile(
    {message_id(row["message"]): float(row["hz"]) for row in STREAM_ROWS},
    STEP_S,
    fixed=frozenset(),
    groups=DATA_STREAMS,
)
FIRMWARE = read_firmware(PACKAGE, STREAMS, DIALECT)
