"""Companion and simulator joined in memory: MAVLink bytes both ways, on invented time."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import Autopilot, FlightMode, Point, PositionEnu
from companion.geometry.frames import enu_from_ned
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.session import SessionParams
from companion.guidance.states import Phase
from companion.link.endpoint import CompanionEndpoint
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.modes import set_mode_params
from companion.run import build_endpoint
from sim_link.autopilot import payload
from sim_link.autopilot.endpoint import SimEndpoint
from sim_link.autopilot.scenario import Scenario

VEHICLE_PEER = ("127.0.0.1", 14580)
COMPANION_PEER = ("127.0.0.1", 14550)
AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF
GRANT = mavlink.MAV_CMD_NAV_GUIDED_ENABLE
COMPONENT_BYTE = 6
"""Offset of the sender's component id in a MAVLink 2 frame."""

PayloadSource = Callable[[SimEndpoint, float], bytes | None]
"""What a radio on a link of its own sends at a time, given the simulated truth."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """What the link between the two does to a frame, the same in both directions."""

    loss: float = 0.0
    """Probability that a frame is lost."""
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Up to this much more delay, at random: frames overtake each other."""


class Notes:
    """The journal: everything the endpoint reports."""

    def __init__(self) -> None:
        self.texts: list[tuple[float, str]] = []
        self.records: list[tuple[float, str, Mapping[str, object]]] = []
        self.results: list[tuple[float, ReportResult]] = []

    def frame(self, data: bytes, now_s: float) -> None:
        """Frames are recorded by the loop."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        self.records.append((now_s, kind, fields))

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        del severity
        self.texts.append((now_s, text))

    def result(self, report: ReportResult, now_s: float) -> None:
        self.results.append((now_s, report))


@dataclass(frozen=True, slots=True)
class Sent:
    """A setpoint as decoded from the companion's bytes."""

    time_s: float
    position_enu_m: PositionEnu
    vehicle_enu_m: PositionEnu
    """Where the vehicle truly was."""


