"""Link with faults and an attacker, in memory, and between real processes on UDP.

Theory of operation. Every fault gets effects with a generator of their own: one per direction for a
fault of the link, one for all frames of the vehicle and its radio for a fault of content. A
datagram passes those that act when it is sent, in a fixed order: first its content, then what is
lost, damaged, copied, late. A radio on a link of its own is touched by faults of content only.

An attacker on the same network hears everything. It has no key: on a signed link its own frames
carry a signature with a key of its own, none at all, or one that was used before.

Everything is in memory on invented time, and repeatable from its seed. Faults of link and content
go to the flight's `FaultyLink`; those of vehicle and pilot become incidents of the simulator; those
of the process kill, start and suspend the companion; attackers send from an address of their own,
or, on a signed link, from the vehicle's.

`sim-link proxy` puts faults between a real vehicle or simulator and a real companion on UDP.

    vehicle  <-->  its link | faults | the companion's link  <-->  companion

Theory of operation of the proxy. Either side stands for the other one. Every datagram passes a
`FaultyLink`, the same as in memory, and what is late waits in a queue; attackers send to the
companion from a socket of their own. What the system refuses to send is counted and lost, as on any
network.
"""

from __future__ import annotations

import argparse
import heapq
from collections import deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from companion.arguments import number_in
from companion.config.loader import load_yaml
from companion.domain import FlightMode
from companion.errors import ConfigError, decoding_problem
from companion.io.links.transports import UdpBind, UdpConnect, udp_address
from companion.io.shell import Clock, Shell
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec, frame_crc, message_id, without_signature
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk, OneShotEndpoint
from companion.mav.signing import MAX_HEARD, Signing, SigningKey
from sim_link.autopilot.incidents import (
    FaultRecord,
    IncidentRecord,
    OtherVehicle,
    PilotMode,
    VehicleFault,
)
from sim_link.autopilot.other_senders import setpoint_at
from sim_link.lab.faults import fault_effects
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.lockstep import VEHICLE_PEER, Flight, Operator
from sim_link.lab.observer import Delivery, Frame, Lane, Observer

LINK_LANES = {
    "both": (Lane.TO_COMPANION, Lane.TO_VEHICLE),
    "to_companion": (Lane.TO_COMPANION,),
    "to_vehicle": (Lane.TO_VEHICLE,),
}
CONTENT_LANES = (Lane.TO_COMPANION, Lane.RANGING)
LINK_RANKS = {kind: rank for rank, kind in enumerate(fault_effects.LINK_EFFECTS, 1)}
"""The order in which faults of the link act, after those of content."""


class FaultyLink:
    """A wire with faults; an `observer.Wire`.

    Faults that are of neither link nor content are ignored. All random draws follow from the seed.
    With a key, changed frames are signed again where they are signed.
    """

    def __init__(self, schedule: faults.Schedule, seed: int, key: SigningKey | None = None) -> None:
        self._seed = seed
        self._key = key
        self._count = 0
        self._effects: dict[Lane, list[fault_effects.FaultEffect[Any]]] = {
            lane: [] for lane in Lane
        }
        for fault in schedule.faults:
            self.add(fault, 0.0)

    def add(self, fault: FaultRecord, began_s: float) -> None:
        """Add a fault, its times counted from `began_s`."""
        self._count += 1
        kind, seed = type(fault), (self._seed, self._count)
        if isinstance(fault, faults.ContentFault):
            rng = np.random.default_rng(seed)
            make_effect = fault_effects.CONTENT_EFFECTS.get(kind, fault_effects.ContentEffect)
            effect = make_effect(fault, rng, began_s, self._key)
            for lane in CONTENT_LANES:
                self._effects[lane].append(effect)
        if isinstance(fault, faults.LinkFault):
            for lane in LINK_LANES[fault.direction]:
                rng = np.random.default_rng((*seed, LINK_LANES["both"].index(lane)))
                effect = fault_effects.LINK_EFFECTS[kind](fault, rng, began_s)
                self._effects[lane].append(effect)
        for effects in self._effects.values():
            effects.sort(key=lambda effect: LINK_RANKS.get(type(effect.fault), 0))

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        """Return the deliveries of a datagram that is sent at `now_s`."""
        deliveries: list[Delivery] = [(now_s, data)]
        for effect in self._effects[lane]:
            if effect.start_s <= now_s < effect.end_s:
                deliveries = effect.apply(deliveries, now_s)
            else:
                effect.watch(data)
        return deliveries


