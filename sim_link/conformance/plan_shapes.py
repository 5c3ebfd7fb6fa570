"""Missions, fences and rally points about home, as probes upload them."""

from __future__ import annotations

from companion.mav.dialect import mavlink
from sim_link.conformance import plan_client as plans
from sim_link.conformance.plan_client import PlanItem, waypoint
from sim_link.conformance.vehicle_probe import VehicleProbe


def square(probe: VehicleProbe, count: int = 4, height_m: float = 10.0) -> list[PlanItem]:
    """Waypoints about home, 20 m apart; ArduPilot's home item first."""
    home = probe.home()
    offsets = [(1_800, 0), (1_800, 2_600), (0, 2_600), (0, 0)]
    items = []
    for number in range(count):
        north, east = offsets[number % 4]
        items.append(waypoint(home.latitude + north, home.longitude + east, height_m + number))
    return plans.with_home(probe, items)


def stored(probe: VehicleProbe) -> list[PlanItem]:
    """The mission that the vehicle has, without ArduPilot's home item."""
    return plans.without_home(probe, plans.download(probe))


def places(items: list[PlanItem]) -> list[tuple[int, int, int, float]]:
    """What must survive a round trip on either flavour."""
    return [(item.command, item.x, item.y, round(item.z, 3)) for item in items]


def prepare(probe: VehicleProbe, count: int = 3) -> list[PlanItem]:
    """Get ready and upload a mission; the items without home."""
    probe.get_ready()
    items = square(probe, count)
    plans.require_upload(probe, items)
    return plans.without_home(probe, items)


def circle(probe: VehicleProbe, radius_m: float = 500.0) -> list[PlanItem]:
    """A circular inclusion fence about home."""
    home = probe.home()
    return [
        PlanItem(
            mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION,
            mavlink.MAV_FRAME_GLOBAL_INT if probe.is_px4 else mavlink.MAV_FRAME_GLOBAL,
            (radius_m, 0.0, 0.0, 0.0),
            home.latitude,
            home.longitude,
        )
    ]


def polygon(probe: VehicleProbe, told: float = 4.0, half: int = 30_000) -> list[PlanItem]:
    """A square inclusion fence about home, each vertex telling `told` vertices."""
    home = probe.home()
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return [
        PlanItem(
            mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
            mavlink.MAV_FRAME_GLOBAL_INT if probe.is_px4 else mavlink.MAV_FRAME_GLOBAL,
            (told, 0.0, 0.0, 0.0),
            home.latitude + north * half,
            home.longitude + east * half,
        )
        for north, east in corners
    ]


def rally(probe: VehicleProbe) -> list[PlanItem]:
    """One rally point near home."""
    home = probe.home()
    return [
        PlanItem(
            mavlink.MAV_CMD_NAV_RALLY_POINT,
            mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
            if probe.is_px4
            else mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
            (0.0, 0.0, 0.0, 0.0),
            home.latitude + 900,
            home.longitude,
            15.0,
        )
    ]
