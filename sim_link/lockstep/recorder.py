"""What a flight was: setpoints and commands on the wire, and where the vehicle truly was."""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import PositionEnu
from companion.geometry.coordinates import enu_from_ned
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lockstep.observer import Frame, Observer


@dataclass(frozen=True, slots=True)
class Sent:
    """A setpoint as decoded from the companion's bytes."""

    time_s: float
    position_enu_m: PositionEnu
    """About the autopilot's local origin."""
    vehicle_enu_m: PositionEnu
    """Where the vehicle truly was."""


class Recorder(Observer):
    """Keeps what the companion wanted and what became of it.

    Args:
        vehicle: The vehicle as it stands at the start.
    """

    def __init__(self, vehicle: SimVehicle) -> None:
        self._vehicle = vehicle
        self.setpoints: list[Sent] = []
        self.commands: list[tuple[float, int]] = []
        """COMMAND_LONG that the companion sent, by number."""
        self.true_positions: list[PositionEnu] = []

    def sent(self, frame: Frame) -> None:
        """Keep a setpoint or a command."""
        message = frame.message
        if isinstance(message, mavlink.MAVLink_command_long_message):
            self.commands.append((frame.time_s, message.command))
            return
        place = self._place(message)
        if place is not None:
            at = self._vehicle.body.position_enu_m
            self.setpoints.append(Sent(frame.time_s, place, at))

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:  # noqa: ARG002
        """Keep the place."""
        self._vehicle = vehicle
        self.true_positions.append(vehicle.body.position_enu_m)

    def _place(self, message: Message | None) -> PositionEnu | None:
        match message:
            case mavlink.MAVLink_set_position_target_local_ned_message():
                return enu_from_ned((message.x, message.y, message.z))
            case mavlink.MAVLink_set_position_target_global_int_message():
                return self._vehicle.origin.enu_from_geodetic(
                    message.lat_int / 1e7, message.lon_int / 1e7, message.alt
                )
        return None