MEMORY = 4000
"""Frames that are kept for a replay."""
WRONG_KEY = SigningKey(bytes(range(1, 33)))
SYSTEM_BYTE = 5
FOREIGN_SYSTEM = 77


class Attacker:
    """Attacker that forges, alters and replays frames, with no key but its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._heard: deque[bytes] = deque(maxlen=MEMORY)

    def overhear(self, frame: bytes) -> None:
        """Remember the vehicle's messages."""
        self._heard.append(frame)

    def next(self, fault: faults.SecurityFault) -> bytes | None:
        """Return the next frame of an attack, or None while nothing was heard yet."""
        if not self._heard:
            return None
        model = self._heard[int(self._rng.integers(len(self._heard)))]
        match fault:
            case faults.ReplayedFrames():
                return model
            case faults.UnsignedFrames():
                return self._lie(model)
            case faults.ForeignFrames():
                bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
                head = bare[:SYSTEM_BYTE] + bytes((FOREIGN_SYSTEM,)) + bare[SYSTEM_BYTE + 1 : -2]
                crc = frame_crc(head, CRC_EXTRA_BY_ID[message_id(bare)])
                return head + crc.to_bytes(2, "little")
            case faults.ForgedFrames():  # with a timestamp from the past to the end of time
                lie = self._lie(model)
                signing = Signing(WRONG_KEY, int(self._rng.integers(0, MAX_HEARD)))
                return signing.sign(lie, 0, CRC_EXTRA_BY_ID[message_id(lie)])
        return None

    def _lie(self, model: bytes) -> bytes:
        """Return the same kind of frame, unsigned, with other content."""
        bare = without_signature(model, CRC_EXTRA_BY_ID.get(message_id(model)))
        return fault_effects.rewrite_frame(bare, self._change, None)

    def _change(self, message: Any) -> None:
        match message:
            case mavlink.MAVLink_heartbeat_message():
                message.custom_mode = int(self._rng.integers(0, 10)) << 16
                message.base_mode = int(self._rng.integers(0, 256))
            case mavlink.MAVLink_local_position_ned_message():
                message.x += float(self._rng.normal(0.0, 50.0))
                message.y += float(self._rng.normal(0.0, 50.0))
            case (
                mavlink.MAVLink_home_position_message()
                | mavlink.MAVLink_gps_global_origin_message()
            ):
                message.latitude += 10_000


ATTACKER_PEER: Address = ("127.0.0.1", 16000)
SENDER_PEER: Address = ("127.0.0.1", 17000)
ATTACK_PERIOD_S = 0.02
"""Time between two groups of an attacker's frames."""


