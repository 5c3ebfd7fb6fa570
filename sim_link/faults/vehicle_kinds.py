"""What can happen to the vehicle, its autopilot, its pilot and the weather."""

from __future__ import annotations

from typing import Annotated

import msgspec

from companion.domain import FlightMode, NonNegative, Positive
from sim_link.faults.record import FaultRecord, Length, Rate, Share

Angle = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
Deflection = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
WindSpeed = Annotated[float, msgspec.Meta(ge=-50.0, le=50.0)]


class VehicleFault(FaultRecord, frozen=True):
    """Something with the vehicle, its autopilot or the weather."""


class VehicleReboot(VehicleFault, frozen=True, tag="vehicle_reboot"):
    """The autopilot restarts, motors off; event."""

    down_s: NonNegative = 1.0


class EkfJump(VehicleFault, frozen=True, tag="ekf_jump"):
    """The autopilot's estimator resets: from now on it reports this much more; event."""

    east_m: Length = 7.0
    north_m: Length = 0.0
    up_m: Length = 0.0
    yaw_deg: Angle = 0.0


class EkfPoor(VehicleFault, frozen=True, tag="ekf_poor"):
    """The autopilot says that measurements contradict its estimate."""

    ratio: Positive = 1.5


class GpsLoss(VehicleFault, frozen=True, tag="gps_loss"):
    """No satellites: the fix is gone and the estimate wanders."""


class Wind(VehicleFault, frozen=True, tag="wind"):
    """Another wind, by where it blows to; calm when it is over."""

    east_mps: WindSpeed = 12.0
    north_mps: WindSpeed = 0.0


class Battery(VehicleFault, frozen=True, tag="battery"):
    """The charge changes at once; event."""

    share: Share | None = 0.14
    """None: nobody knows it any more."""


class OriginShift(VehicleFault, frozen=True, tag="origin_shift"):
    """The zero of the local frame moves; event."""

    east_m: Length = 10.0
    north_m: Length = 0.0


class PilotMode(VehicleFault, frozen=True, tag="pilot_mode"):
    """The pilot turns the mode switch; event."""

    mode: FlightMode = FlightMode.HOLD


class PilotSticks(VehicleFault, frozen=True, tag="pilot_sticks"):
    """The pilot moves the sticks."""

    forward: Deflection = 0.5
    right: Deflection = 0.0


class ModeFlap(VehicleFault, frozen=True, tag="mode_flap"):
    """The mode switch goes to and fro."""

    mode: FlightMode = FlightMode.HOLD
    period_s: Positive = 0.5
    duration_s: Positive = 4.0


class Failsafe(VehicleFault, frozen=True, tag="failsafe"):
    """The autopilot leaves by itself; event."""

    mode: FlightMode = FlightMode.RETURN


class Disarm(VehicleFault, frozen=True, tag="disarm"):
    """The motors stop in the air; event."""


class SecondSender(VehicleFault, frozen=True, tag="second_sender"):
    """Somebody else sends setpoints to the vehicle."""

    rate_hz: Rate = 10.0
    east_m: Length = 20.0
    north_m: Length = 20.0
    up_m: Length = 15.0
    duration_s: Positive = 3.0
