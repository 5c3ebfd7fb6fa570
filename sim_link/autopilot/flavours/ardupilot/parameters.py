"""Where a scenario sets ArduCopter's parameters."""

from __future__ import annotations

from sim_link.autopilot.protocols.ardupilot_parameters import ARDUPILOT_PARAMETERS
from sim_link.autopilot.protocols.parameter_store import ParameterStore
from sim_link.autopilot.scenario import Scenario


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
