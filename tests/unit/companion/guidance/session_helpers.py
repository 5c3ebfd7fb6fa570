"""Helpers of the session's tests."""

from __future__ import annotations

from companion.domain import FlightMode
from companion.guidance.commands import Arm, SendSetpoint, SetMode, TakeOff
from tests.unit.companion.guidance.scripted import ScriptedFlight

FOREIGN_MODES = [mode for mode in FlightMode if mode is not FlightMode.OFFBOARD]


def silent_since(flight: ScriptedFlight, since_s: float) -> bool:
    """Return True if nothing that moves the vehicle was sent or requested."""
    kinds = (SendSetpoint, SetMode, Arm, TakeOff)
    return not any(flight.sent(kind, since_s) for kind in kinds)