class Injector(Observer):
    """Applies a schedule to a flight; attackers that are spoofing have the vehicle's address."""

    def __init__(
        self, flight: Flight, link: FaultyLink, operator: Operator, *, is_spoofing: bool = False
    ) -> None:
        self._flight = flight
        self._link = link
        self._operator = operator
        self._attacker = Attacker(np.random.default_rng((flight.seed, 0xA77)))
        self._attack_peer = VEHICLE_PEER if is_spoofing else ATTACKER_PEER
        self._other = MavCodec(254, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        flight.observers.append(self)

    def inject(self, schedule: faults.Schedule) -> None:
        """Start the schedule now; faults that are not on the link yet are put there too."""
        for fault in schedule.faults:
            self.add(fault)

    def add(self, fault: FaultRecord) -> None:
        """Apply one fault, its times counted from now."""
        began_s = self._flight.now_s
        self._link.add(fault, began_s)
        start_s = began_s + fault.start_s
        match fault:
            case OtherVehicle():
                end_s = began_s + fault.end_s
                self._flight.at(start_s, partial(self._flight.bring_other, fault, end_s))
            case VehicleFault() | faults.ProcessFault():
                self._flight.at(start_s, partial(self._happen, fault))
            case faults.SecurityFault():
                self._flight.at(start_s, partial(self._attack, fault, began_s + fault.end_s, 0.0))

    def vehicle_sent(self, frame: Frame) -> None:
        """Pass a frame of the vehicle on to the attacker, who may record it."""
        self._attacker.overhear(frame.data)

    def _happen(self, fault: VehicleFault | faults.ProcessFault) -> None:
        flight = self._flight
        match fault:
            case faults.Disarm():
                self._operator.disarm()
            case faults.ModeFlap():
                self._flap(fault, flight.now_s + fault.duration_s, is_ours=True)
            case faults.SecondSender():
                self._send_other(fault, flight.now_s + fault.duration_s)
            case IncidentRecord():
                flight.apply_incident(fault)
            case faults.CompanionKilled():
                flight.kill_companion()
                flight.at(flight.now_s + fault.down_s, self._start_again)
            case faults.CompanionStalled():
                flight.suspend_companion(fault.duration_s)
            case faults.CompanionTerminated():
                flight.stop_companion()

    def _flap(self, fault: faults.ModeFlap, end_s: float, *, is_ours: bool) -> None:
        now_s = self._flight.now_s
        mode = fault.mode if is_ours else FlightMode.OFFBOARD
        self._flight.apply_incident(PilotMode(mode=mode))
        if now_s < end_s or is_ours:
            next_s = now_s + 0.5 * fault.period_s
            self._flight.at(next_s, partial(self._flap, fault, end_s, is_ours=not is_ours))

    def _send_other(self, fault: faults.SecondSender, end_s: float) -> None:
        flight = self._flight
        position = (fault.east_m, fault.north_m, fault.up_m)
        message = setpoint_at(position, flight.scenario.system_id, flight.now_s)
        flight.sim.receive(Chunk(0, self._other.encode(message), SENDER_PEER), flight.now_s)
        next_s = flight.now_s + 1.0 / fault.rate_hz
        if next_s < end_s:
            flight.at(next_s, partial(self._send_other, fault, end_s))

    def _start_again(self) -> None:
        if not self._flight.is_companion_up:
            self._flight.start_companion()

    def _attack(self, fault: faults.SecurityFault, end_s: float, owed: float) -> None:
        flight = self._flight
        owed += fault.rate_hz * ATTACK_PERIOD_S
        for _ in range(int(owed)):
            data = self._attacker.next(fault)
            if data is not None:
                flight.attack(Chunk(0, data, self._attack_peer))
        next_s = flight.now_s + ATTACK_PERIOD_S
        if next_s < end_s:
            flight.at(next_s, partial(self._attack, fault, end_s, owed - int(owed)))


VEHICLE, COMPANION, ATTACK = range(3)
"""Links: the one the vehicle sends to, and two to the companion, each with its own address."""
MAX_ATTACKS_AT_ONCE = 1000


@dataclass(slots=True)
class Counters:
    """Datagrams that passed, were lost to a fault, or were refused by the system."""

    to_companion: int = 0
    to_vehicle: int = 0
    lost: int = 0
    refused: int = 0
    attacks: int = 0


class FaultProxy(OneShotEndpoint):
    """Carries datagrams between its links, with faults from the start on."""

    def __init__(
        self, schedule: faults.Schedule, seed: int, duration_s: float | None = None
    ) -> None:
        super().__init__(duration_s, ATTACK_PERIOD_S)
        self.counters = Counters()
        self._vehicle: Address | None = None
        self._link = FaultyLink(schedule, seed)
        self._attacks = [f for f in schedule.faults if isinstance(f, faults.SecurityFault)]
        self._attacker = Attacker(np.random.default_rng((seed, 0xA77)))
        self._owed = 0.0
        self._queue: list[tuple[float, int, bytes, Lane]] = []
        self._count = 0

    def add(self, fault: FaultRecord, now_s: float) -> None:
        """Add a fault, its times counted from now."""
        self._link.add(fault, now_s)

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Let a datagram of vehicle or companion pass the faults."""
        lane = Lane.TO_VEHICLE
        if chunk.link == VEHICLE:
            lane, self._vehicle = Lane.TO_COMPANION, chunk.peer
            self._attacker.overhear(chunk.data)
        elif chunk.link == ATTACK:
            return
        arriving = self._link.carry(chunk.data, lane, now_s)
        self.counters.lost += not arriving
        for due_s, data in arriving:
            self._count += 1
            heapq.heappush(self._queue, (due_s, self._count, data, lane))

    def next_timer_s(self) -> float:
        """Return the time of the next delivery or attack."""
        return min(self._next_s, self._queue[0][0]) if self._queue else self._next_s

    def handle_timer(self, now_s: float) -> None:
        """Deliver due datagrams, and attack."""
        elapsed_s = now_s - self.now_s
        super().handle_timer(now_s)
        while self._queue and self._queue[0][0] <= now_s:
            _, _, data, lane = heapq.heappop(self._queue)
            if lane is Lane.TO_COMPANION:
                self.counters.to_companion += 1
                self._output.append(Chunk(COMPANION, data))
            elif self._vehicle is not None:
                self.counters.to_vehicle += 1
                self._output.append(Chunk(VEHICLE, data, self._vehicle))
        for fault in (each for each in self._attacks if each.is_active(now_s)):
            self._owed = min(self._owed + fault.rate_hz * elapsed_s, MAX_ATTACKS_AT_ONCE)
            while self._owed >= 1.0:
                self._owed -= 1.0
                attack = self._attacker.next(fault)
                if attack is not None:
                    self.counters.attacks += 1
                    self._output.append(Chunk(ATTACK, attack))


DESCRIPTION = """
Carry MAVLink between a vehicle and a companion over UDP, with faults: the vehicle sends to
--listen as if that were the companion, and the companion hears the proxy as if it were the vehicle.
"""
EPILOG = """
examples:
  sim-link --send-to 127.0.0.1:14560          the vehicle
  companion --connect udp:127.0.0.1:14550     the companion
  sim-link proxy --fault '{kind: link_loss, share: 0.3}'
  sim-link proxy --faults FILE.yaml           faults: [{kind: link_blackout, start_s: 20}]
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's own arguments."""
    parser.add_argument("--listen", default="127.0.0.1:14560", metavar="HOST:PORT")
    parser.add_argument("--companion", default="127.0.0.1:14550", metavar="HOST:PORT")
    parser.add_argument("--fault", action="append", default=[], metavar="MAPPING")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="faults as YAML")
    parser.add_argument("--seed", type=number_in(0, kind=int), default=1)
    above_zero = number_in(0.0, is_open=True)
    parser.add_argument("--for", dest="for_s", type=above_zero, metavar="SECONDS", help="then end")


