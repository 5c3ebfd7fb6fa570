"""Other vehicles that reach the companion: by addresses of their own, or by our vehicle's.

Each is a whole simulated vehicle, in the air, with a boot clock and sequence numbers of its own,
and its own companion keeps it where it is. What our companion sends reaches it as it would there:
everything that is sent to its address, and, where both are behind one address, everything that is
sent to that.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from companion.domain import FlightMode, PositionEnu
from companion.geometry.coordinates import ned_from_enu
from companion.mav.codec import MavCodec
from companion.mav.dialect import POSITION_ONLY, mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.flavours.ardupilot.flavour import ArduPilotFlavour
from sim_link.autopilot.flavours.ardupilot.flight_modes import GUIDED
from sim_link.autopilot.flavours.px4.flavour import Px4Flavour
from sim_link.autopilot.flavours.vehicle_types import VehicleTypeName
from sim_link.autopilot.scenario import FlavourName, Scenario

STREAM_S = 0.1
"""Of the setpoints of its own companion, and of what it asks for."""
NEIGHBOURS_UID = 4096
"""Plus the system id: its hardware is another one than that of our vehicle."""
STREAMS = (
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
)


@dataclass(frozen=True, slots=True)
class NeighbourSetup:
    """Identity and place of a neighbour."""

    system_id: int
    vehicle_type: VehicleTypeName
    flavour: FlavourName
    uptime_s: float
    place_enu_m: PositionEnu
    is_offboard: bool
    """It flies by setpoints of its own companion, and would obey ours; otherwise it holds."""


class Neighbour:
    """One other vehicle, heard from `peer` until `end_s`."""

    def __init__(
        self, setup: NeighbourSetup, scenario: Scenario, peer: Address, now_s: float, end_s: float
    ) -> None:
        self.setup, self.peer, self.end_s = setup, peer, end_s
        self.began_s = now_s
        east, north, up = setup.place_enu_m
        autopilot = msgspec.structs.replace(
            scenario.autopilot,
            flavour=setup.flavour,
            vehicle_type=setup.vehicle_type,
            ready_after_s=0.0,
            parameters={},
            uid=NEIGHBOURS_UID + setup.system_id,
        )
        own = msgspec.structs.replace(
            scenario,
            system_id=setup.system_id,
            start_enu_m=(east, north),
            autopilot=autopilot,
            incidents=(),
        )
        self.sim = SimEndpoint(own, setup.system_id, now_s - setup.uptime_s)
        self._codec = MavCodec(setup.system_id, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._stream_s = now_s
        for number in STREAMS:
            self._ask(number, now_s)
        self._lift(up, now_s)

    def _ask(self, number: int, now_s: float) -> None:
        """Request a stream for its own companion, as ArduPilot needs."""
        params = (float(number), 1e6 * STREAM_S, *(0.0,) * 5)
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        message = mavlink.MAVLink_command_long_message(self.setup.system_id, 1, command, 0, *params)
        self.sim.receive(Chunk(0, self._codec.encode(message), None), now_s)

    def _lift(self, up_m: float, now_s: float) -> None:
        """Put it into the air, armed, in the mode that it shall be found in."""
        vehicle = self.sim.vehicle
        place = (*vehicle.body.position_enu_m[:2], up_m)
        vehicle.body.position_enu_m = place
        vehicle.estimator.step(0.0, place, 0.0)
        vehicle.aircraft.is_armed = True
        mode = FlightMode.OFFBOARD if self.setup.is_offboard else FlightMode.HOLD
        boot_s = self.setup.uptime_s
        match vehicle.flavour:
            case Px4Flavour() as px4:
                px4.intention = mode
            case ArduPilotFlavour() as copter if self.setup.is_offboard:
                copter.choose(GUIDED, boot_s)
            case ArduPilotFlavour() as copter:
                copter.pilot_chooses(mode, boot_s)
        self._stay(now_s)

    def _stay(self, now_s: float) -> None:
        """Send a setpoint of its own companion at the present position."""
        north, east, down = ned_from_enu(self.setup.place_enu_m)
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            round(now_s * 1e3),
            self.setup.system_id,
            1,
            mavlink.MAV_FRAME_LOCAL_NED,
            POSITION_ONLY,
            *(north, east, down),
            *(0.0,) * 8,
        )
        self.sim.receive(Chunk(0, self._codec.encode(message), None), now_s)

    def step(self, now_s: float) -> None:
        """Let time pass for it."""
        if self.setup.is_offboard and now_s >= self._stream_s:
            self._stream_s = now_s + STREAM_S
            self._stay(now_s)
        self.sim.handle_timer(now_s)

    @property
    def place_enu_m(self) -> PositionEnu:
        """Its true place, in the world's frame."""
        return self.sim.vehicle.body.position_enu_m
