"""What may happen to a vehicle that no client asked for: pilot, satellites, weather, power.

A scenario lists incidents with their times; a test lets one happen at once with
`SimEndpoint.happen`. In YAML `kind` names the record: `{kind: gps_loss, time_s: 30, for_s: 10}`.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from companion.domain import FlightMode
from companion.params import NonNegative, Params, Positive
from sim_link.world.target import Coordinate

Deflection = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
WindSpeed = Annotated[float, msgspec.Meta(ge=-50.0, le=50.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Angle = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]


class IncidentRecord(Params, frozen=True, tag_field="kind"):
    """What every incident has."""

    time_s: NonNegative = 0.0
    """Seconds since the simulator began; a reboot does not begin them anew."""


class PilotMode(IncidentRecord, frozen=True, tag="pilot_mode"):
    """The pilot turns the mode switch; refused, with a text, where the autopilot would."""

    mode: FlightMode = FlightMode.POSITION


class PilotSticks(IncidentRecord, frozen=True, tag="pilot_sticks"):
    """The pilot moves the sticks; the transmitter is heard meanwhile."""

    forward: Deflection = 0.0
    right: Deflection = 0.0
    up: Deflection = 0.0
    yaw: Deflection = 0.0
    """Clockwise positive."""
    for_s: Positive = math.inf


class RcLoss(IncidentRecord, frozen=True, tag="rc_loss"):
    """The transmitter is not heard."""

    for_s: Positive = math.inf


class GpsLoss(IncidentRecord, frozen=True, tag="gps_loss"):
    """No satellite is seen; the estimate wanders off, and ends being used after a while."""

    for_s: Positive = math.inf


class EkfPoor(IncidentRecord, frozen=True, tag="ekf_poor"):
    """The estimator reports that measurements contradict it; the position is told all the same."""

    ratio: Positive = 1.5
    """PX4's innovation test ratios, ArduPilot's variances; both doubt from 0.8 or 1 on."""
    for_s: Positive = math.inf


class EkfJump(IncidentRecord, frozen=True, tag="ekf_jump"):
    """A reset of the estimator: from now on it reports this much more."""

    east_m: Coordinate = 0.0
    north_m: Coordinate = 0.0
    up_m: Coordinate = 0.0
    yaw_deg: Angle = 0.0
    """Clockwise."""


class OriginShift(IncidentRecord, frozen=True, tag="origin_shift"):
    """The zero of the local frame moves; the vehicle stays where it is."""

    east_m: Coordinate = 0.0
    north_m: Coordinate = 0.0
    up_m: Coordinate = 0.0


class BatteryCharge(IncidentRecord, frozen=True, tag="battery"):
    """The charge changes at once."""

    share: Share | None = None
    """0 to 1; None: from now on nobody knows it, and the reports say so."""


class WindChange(IncidentRecord, frozen=True, tag="wind"):
    """Another wind, by where it blows to; its gusts stay."""

    east_mps: WindSpeed = 0.0
    north_mps: WindSpeed = 0.0


class Reboot(IncidentRecord, frozen=True, tag="reboot"):
    """The autopilot restarts: motors off, nothing heard or said meanwhile, its clock at zero."""

    down_s: NonNegative = 1.0


Incident = (
    PilotMode
    | PilotSticks
    | RcLoss
    | GpsLoss
    | EkfPoor
    | EkfJump
    | OriginShift
    | BatteryCharge
    | WindChange
    | Reboot
)
"""Any of them."""
