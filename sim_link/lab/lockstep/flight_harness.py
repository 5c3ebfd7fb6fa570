"""The operator of a lockstep flight."""

from __future__ import annotations

import math

from companion.domain import FlightMode
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.flight_modes import set_mode_params
from companion.mav.signing import LinkSigning
from sim_link.lab.lockstep.flight import Flight
from sim_link.lab.lockstep.observer import Lane

STATION_PEER: Address = ("127.0.0.1", 1)
COMPANION_COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER


class Operator:
    """A ground station with a link of its own to the vehicle, which no fault touches.

    It signs, from a Unix time at the start of the flight on, where the vehicle wants that.
    """

    def __init__(
        self, flight: Flight, signing: LinkSigning | None = None, started_unix_s: float = 0.0
    ) -> None:
        self._flight = flight
        self._signing = signing
        self._started_unix_s = started_unix_s
        self._station = MavCodec(255, mavlink.MAV_COMP_ID_MISSIONPLANNER, signing)

    def send(self, message: Message, peer: Address | None = STATION_PEER) -> None:
        """Send to the vehicle."""
        self._flight.sim.receive(Chunk(0, self._encoded(message), peer), self._flight.now_s)

    def command(self, number: int, *params: float) -> None:
        """Command the vehicle; parameters that are left out are NaN."""
        padded = [*params, *[math.nan] * (7 - len(params))]
        system = self._flight.scenario.system_id
        self.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *padded))

    def arm(self) -> None:
        """Ask to arm."""
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def disarm(self) -> None:
        """Disarm by force, in the air too."""
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21_196.0)

    def choose(self, mode: FlightMode) -> None:
        """Switch the mode."""
        flight = self._flight
        is_armed = flight.sim.vehicle.flavour.is_armed
        params = set_mode_params(mode, flight.autopilot, is_armed=is_armed)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, *params)
        flight.note_chosen(mode)

    def grant(self) -> None:
        """Give control back to the companion, through the autopilot, which forwards it."""
        number, rest = mavlink.MAV_CMD_NAV_GUIDED_ENABLE, [0.0] * 6
        target = (self._flight.scenario.system_id, COMPANION_COMPONENT)
        message = mavlink.MAVLink_command_long_message(*target, number, 0, 1.0, *rest)
        self._flight.post(self._encoded(message), Lane.TO_COMPANION)

    def _encoded(self, message: Message) -> bytes:
        if self._signing is not None:
            self._signing.signing.advance(self._started_unix_s + self._flight.now_s)
        return self._station.encode(message)
