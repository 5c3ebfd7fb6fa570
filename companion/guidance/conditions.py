"""What the session decides by: is a search due, is silence due, and how to hand back."""

from __future__ import annotations

from companion.domain import FlightMode, TargetEstimate
from companion.guidance.authority import Authority
from companion.guidance.launch import Launch
from companion.guidance.states import IN_CONTROL, STREAMING, Phase
from companion.guidance.vehicle import VehicleView

FOLLOW_UP_S = 5.0
"""How long the autopilot may take to enter the mode that follows the report."""


def is_search_due(
    estimate: TargetEstimate | None,
    ranging_heard_s: float | None,
    search_after_s: float | None,
    now_s: float,
) -> bool:
    """Whether the planner searches now, and needs neither contact nor an estimate.

    Args:
        estimate: Of the target.
        ranging_heard_s: When the last usable measurement came.
        search_after_s: See `Planner`.
        now_s: The present.
    """
    if search_after_s is None:
        return False
    if estimate is None or ranging_heard_s is None or search_after_s == 0.0:
        return True
    return now_s - ranging_heard_s > search_after_s


def is_silence_due(
    authority: Authority, vehicle: VehicleView, launch: Launch | None, now_s: float
) -> bool:
    """Whether no setpoint may leave at this tick."""
    phase = authority.phase
    if phase not in STREAMING or not vehicle.is_mode_known(now_s):
        return True
    if phase is Phase.FINISHED:
        return authority.has_let_go or now_s - authority.since_s > FOLLOW_UP_S
    if phase is Phase.STANDBY:
        return not (vehicle.wants_prestream and vehicle.is_position_fresh(now_s))
    if phase is Phase.LAUNCHING:
        return launch is None or not launch.wants_stream
    return False


def hand_back_mode(
    authority: Authority, vehicle: VehicleView, launch: Launch | None, follow_up: FlightMode
) -> FlightMode | None:
    """What to ask the autopilot for before the end, or None if it is not in our hands."""
    match authority.phase:
        case Phase.FINISHED:
            return follow_up if vehicle.is_ours and not authority.has_let_go else None
        case Phase.LAUNCHING:
            may_fly = vehicle.is_armed or (launch is not None and launch.may_be_flying)
            return FlightMode.HOLD if may_fly else None
    return FlightMode.HOLD if authority.phase in IN_CONTROL else None
