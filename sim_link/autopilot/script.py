"""Lets incidents happen: each at its time, or at once."""

from __future__ import annotations

import math
from collections.abc import Iterable

import msgspec

from sim_link.autopilot.incidents import (
    BatteryCharge,
    EkfJump,
    EkfPoor,
    GpsLoss,
    Incident,
    OriginShift,
    PilotMode,
    PilotSticks,
    RcLoss,
    Reboot,
    WindChange,
)
from sim_link.autopilot.sticks import Sticks
from sim_link.autopilot.vehicle import STEP_S, SimVehicle


class Script:
    """The incidents that are still to come.

    Args:
        incidents: In any order.
    """

    def __init__(self, incidents: Iterable[Incident]) -> None:
        self._coming = sorted(incidents, key=lambda incident: incident.time_s, reverse=True)

    def take_due(self, now_s: float) -> list[Incident]:
        """Those whose time has come, `now_s` seconds since the simulator began."""
        due = []
        while self._coming and self._coming[-1].time_s <= now_s + 0.5 * STEP_S:
            due.append(self._coming.pop())
        return due


def apply(incident: Incident, vehicle: SimVehicle, now_s: float) -> None:
    """Let an incident happen to a vehicle now; a reboot is its endpoint's business.

    Args:
        incident: What; its `time_s` means nothing here.
        vehicle: To whom.
        now_s: Seconds since the vehicle's boot.
    """
    aircraft, estimator = vehicle.aircraft, vehicle.aircraft.estimator
    match incident:
        case PilotMode():
            vehicle.flavour.pilot_chooses(incident.mode, now_s)
        case PilotSticks():
            sticks = Sticks(incident.forward, incident.right, incident.up, incident.yaw)
            aircraft.sticks.move(sticks, now_s + incident.for_s)
        case RcLoss():
            aircraft.sticks.lose(now_s + incident.for_s)
        case GpsLoss():
            estimator.lose_fix(now_s + incident.for_s)
        case EkfPoor():
            estimator.spoil(incident.ratio, now_s + incident.for_s)
        case EkfJump():
            offset = (incident.east_m, incident.north_m, incident.up_m)
            estimator.jump(offset, math.radians(incident.yaw_deg))
        case OriginShift():
            aircraft.shift_origin((incident.east_m, incident.north_m, incident.up_m))
        case BatteryCharge():
            aircraft.battery.set_charge(incident.share)
        case WindChange():
            wind = msgspec.structs.replace(
                aircraft.body.wind, east_mps=incident.east_mps, north_mps=incident.north_mps
            )
            aircraft.body.set_wind(wind)
        case Reboot():
            return
    vehicle.flavour.note(now_s, f"incident: {incident.__struct_config__.tag}")