@dataclass(slots=True)
class Loop:
    """One flight; `run` lets invented time pass."""

    config: CompanionConfig = AUTO
    scenario: Scenario = field(default_factory=Scenario)
    seed: int = 1
    faults: LinkFaults = field(default_factory=LinkFaults)
    payload_source: PayloadSource | None = None
    """A radio on link 1 instead of the simulator's own."""
    payload_period_s: float = 0.1

    now_s: float = 0.0
    is_link_up: bool = True
    is_ranging_up: bool = True
    notes: Notes = field(default_factory=Notes)
    setpoints: list[Sent] = field(default_factory=list)
    true_positions: list[PositionEnu] = field(default_factory=list)
    commands: list[tuple[float, int]] = field(default_factory=list)
    """Commands the companion sent, by number."""
    companion_bytes: bytearray = field(default_factory=bytearray)
    vehicle_bytes: bytearray = field(default_factory=bytearray)
    companion: CompanionEndpoint = field(init=False)
    sim: SimEndpoint = field(init=False)
    _rng: np.random.Generator = field(init=False)
    _queue: list[tuple[float, int, bool, Chunk]] = field(default_factory=list)
    _count: int = 0
    _payload_due_s: float = 0.0
    _reader: MavCodec = field(default_factory=lambda: MavCodec(9, 9))
    _station: MavCodec = field(default_factory=lambda: MavCodec(255, 190))

    def __post_init__(self) -> None:
        links = 0 if self.payload_source is None else 1
        self.companion = build_endpoint(self.config, self.notes, links)
        self.sim = SimEndpoint(self.scenario, self.seed)
        self._rng = np.random.default_rng(self.seed)

    # Time

    def run(self, duration_s: float) -> None:
        """Let time pass."""
        until_s = self.now_s + duration_s
        while self._next_s() <= until_s:
            self.now_s = max(self.now_s, self._next_s())
            self._step()
        self.now_s = until_s

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> float:
        """Let time pass until a condition holds; how long it took."""
        started_s = self.now_s
        while not condition():
            assert self.now_s - started_s < limit_s, f"never held; {self.notes.texts[-5:]}"
            self.now_s = max(self.now_s, self._next_s())
            self._step()
        return self.now_s - started_s

    def _next_s(self) -> float:
        due = [self.companion.next_timer_s(), self.sim.next_timer_s()]
        if self._queue:
            due.append(self._queue[0][0])
        return max(0.0, min(due))

    def _step(self) -> None:
        self._deliver()
        if self.sim.next_timer_s() <= self.now_s:
            self.sim.handle_timer(self.now_s)
            self.true_positions.append(self.sim.vehicle.body.position_enu_m)
            self._measure()
        if self.companion.next_timer_s() <= self.now_s:
            self.companion.handle_timer(self.now_s)
        self._deliver()

    def _measure(self) -> None:
        if self.payload_source is None or self.now_s < self._payload_due_s - 1e-9:
            return
        self._payload_due_s = self.now_s + self.payload_period_s
        data = self.payload_source(self.sim, self.now_s)
        if data is not None and self.is_ranging_up:
            self.companion.receive(Chunk(1, data, ("127.0.0.1", 15000)), self.now_s)

    # The link

    def _deliver(self) -> None:
        self._collect()
        while self._queue and self._queue[0][0] <= self.now_s:
            _, _, is_to_companion, chunk = heapq.heappop(self._queue)
            receiver = self.companion if is_to_companion else self.sim
            receiver.receive(chunk, self.now_s)
            self._collect()

    def _collect(self) -> None:
        for chunk in self.sim.take_output():
            if COMPANION_PEER in chunk.except_peers or chunk.peer not in (None, COMPANION_PEER):
                continue  # forwarded to someone else
            self.vehicle_bytes += chunk.data
            is_payload = chunk.data[COMPONENT_BYTE] == payload.COMPONENT_ID
            if is_payload and (self.payload_source is not None or not self.is_ranging_up):
                continue
            self._post(chunk.data, is_to_companion=True)
        for chunk in self.companion.take_output():
            self.companion_bytes += chunk.data
            self._note_sent(chunk.data)
            self._post(chunk.data, is_to_companion=False)

    def _post(self, data: bytes, *, is_to_companion: bool) -> None:
        lost, late = self._rng.random(2).tolist()
        if not self.is_link_up or lost < self.faults.loss:
            return
        self._count += 1
        due_s = self.now_s + self.faults.delay_s + self.faults.jitter_s * late
        peer = VEHICLE_PEER if is_to_companion else COMPANION_PEER
        heapq.heappush(self._queue, (due_s, self._count, is_to_companion, Chunk(0, data, peer)))

    def _note_sent(self, data: bytes) -> None:
        for message in self._reader.decode(data):
            place: PositionEnu | None = None
            if isinstance(message, mavlink.MAVLink_set_position_target_local_ned_message):
                place = enu_from_ned((message.x, message.y, message.z))
            elif isinstance(message, mavlink.MAVLink_set_position_target_global_int_message):
                place = self.sim.vehicle.origin.enu_from_geodetic(
                    message.lat_int / 1e7, message.lon_int / 1e7, message.alt
                )
            elif isinstance(message, mavlink.MAVLink_command_long_message):
                self.commands.append((self.now_s, message.command))
            if place is not None:
                at = self.sim.vehicle.body.position_enu_m
                self.setpoints.append(Sent(self.now_s, place, at))

    # The people around

    def tell_vehicle(self, message: Message) -> None:
        """The ground station sends to the vehicle, over its own link."""
        self.sim.receive(Chunk(0, self._station.encode(message), ("127.0.0.1", 1)), self.now_s)

    def command(self, number: int, *params: float) -> None:
        """The ground station commands the vehicle."""
        padded = [*params, *[math.nan] * (7 - len(params))]
        self.tell_vehicle(mavlink.MAVLink_command_long_message(1, 1, number, 0, *padded))

    def choose(self, mode: FlightMode) -> None:
        """The operator switches the mode; the autopilot tells it at once."""
        is_armed = self.sim.vehicle.modes.is_armed
        self.command(
            mavlink.MAV_CMD_DO_SET_MODE, *set_mode_params(mode, self.autopilot, is_armed=is_armed)
        )
        number, wanted = mavlink.MAV_CMD_REQUEST_MESSAGE, float(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        ask = mavlink.MAVLink_command_long_message(1, 1, number, 0, wanted, *[0.0] * 6)
        self.sim.receive(Chunk(0, self._station.encode(ask), COMPANION_PEER), self.now_s)
        self._deliver()

    def grant(self) -> None:
        """The operator gives control back, through the autopilot that forwards it."""
        message = mavlink.MAVLink_command_long_message(1, 191, GRANT, 0, 1.0, *[0.0] * 6)
        self._post(self._station.encode(message), is_to_companion=True)

    def take_off(self, height_m: float = 10.0) -> None:
        """The operator arms and takes off, and the vehicle holds."""
        self.run(3.0)
        self.command(ARM, 1.0)
        ground_m = self.scenario.origin.altitude_m
        self.command(TAKEOFF, *[math.nan] * 6, ground_m + height_m)
        self.run_until(lambda: self.mode is FlightMode.HOLD, 60.0)

    def reboot(self) -> None:
        """The simulator starts anew; its clock with it."""
        self.sim = SimEndpoint(self.scenario, self.seed, started_s=self.now_s)

    # What became of it

    @property
    def autopilot(self) -> Autopilot:
        """Which one is simulated."""
        is_px4 = self.scenario.autopilot.flavour == "px4"
        return Autopilot.PX4 if is_px4 else Autopilot.ARDUPILOT

    @property
    def phase(self) -> Phase:
        return self.companion.session.phase

    @property
    def mode(self) -> FlightMode:
        """The mode that the vehicle is truly in."""
        return self.sim.vehicle.modes.mode

    @property
    def error_m(self) -> float:
        """Distance of the estimate from the emitter; infinite without an estimate."""
        estimate = self.companion.session.estimate
        if estimate is None:
            return math.inf
        return math.dist(estimate.position_enu_m, self.scenario.emitter.position_enu_m)

    def said(self, part: str) -> bool:
        """Whether a text to the operator contained something."""
        return any(part in text for _, text in self.notes.texts)

    def setpoints_since(self, time_s: float) -> list[Sent]:
        return [sent for sent in self.setpoints if sent.time_s > time_s]


def outside(places: list[PositionEnu], east_north_max_m: float) -> list[PositionEnu]:
    """The places outside the square fence of this half-width."""
    return [p for p in places if max(abs(p[0]), abs(p[1])) > east_north_max_m]


def horizontal(place: PositionEnu) -> Point:
    return place[:2]
