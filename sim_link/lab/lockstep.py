"""One flight in lockstep: a companion and a simulated vehicle, bytes between them, invented time.

Theory of operation. The earliest of what is due happens next; at the same time in this order:
arrivals and actions in the order in which they were posted, physics, radio, control tick, then
whatever those sent if the wire delivers it at once. So a flight depends on its configuration,
scenario, seed, wire and actions only, and two of the same give the same bytes.

The companion behaves as a process: it may be killed, restarted, asked to stop, and suspended. A
suspended one receives the content of its socket, in order, when it continues; the socket holds no
more than Linux gives it by default, and drops the rest.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from companion.config.schema import CompanionConfig
from companion.domain import Autopilot, FlightMode
from companion.flight_setup import build_endpoint
from companion.guidance.commands import ReportResult, Severity
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import VEHICLE_ONLY, Journal, LinkSpec
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Address, Chunk
from companion.mav.flight_modes import set_mode_params
from companion.mav.signing import LinkSigning
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.incidents import IncidentRecord, OtherVehicle, PilotMode, VehicleReboot
from sim_link.autopilot.other_senders import PAYLOAD_ID
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.observer import Frame, Lane, Observers, PerfectWire, Wire, frames_in
from sim_link.neighbours import COMPONENT_BYTE, Neighbour


class MemoryJournal:
    """Everything that the endpoint reports, in the order of time."""

    def __init__(self) -> None:
        self.texts: list[tuple[float, str]] = []
        self.records: list[tuple[float, str, Mapping[str, object]]] = []
        self.results: list[tuple[float, ReportResult]] = []

    def frame(self, data: bytes, now_s: float) -> None:
        """Do nothing: the flight's observers record frames."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Keep an event."""
        self.records.append((now_s, kind, fields))

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Keep a text."""
        del severity
        self.texts.append((now_s, text))

    def result(self, report: ReportResult, now_s: float) -> None:
        """Keep a report."""
        self.results.append((now_s, report))


class WatchedJournal:
    """Journal that forwards everything, and notifies observers."""

    def __init__(self, journal: Journal, observers: Observers) -> None:
        self._journal = journal
        self._observers = observers

    def frame(self, data: bytes, now_s: float) -> None:
        """Pass a frame on."""
        self._journal.frame(data, now_s)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Pass an event on."""
        self._journal.record(kind, fields, now_s)
        self._notify(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Forward a text."""
        self._journal.text(severity, text, now_s)
        self._notify("text", {"severity": severity.name.lower(), "text": text}, now_s)

    def result(self, report: ReportResult, now_s: float) -> None:
        """Pass a report on."""
        self._journal.result(report, now_s)
        self._notify("result", {"r95_m": report.estimate.r95_m}, now_s)

    def _notify(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        self._observers.notify("noted", kind, fields, now_s)


VEHICLE_PEER: Address = ("127.0.0.1", 14580)
COMPANION_PEER: Address = ("127.0.0.1", 14550)
RADIO_PEER: Address = ("127.0.0.1", 15000)
FIRST_OTHER_PEER: Address = ("127.0.0.1", 18000)
SOCKET_BYTES = 212_992
"""Capacity of a UDP socket (Linux net.core.rmem_default); it counts each datagram's overhead."""
DATAGRAM_OVERHEAD = 512

MakeCompanion = Callable[[CompanionConfig, Journal, Sequence[LinkSpec]], CompanionEndpoint]
"""Configuration, journal and links to a companion that was just started."""
MakeSimulator = Callable[[Scenario, int, float], SimEndpoint]
"""Scenario, seed and time to a vehicle that was just switched on."""


@dataclass(frozen=True, slots=True)
class Makers:
    """Factories of the companion process and the simulated vehicle, also after a restart."""

    companion: MakeCompanion = build_endpoint
    simulator: MakeSimulator = SimEndpoint


class Flight:
    """One flight; the seed is that of the vehicle, its radio and the world."""

    def __init__(
        self,
        config: CompanionConfig,
        scenario: Scenario,
        seed: int,
        journal: Journal,
        *,
        wire: Wire | None = None,
        makers: Makers = Makers(),
    ) -> None:
        self.config = config
        self.scenario = scenario
        self.seed = seed
        self.observers = Observers()
        self.journal: Journal = WatchedJournal(journal, self.observers)
        self.wire: Wire = PerfectWire() if wire is None else wire
        self.now_s = 0.0
        self.is_link_up = True
        """False: the cable between the two is disconnected."""
        self.is_ranging_up = True
        """False: the simulator's radio is silent."""
        self.is_companion_up = False
        self._makers = makers
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._suspended_until_s = 0.0
        self._socket: deque[tuple[Chunk, bool, bool]] = deque()
        self._socket_bytes = 0
        self.neighbours: list[Neighbour] = []
        """Other vehicles that are heard now."""
        self.vehicle_peer = VEHICLE_PEER
        """Address of the vehicle, which a NAT on the way may change."""
        self.sim = makers.simulator(scenario, seed, 0.0)
        self.start_companion()
        for other in scenario.other_vehicles:
            self.at(other.start_s, partial(self.bring_other, other, other.end_s))

    def run(self, duration_s: float) -> None:
        """Advance the time."""
        until_s = self.now_s + duration_s
        while self._next_s() <= until_s:
            self.step()
        self.now_s = until_s

    def step(self) -> None:
        """Execute the next event and all others due at the same time."""
        self.now_s = max(self.now_s, self._next_s())
        now_s = self.now_s
        self.settle()
        if self.sim.next_timer_s() <= now_s:
            self.sim.handle_timer(now_s)
            self.observers.notify("stepped", self.sim.vehicle, now_s)
        for neighbour in self.neighbours:
            if neighbour.sim.next_timer_s() <= now_s:
                neighbour.step(now_s)
        if self.is_companion_up and self._companion_due_s() <= now_s:
            self._wake_companion()
            ticks = self.companion.ticks
            self.companion.handle_timer(now_s)
            if self.companion.ticks != ticks:
                self.observers.notify("ticked", now_s)
        self.settle()

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Schedule an action at a time, or now if that has passed."""
        self._count += 1
        heapq.heappush(self._queue, (max(time_s, self.now_s), self._count, action))

    def _next_s(self) -> float:
        due_s = self.sim.next_timer_s()
        if self.is_companion_up:
            due_s = min(due_s, self._companion_due_s())
        for neighbour in self.neighbours:
            due_s = min(due_s, neighbour.sim.next_timer_s())
        if self._queue:
            due_s = min(due_s, self._queue[0][0])
        return max(0.0, due_s)

    def _companion_due_s(self) -> float:
        return max(self.companion.next_timer_s(), self._suspended_until_s)

    def settle(self) -> None:
        """Carry datagrams sent outside a step, and deliver those that are due."""
        self._collect()
        while self._queue and self._queue[0][0] <= self.now_s:
            heapq.heappop(self._queue)[2]()
            self._collect()

    def post(self, data: bytes, lane: Lane) -> None:
        """Put a datagram on the wire."""
        if not self.is_link_up and lane is not Lane.RANGING:
            return
        for due_s, arriving in self.wire.carry(data, lane, self.now_s):
            self.at(due_s, partial(self._arrive, arriving, lane, is_intact=arriving is data))

    def _arrive(self, data: bytes, lane: Lane, *, is_intact: bool) -> None:
        if lane is Lane.TO_VEHICLE:
            self._notify("vehicle_heard", data, lane)
            self.sim.receive(Chunk(0, data, None), self.now_s)
            return
        is_ranging = lane is Lane.RANGING
        chunk = Chunk(1, data, RADIO_PEER) if is_ranging else Chunk(0, data, self.vehicle_peer)
        self._reach_companion(chunk, is_genuine=True, is_intact=is_intact)

    def attack(self, chunk: Chunk) -> None:
        """Deliver an attacker's datagram to the companion now, regardless of the wire."""
        self._reach_companion(chunk, is_genuine=False, is_intact=False)

    def _reach_companion(self, chunk: Chunk, *, is_genuine: bool, is_intact: bool) -> None:
        if not self.is_companion_up:
            return
        if self.now_s < self._suspended_until_s:
            size = len(chunk.data) + DATAGRAM_OVERHEAD
            if self._socket_bytes + size <= SOCKET_BYTES:
                self._socket_bytes += size
                self._socket.append((chunk, is_genuine, is_intact))
            return
        self._wake_companion()
        self._give(chunk, is_genuine, is_intact)

    def _give(self, chunk: Chunk, is_genuine: bool, is_intact: bool) -> None:
        lane = Lane.TO_COMPANION if chunk.link == 0 else Lane.RANGING
        hearing, reading = self.observers.of("heard"), self.observers.of("read")
        frames = [
            Frame(self.now_s, each, lane, is_genuine, is_intact, chunk.peer)
            for each in (frames_in(chunk.data) if hearing or reading else ())
        ]
        for frame in frames:
            for heard in hearing:
                heard(frame)
        self.companion.receive(chunk, self.now_s)
        for frame in frames:
            for read in reading:
                read(frame)

    def _wake_companion(self) -> None:
        """Deliver the datagrams that waited in the socket while the process was suspended."""
        while self._socket:
            self._give(*self._socket.popleft())
        self._socket_bytes = 0

    def _collect(self) -> None:
        for chunk in self.sim.take_output():
            if COMPANION_PEER in chunk.except_peers or chunk.peer not in (None, COMPANION_PEER):
                continue  # forwarded to someone else
            is_payload = chunk.data[COMPONENT_BYTE] == PAYLOAD_ID
            if is_payload and not self.is_ranging_up:
                continue
            self._notify("vehicle_sent", chunk.data, Lane.TO_COMPANION)
            self.post(chunk.data, Lane.TO_COMPANION)
        for neighbour in self.neighbours:
            for chunk in neighbour.take_output():
                self.attack(Chunk(0, chunk.data, neighbour.peer))
        if not self.is_companion_up:
            return
        for chunk in self.companion.take_output():
            self._notify("sent", chunk.data, Lane.TO_VEHICLE)
            self._reach_neighbours(chunk)
            if chunk.peer in (None, self.vehicle_peer):
                self.post(chunk.data, Lane.TO_VEHICLE)
        if self.companion.is_finished:
            self._end_companion()

    def _reach_neighbours(self, chunk: Chunk) -> None:
        """Deliver the companion's datagrams to another vehicle's address, or to all."""
        for neighbour in self.neighbours:
            if chunk.peer in (None, neighbour.peer):
                for each in frames_in(chunk.data):
                    frame = Frame(self.now_s, each, Lane.TO_VEHICLE)
                    self.observers.notify("neighbour_heard", frame, neighbour)
                neighbour.sim.receive(Chunk(0, chunk.data, None), self.now_s)

    def bring_other(self, setup: OtherVehicle, end_s: float) -> None:
        """Add another vehicle to the link, from now until its configured end."""
        host, port = FIRST_OTHER_PEER
        peer = (host, port + len(self.neighbours)) if setup.has_own_address else VEHICLE_PEER
        neighbour = Neighbour(setup, self.scenario, peer, self.now_s)
        self.neighbours.append(neighbour)
        self.at(end_s, lambda: self.neighbours.remove(neighbour))

    def _notify(self, what: str, data: bytes, lane: Lane) -> None:
        """Notify its observers of the frames in a datagram."""
        listeners = self.observers.of(what)
        if listeners:
            for each in frames_in(data):
                frame = Frame(self.now_s, each, lane)
                for notify in listeners:
                    notify(frame)

    def start_companion(self) -> None:
        """Start the process, or a new one in place of one that ended."""
        self.companion = self._makers.companion(self.config, self.journal, VEHICLE_ONLY)
        self.is_companion_up = True
        self.observers.notify("companion_started", self.now_s)

    def kill_companion(self) -> None:
        """End the process without warning (SIGKILL, power)."""
        if self.is_companion_up:
            self.companion.take_output()
            self._end_companion()

    def stop_companion(self) -> None:
        """Ask the process to end (SIGTERM)."""
        if self.is_companion_up:
            self._wake_companion()
            self.companion.request_stop(self.now_s)
            self._collect()

    def suspend_companion(self, duration_s: float) -> None:
        """Suspend the process (SIGSTOP, starvation)."""
        self._suspended_until_s = max(self._suspended_until_s, self.now_s + duration_s)
        self.observers.notify("companion_suspended", self.now_s, self._suspended_until_s)

    def _end_companion(self) -> None:
        self.is_companion_up = False
        self._suspended_until_s = 0.0
        self._socket.clear()
        self._socket_bytes = 0
        self.observers.notify("companion_ended", self.now_s)

    def apply_incident(self, incident: IncidentRecord) -> None:
        """Apply an incident to the vehicle."""
        self.sim.apply_incident(incident, self.now_s)
        if isinstance(incident, PilotMode):
            self.note_chosen(incident.mode)
        if isinstance(incident, VehicleReboot):
            self.observers.notify("vehicle_rebooted", self.now_s)

    def note_chosen(self, mode: FlightMode) -> None:
        """Notify the observers that a person switched the mode."""
        self.observers.notify("mode_chosen", mode, self.now_s)

    @property
    def autopilot(self) -> Autopilot:
        """Simulated autopilot."""
        is_px4 = self.scenario.autopilot.flavour == "px4"
        return Autopilot.PX4 if is_px4 else Autopilot.ARDUPILOT

    @property
    def mode(self) -> FlightMode:
        """Actual mode of the vehicle."""
        return self.sim.vehicle.flavour.mode


STATION_PEER: Address = ("127.0.0.1", 1)
COMPANION_COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER


class Operator:
    """Ground station on a link to the vehicle without faults, signed where required."""

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
        """Command a flight mode, as a ground station does."""
        flight = self._flight
        is_armed = flight.sim.vehicle.flavour.is_armed
        params = set_mode_params(mode, flight.autopilot, is_armed=is_armed)
        self.command(mavlink.MAV_CMD_DO_SET_MODE, *params)
        flight.note_chosen(mode)

    def grant(self) -> None:
        """Grant control to the companion, through the autopilot, which forwards the command."""
        number, rest = mavlink.MAV_CMD_NAV_GUIDED_ENABLE, [0.0] * 6
        target = (self._flight.scenario.system_id, COMPANION_COMPONENT)
        message = mavlink.MAVLink_command_long_message(*target, number, 0, 1.0, *rest)
        self._flight.post(self._encoded(message), Lane.TO_COMPANION)

    def _encoded(self, message: Message) -> bytes:
        if self._signing is not None:
            self._signing.signing.advance(self._started_unix_s + self._flight.now_s)
        return self._station.encode(message)
