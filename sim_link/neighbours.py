"""Other vehicles that a companion hears, at their own addresses or behind our vehicle's.

Each is a whole simulated vehicle, in the air, with a boot clock and sequence numbers of its own,
and its own companion keeps it where it is. What our companion sends reaches it as it would there:
everything that is sent to its address, and, where both are behind one address, everything that is
sent to that. `FleetAmongOthers` puts them next to our vehicles on real links.
"""

from __future__ import annotations

import math

import msgspec

from companion.domain import FlightMode, PositionEnu
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk, Endpoint
from sim_link.autopilot.ardupilot.firmware_profile import GUIDED
from sim_link.autopilot.ardupilot.flavour import ArduPilotFlavour
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import OtherVehicle
from sim_link.autopilot.other_senders import PAYLOAD_ID, setpoint_at
from sim_link.autopilot.px4.flavour import Px4Flavour
from sim_link.autopilot.scenario import Scenario

COMPONENT_BYTE = 6
"""Offset of the sender's component id in a MAVLink 2 frame."""
STREAM_S = 0.1
"""Period of its own companion's setpoints and requests."""
NEIGHBOURS_UID = 4096
"""Hardware id less the system id, different from that of our vehicle."""
STREAMS = (
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
)


class Neighbour:
    """One other vehicle in the air; heard from `peer`, None: on our links."""

    def __init__(
        self, setup: OtherVehicle, scenario: Scenario, peer: Address | None, now_s: float
    ) -> None:
        self.setup, self.peer = setup, peer
        self.began_s = now_s
        self._own_setpoints = 0
        east, north, up = setup.position_enu_m
        own_flavour = scenario.autopilot.flavour
        autopilot = msgspec.structs.replace(
            scenario.autopilot,
            flavour=own_flavour if setup.flavour == "same" else setup.flavour,
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
            other_vehicles=(),
        )
        self.sim = SimEndpoint(own, setup.system_id, now_s - setup.uptime_s)
        self._codec = MavCodec(setup.system_id, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._stream_s = now_s
        for number in STREAMS:
            self._ask(number, now_s)
        self._lift(up, now_s)

    def _ask(self, number: int, now_s: float) -> None:
        """Request a stream as its own companion, in ArduPilot's way."""
        params = (float(number), 1e6 * STREAM_S, *(0.0,) * 5)
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        message = mavlink.MAVLink_command_long_message(self.setup.system_id, 1, command, 0, *params)
        self.sim.receive(Chunk(0, self._codec.encode(message), None), now_s)

    def _lift(self, up_m: float, now_s: float) -> None:
        """Place it in the air, armed, in its configured mode."""
        vehicle = self.sim.vehicle
        position = (*vehicle.body.position_enu_m[:2], up_m)
        vehicle.body.position_enu_m = position
        vehicle.estimator.step(0.0, position, 0.0)
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
        """A setpoint of its own companion: here."""
        message = setpoint_at(self.setup.position_enu_m, self.setup.system_id, now_s)
        self.sim.receive(Chunk(0, self._codec.encode(message), None), now_s)
        self._own_setpoints += 1

    def take_output(self) -> list[Chunk]:
        """Return its output, without its radio, which measures nothing for us."""
        payload = PAYLOAD_ID
        return [each for each in self.sim.take_output() if each.data[COMPONENT_BYTE] != payload]

    def step(self, now_s: float) -> None:
        """Advance its time."""
        if self.setup.is_offboard and now_s >= self._stream_s:
            self._stream_s = now_s + STREAM_S
            self._stay(now_s)
        self.sim.handle_timer(now_s)

    @property
    def position_enu_m(self) -> PositionEnu:
        """True position in the world's frame."""
        return self.sim.vehicle.body.position_enu_m

    @property
    def strange_setpoints(self) -> int:
        """Setpoints for its ids that were not its own companion's."""
        return self.sim.vehicle.setpoints.received - self._own_setpoints

    @property
    def summary(self) -> str:
        """Interference of others with it, in one line."""
        moved_m = math.dist(self.position_enu_m, self.setup.position_enu_m)
        return (
            f"other vehicle {self.setup.system_id}: {self.strange_setpoints} setpoints that are "
            f"not its companion's, moved {moved_m:.1f} m"
        )


class FleetAmongOthers:
    """Our vehicles and the scenario's others as one endpoint; `links` are those of our vehicles.

    Others with an address of their own have the links after those, one each, in the scenario's
    order; the rest is heard and reached on the first vehicle's, `shared` in number.
    """

    def __init__(self, fleet: Endpoint, scenario: Scenario, links: int, shared: int) -> None:
        self._fleet, self._scenario, self._links = fleet, scenario, links
        self._waiting: list[tuple[OtherVehicle, range]] = []
        """Neighbours that have not appeared yet, and their links."""
        self._here: list[tuple[Neighbour, range]] = []
        self._gone: list[Neighbour] = []
        for setup in scenario.other_vehicles:
            own = range(links, links + 1)
            links += setup.has_own_address
            self._waiting.append((setup, own if setup.has_own_address else range(shared)))

    @property
    def others(self) -> list[Neighbour]:
        """Neighbours that are or were there."""
        return [*self._gone, *(each for each, _ in self._here)]

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Pass bytes to every vehicle on their link."""
        for other, links in self._here:
            if chunk.link in links:
                other.sim.receive(Chunk(0, chunk.data, None), now_s)
        if chunk.link < self._links:
            self._fleet.receive(chunk, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Step all vehicles that are due, and add and remove others."""
        for setup, links in [each for each in self._waiting if each[0].start_s <= now_s]:
            self._waiting.remove((setup, links))
            self._here.append((Neighbour(setup, self._scenario, None, now_s), links))
        for other, links in list(self._here):
            if other.setup.end_s <= now_s:
                self._here.remove((other, links))
                self._gone.append(other)
            elif other.sim.next_timer_s() <= now_s:
                other.step(now_s)
        if self._fleet.next_timer_s() <= now_s:
            self._fleet.handle_timer(now_s)

    def next_timer_s(self) -> float:
        """Return the earliest timer of all vehicles, s."""
        due_s = [other.sim.next_timer_s() for other, _ in self._here]
        due_s += [setup.start_s for setup, _ in self._waiting]
        return min(self._fleet.next_timer_s(), *due_s) if due_s else self._fleet.next_timer_s()

    def take_output(self) -> list[Chunk]:
        """Collect the output of all vehicles; others have no radio that measures."""
        output = self._fleet.take_output()
        for other, links in self._here:
            for chunk in other.take_output():
                output += [Chunk(link, chunk.data) for link in links]
        return output

    def request_stop(self, now_s: float) -> None:
        """Finish at once."""
        self._fleet.request_stop(now_s)

    @property
    def is_finished(self) -> bool:
        """True if our vehicles have finished."""
        return self._fleet.is_finished
