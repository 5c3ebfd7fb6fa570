"""Where a scenario sets PX4's parameters."""

from __future__ import annotations

from sim_link.autopilot.pilot import SpeedLimits
from sim_link.autopilot.protocols.parameter_store import ParameterStore
from sim_link.autopilot.protocols.px4_parameters import PX4_PARAMETERS
from sim_link.autopilot.scenario import LossAction, Scenario

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
