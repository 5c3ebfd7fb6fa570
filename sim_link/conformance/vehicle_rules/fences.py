"""Fences: stored as they are, refused when broken, and kept."""

from __future__ import annotations

import math

from companion.mav.dialect import mavlink
from sim_link.conformance import plan_client as plans
from sim_link.conformance.plan_client import FENCE, waypoint
from sim_link.conformance.plan_shapes import circle, places, polygon
from sim_link.conformance.rules import (
    Effect,
    NotApplicable,
    Role,
    RuleBook,
    require,
)
from sim_link.conformance.vehicle_probe import VehicleProbe
from sim_link.conformance.vehicle_station import ACK_S, NAN

book = RuleBook(Role.VEHICLE, "fences")
SERVICE = "MAVLink guide, Mission Protocol"
CHANGES = Effect.CHANGES


@book.rule(f"{SERVICE}, Geofence", effect=CHANGES)
def fences_survive(probe: VehicleProbe) -> None:
    """A polygon and a circle come back with their vertex count and radius."""
    probe.get_ready()
    wanted = polygon(probe) + circle(probe)
    plans.require_upload(probe, wanted, FENCE)
    found = plans.download(probe, FENCE)
    plans.clear(probe, FENCE)
    require(places(found) == places(wanted), "the fence changed")
    told = [item.params[0] for item in found]
    require(told == [4.0, 4.0, 4.0, 4.0, 500.0], f"param1 {told}")


@book.rule(f"{SERVICE}, Geofence", effect=CHANGES)
def exclusions_survive(probe: VehicleProbe) -> None:
    """Areas to stay out of come back as such, beside one to stay in."""
    probe.get_ready()
    (inside,) = circle(probe)
    hole = plans.changed(
        inside,
        command=mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
        params=(10.0, 0.0, 0.0, 0.0),
        x=inside.x + 9_000,
    )
    vertex = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
    zone = [
        plans.changed(corner, command=vertex, y=corner.y + 90_000)
        for corner in polygon(probe, half=9_000)
    ]
    wanted = [inside, hole, *zone]
    plans.require_upload(probe, wanted, FENCE)
    found = plans.download(probe, FENCE)
    plans.clear(probe, FENCE)
    require(places(found) == places(wanted), "the fence changed")


@book.rule(f"{SERVICE}, Geofence", effect=CHANGES)
def broken_fence_is_refused(probe: VehicleProbe) -> None:
    """A polygon that tells more vertices than it has is refused, and the old fence stays."""
    probe.get_ready()
    plans.require_upload(probe, circle(probe), FENCE)
    result = plans.upload(probe, polygon(probe, told=7.0), FENCE)
    require(result != 0, "accepted")
    found = plans.download(probe, FENCE)
    plans.clear(probe, FENCE)
    require(len(found) == 1, f"{len(found)} items are left of the old fence")


@book.rule(SERVICE, effect=CHANGES)
def mission_item_in_a_fence_is_refused(probe: VehicleProbe) -> None:
    """A waypoint is no part of a fence: UNSUPPORTED, or another error."""
    probe.get_ready()
    home = probe.home()
    item = waypoint(home.latitude, home.longitude, 10.0)
    require(plans.upload(probe, [item], FENCE) != 0, "accepted")


@book.rule(
    f"{SERVICE}, Geofence",
    effect=Effect.FLIES,
    px4="GF_ACTION",
    ardupilot="stays inside, destinations outside are refused",
)
def fence_is_kept(probe: VehicleProbe) -> None:
    """A vehicle sent out of its fence does not go on outwards."""
    probe.take_off()
    radius_m = 30.0
    plans.require_upload(probe, circle(probe, radius_m), FENCE)
    enable_fence(probe)
    probe.watch(mavlink.MAVLink_global_position_int_message, 0.1)
    here = probe.latest(mavlink.MAVLink_global_position_int_message)
    probe.command_int(
        mavlink.MAV_CMD_DO_REPOSITION,
        mavlink.MAV_FRAME_GLOBAL,
        (-1.0, 1.0, 0.0, NAN),
        (here.lat + 9_000, here.lon, here.alt / 1e3),
    )
    probe.run(25.0)
    home = probe.home()
    north, east, _ = probe.place()
    distance_m = math.dist((north, east), (home.x, home.y))
    plans.clear(probe, FENCE)
    disable_fence(probe)
    require(distance_m < radius_m + 15.0, f"{distance_m:.0f} m from the centre of {radius_m:g} m")


def enable_fence(probe: VehicleProbe) -> None:
    """Switch the fence on: GF_ACTION 2 (hold), or FENCE_ENABLE.

    Raises:
        NotApplicable: It cannot be switched on.
    """
    names = {True: (b"GF_ACTION", 2, 6), False: (b"FENCE_ENABLE", 1.0, 2)}
    name, value, kind = names[probe.is_px4]
    field = float(value) if not probe.is_px4 else 2.8e-45
    mark = probe.mark
    probe.send(mavlink.MAVLink_param_set_message(*probe.target, name, field, kind))
    told = probe.run_until(
        lambda: any(
            isinstance(e.message, mavlink.MAVLink_param_value_message)
            and e.message.param_id == name.decode()
            for e in probe.inbox[mark:]
        ),
        ACK_S,
    )
    if not told:
        raise NotApplicable(f"no parameter {name.decode()}")


def disable_fence(probe: VehicleProbe) -> None:
    """FENCE_ENABLE 0; PX4's goes with its fence."""
    if not probe.is_px4:
        probe.send(mavlink.MAVLink_param_set_message(*probe.target, b"FENCE_ENABLE", 0.0, 2))
