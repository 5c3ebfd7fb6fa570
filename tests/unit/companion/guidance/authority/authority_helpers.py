"""Vehicles in control, and what they were sent, for the tests of authority."""

from __future__ import annotations

import math

from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import Arm, SendSetpoint, SetMode, TakeOff
from companion.guidance.control_authority import Finding, Reason, Verdict
from companion.guidance.events import HeartbeatReceived
from tests.unit.companion.guidance.scripted import ScriptedFlight

AUTOPILOTS = [Autopilot.PX4, Autopilot.ARDUPILOT]
CRITICAL = Finding(Verdict.HAND_BACK, Reason.CHECKING, "a test wants it", FlightMode.RETURN)
FOREIGN = Finding(Verdict.YIELD, Reason.CHECKING, "a test wants it")


def flying(autopilot: Autopilot = Autopilot.PX4) -> ScriptedFlight:
    """Return a flight in the air and in control."""
    flight = ScriptedFlight(autopilot=autopilot)
    flight.report_landed(LandedState.IN_AIR)
    return flight.in_control()


def acts(flight: ScriptedFlight, since_s: float = -math.inf) -> int:
    """Setpoints and requests after a time."""
    return sum(len(flight.sent(kind, since_s)) for kind in (SendSetpoint, SetMode, Arm, TakeOff))


def numbered(flight: ScriptedFlight, mode: FlightMode, order: int) -> None:
    """Give an armed heartbeat with its number in the sender's order."""
    flight.give(
        HeartbeatReceived(
            flight.now_s, flight.autopilot, mode, True, True, is_failsafe=False, order=order
        )
    )
