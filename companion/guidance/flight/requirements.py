"""Inputs that control needs, one row each: readiness, its texts and the doctor's verdict use it.

docs/flying.md has the same rows; a test compares them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.domain import Autopilot, LandedState
from companion.guidance.flight.fencing import Fencing
from companion.guidance.flight.vehicle import (
    LANDED_PATIENCE_S,
    LINK_LOST_S,
    MODE_UNKNOWN_AFTER_S,
    STALE_STATE_S,
    VehicleView,
)

FENCE_MESSAGE = "MISSION_ITEM_INT"


@dataclass(frozen=True, slots=True)
class Requirement:
    """One input without which control cannot begin."""

    text: str
    """Name of the input in the operator's texts."""
    message: str
    """MAVLink message that provides it."""
    is_met: Callable[[VehicleView, Fencing, float], bool]
    patience_s: float = math.inf
    """Seconds after its last message until it is missing; inf: once known, it stays known."""
    only_for: Autopilot | None = None
    """The only kind of autopilot that has to provide it; None: all kinds."""

    def is_needed(self, autopilot: Autopilot) -> bool:
        """Return True if this kind of autopilot has to provide it."""
        return self.only_for in (None, autopilot)


REQUIREMENTS = (
    Requirement(
        "the autopilot",
        "HEARTBEAT",
        lambda vehicle, _, now_s: vehicle.heartbeat is not None and not vehicle.is_link_lost(now_s),
        LINK_LOST_S,
    ),
    Requirement(
        "the flight mode",
        "HEARTBEAT",
        lambda vehicle, _, now_s: vehicle.heartbeat is None or vehicle.mode_watch.is_known(now_s),
        MODE_UNKNOWN_AFTER_S,
    ),
    Requirement(
        "a local position",
        "LOCAL_POSITION_NED",
        lambda vehicle, _, now_s: vehicle.is_position_fresh(now_s),
        STALE_STATE_S,
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
        lambda vehicle, _, now_s: (
            vehicle.landed is not LandedState.UNKNOWN and vehicle.is_landed_fresh(now_s)
        ),
        LANDED_PATIENCE_S,
        only_for=Autopilot.ARDUPILOT,  # it ignores setpoints on the ground
    ),
    Requirement(
        "the autopilot's fence",
        FENCE_MESSAGE,
        lambda _, fencing, __: "the autopilot's fence" not in fencing.missing,
    ),
)


def missing_inputs(vehicle: VehicleView, fencing: Fencing, now_s: float) -> list[str]:
    """Return the missing inputs in words; a position delayed by a slow link is named as such."""
    texts = [
        row.text
        for row in REQUIREMENTS
        if row.is_needed(vehicle.autopilot) and not row.is_met(vehicle, fencing, now_s)
    ]
    return [
        vehicle.missing_position_text(now_s) if text == "a local position" else text
        for text in texts
    ]
