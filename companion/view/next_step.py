"""The operator's next step, in one or two short sentences, at every moment of a flight."""

from __future__ import annotations

from companion.domain import EstimateState
from companion.guidance.flight.requirements import missing_inputs
from companion.guidance.handover import GRANT_HOW
from companion.guidance.phases import Phase
from companion.guidance.session import GuidanceStatus
from companion.link.endpoint import CompanionEndpoint

TAKE_BACK = "Any other mode takes control back at once."
ALWAYS = {
    Phase.LAUNCHING: "Stand clear: it takes off by itself. Any mode switch or moved stick ends it.",
    Phase.FINISHED: (
        "Hand the place over: HAND OVER on the map, or handoff.txt in the flight's folder."
    ),
    Phase.HANDBACK: "Take over: it asks the autopilot to hold or to return, and stops flying.",
    Phase.STOPPED: "You fly. The companion has ended; start it again for another search.",
}
"""Phases whose next step does not depend on anything else."""


def next_step(endpoint: CompanionEndpoint, status: GuidanceStatus) -> str:
    """Return the next step; texts for every phase come first."""
    vehicle = endpoint.session.vehicle
    if endpoint.binding.heard_s is None:
        return "Switch the autopilot on. Nothing is heard yet: check cable, port and --connect."
    if status.is_link_lost:
        return "Watch the vehicle: it follows its own failsafe. Check the link to the autopilot."
    words = ALWAYS.get(status.phase)
    if words is not None:
        return words
    guided = vehicle.guided_name
    match status.phase:
        case Phase.WAITING:
            return _while_waiting(endpoint, status)
        case Phase.STANDBY:
            if endpoint.session.context.is_launch_wanted:
                return "Stand clear: it is about to take off by itself."
            if not status.is_armed:
                return f"Arm, take off, and switch to {guided} to give control."
            return f"Switch to {guided} to give control. {TAKE_BACK}"
        case Phase.HOLD:
            return _while_holding(status)
        case Phase.YIELD:
            return _after_yielding(endpoint, guided)
    return _in_search(status)


def _while_waiting(endpoint: CompanionEndpoint, status: GuidanceStatus) -> str:
    if status.detail:  # the detail names the next step already
        return "Switch to another mode, for example Hold or Loiter. Then it can be given control."
    session = endpoint.session
    missing = missing_inputs(session.vehicle, session.fencing, status.time_s)
    if not missing:
        return "Wait a moment: the autopilot is nearly ready."
    names = " and ".join(dict.fromkeys(missing))
    return f"Wait for {names}. Satellites need open sky; this takes up to a minute."


def _in_search(status: GuidanceStatus) -> str:
    estimate = status.estimate
    if status.phase is Phase.DEGRADED:
        return "Watch it: the radio is hardly heard. It flies slowly, and holds if that lasts."
    if estimate is None:
        return f"Watch it look for the radio. {TAKE_BACK}"
    if estimate.state is EstimateState.AMBIGUOUS:
        return f"Watch it: two places fit, and it flies to find out which. {TAKE_BACK}"
    if estimate.state is EstimateState.LOCALISED:
        return "Wait for the report: it makes sure of the place. Get the ground team ready."
    return f"Watch the red circle shrink with every crossing. {TAKE_BACK}"


def _while_holding(status: GuidanceStatus) -> str:
    if "operator" in status.detail:
        return "Press RESUME on the map to fly on, or RETURN to end the search."
    if "ranging" in status.detail:
        return "Check the radio. It flies on when it is heard; or take over and move closer."
    return "Watch it: it flies on by itself when this is over. Or take over with the mode switch."


def _after_yielding(endpoint: CompanionEndpoint, guided: str) -> str:
    authority = endpoint.session.authority
    if authority.grant_reason is not None:
        return f"You fly. To search again: {GRANT_HOW}, then switch the mode."
    return f"You fly. To search again: stay in another mode until ready, then switch to {guided}."
