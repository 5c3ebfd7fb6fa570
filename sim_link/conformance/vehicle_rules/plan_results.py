"""What a plan is refused for, and with which result."""

from __future__ import annotations

import math

from sim_link.conformance import plan_client as plans
from sim_link.conformance.plan_client import MISSION, PlanItem, waypoint
from sim_link.conformance.results import (
    PLAN_INVALID,
    PLAN_INVALID_X,
    PLAN_INVALID_Z,
    PLAN_NO_SPACE,
    PLAN_UNSUPPORTED,
    PLAN_UNSUPPORTED_FRAME,
)
from sim_link.conformance.rules import (
    Effect,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.sources import OBSERVED_ARDUPILOT
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_station import NAN

book = RuleBook(Role.VEHICLE, "plan_results")
SERVICE = "MAVLink guide, Mission Protocol"
CHANGES = Effect.CHANGES


def refusal(probe: VehicleProbe, item: PlanItem) -> int:
    """The ACK of a mission with one wrong item."""
    return plans.upload(probe, plans.with_home(probe, [item]))


@book.rule(f"{SERVICE}, MAV_MISSION_RESULT", effect=CHANGES)
def unknown_frame_is_refused(probe: VehicleProbe) -> None:
    """A waypoint in a frame that is not known is refused as UNSUPPORTED_FRAME."""
    probe.get_ready()
    home = probe.home()
    item = plans.changed(waypoint(home.latitude, home.longitude, 10.0), frame=20)
    result = refusal(probe, item)
    require(result == PLAN_UNSUPPORTED_FRAME, f"ACK {result}")


@book.rule(f"{SERVICE}, MAV_MISSION_RESULT", effect=CHANGES)
def unknown_mission_command_is_refused(probe: VehicleProbe) -> None:
    """An item with a command that is not known is refused as UNSUPPORTED."""
    probe.get_ready()
    home = probe.home()
    item = plans.changed(waypoint(home.latitude, home.longitude, 10.0), command=31_999)
    result = refusal(probe, item)
    require(result == PLAN_UNSUPPORTED, f"ACK {result}")


@book.rule(f"{SERVICE}, MAV_MISSION_RESULT; {OBSERVED_ARDUPILOT}", effect=CHANGES)
def impossible_latitude_is_refused(probe: VehicleProbe) -> None:
    """A waypoint at 100 degrees north is refused as INVALID_PARAM5_X."""
    probe.get_ready()
    result = refusal(probe, waypoint(1_000_000_000, 85_000_000, 10.0))
    require(result in (PLAN_INVALID_X, PLAN_INVALID), f"ACK {result}")


@book.rule(f"{SERVICE}, MAV_MISSION_RESULT; {OBSERVED_ARDUPILOT}", effect=CHANGES)
def impossible_altitude_is_refused(probe: VehicleProbe) -> None:
    """A waypoint at a NaN or endless altitude is refused as INVALID_PARAM7."""
    probe.get_ready()
    home = probe.home()
    for height_m in (NAN, math.inf):
        result = refusal(probe, waypoint(home.latitude, home.longitude, height_m))
        require(result in (PLAN_INVALID_Z, PLAN_INVALID), f"{height_m}: ACK {result}")


@book.rule(f"{SERVICE}, MAV_MISSION_NO_SPACE", effect=CHANGES)
def endless_mission_is_refused(probe: VehicleProbe) -> None:
    """More items than fit are refused as NO_SPACE, before any is requested."""
    probe.get_ready()
    mark = plans.send_count(probe, 65_535, MISSION)
    result = plans.await_ack(probe, mark)
    require(result == PLAN_NO_SPACE, f"ACK {result}")
