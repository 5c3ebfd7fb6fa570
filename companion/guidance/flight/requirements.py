"""What control needs, one row each: readiness and what is waited for come from this table.

docs/flying.md has the same rows; a test compares them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.domain import Autopilot, LandedState
from companion.guidance.flight.fencing import Fencing
from companion.guidance.flight.vehicle import VehicleView


@dataclass(frozen=True, slots=True)
class Requirement:
    """One input without which nothing is flown."""

    text: str
    """What is waited for, in the operator's words."""
    message: str
    """The MAVLink message that provides it."""
    is_met: Callable[[VehicleView, Fencing, float], bool]


def _has_landed_state(vehicle: VehicleView) -> bool:
    """ArduPilot ignores setpoints on the ground, so whether it flies must be known there."""
    is_needed = vehicle.autopilot is Autopilot.ARDUPILOT
    return not is_needed or vehicle.landed is not LandedState.UNKNOWN


REQUIREMENTS = (
    Requirement(
        "the autopilot",
        "HEARTBEAT",
        lambda vehicle, _, now_s: vehicle.heartbeat is not None and not vehicle.is_link_lost(now_s),
    ),
    Requirement(
        "a local position",
        "LOCAL_POSITION_NED",
        lambda vehicle, _, now_s: vehicle.is_position_fresh(now_s),
    ),
    Requirement(
        "a home position",
        "HOME_POSITION",
        lambda vehicle, _, __: vehicle.home_enu_m is not None,
    ),
    Requirement(
        "the origin",
        "GPS_GLOBAL_ORIGIN",
        lambda vehicle, fencing, _: vehicle.has_origin and "the origin" not in fencing.missing,
    ),
    Requirement(
        "the landed state",
        "EXTENDED_SYS_STATE",
        lambda vehicle, _, __: _has_landed_state(vehicle),
    ),
    Requirement(
        "the autopilot's fence",
        "MISSION_ITEM_INT",
        lambda _, fencing, __: "the autopilot's fence" not in fencing.missing,
    ),
)


def missing_inputs(vehicle: VehicleView, fencing: Fencing, now_s: float) -> list[str]:
    """Return the missing inputs in words; a position that a slow link brings late is named so."""
    texts = [row.text for row in REQUIREMENTS if not row.is_met(vehicle, fencing, now_s)]
    return [
        vehicle.position_wanted(now_s) if text == "a local position" else text for text in texts
    ]