def run(arguments: argparse.Namespace) -> int:
    """Carry datagrams until asked to stop; raise ConfigError or LinkError for bad input."""
    schedule = _schedule(arguments.fault, arguments.faults)
    listen = udp_address("--listen", arguments.listen)
    companion = udp_address("--companion", arguments.companion)
    proxy = FaultProxy(schedule, arguments.seed, arguments.for_s)
    to_companion = UdpConnect(*companion)
    shell = Shell(proxy, [UdpBind(*listen), to_companion, to_companion], Clock())
    host, port = listen
    print(f"proxy: vehicle to {host}:{port}, companion {arguments.companion}", flush=True)
    shell.run_blocking()
    proxy.counters.refused = sum(link.counters.send_errors for link in shell.links)
    print(f"proxy: {proxy.counters}", flush=True)
    return 0


def _schedule(texts: list[str], path: Path | None) -> faults.Schedule:
    found = [] if path is None else list(load_yaml(path, faults.Schedule).faults)
    for text in texts:
        try:
            found.append(faults.fault_from(yaml.safe_load(text)))
        except (yaml.YAMLError, msgspec.ValidationError) as error:
            raise ConfigError(f"--fault {text!r}: {decoding_problem(error)}") from None
    for fault in found:
        if not isinstance(fault, faults.LinkFault | faults.ContentFault | faults.SecurityFault):
            kind = fault.__struct_config__.tag
            raise ConfigError(f"{kind} is a fault of a vehicle or a process, not of a link")
    return faults.Schedule(faults=tuple(found))
