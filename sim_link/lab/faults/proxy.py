"""`sim-link proxy`: faults between a real vehicle or simulator and a real companion on UDP.

    vehicle  <-->  vehicle_side | faults | companion_side  <-->  companion

Theory of operation. Either side stands for the other one. Every datagram passes a `FaultyLink`, the
same as in memory, and what is late waits in a queue; attackers send to the companion from a socket
of their own. What the system refuses to send is counted and gone, as on any network.
"""

from __future__ import annotations

import argparse
import heapq
import math
import selectors
import signal
import socket
import time
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import yaml

from companion.arguments import number_in
from companion.config.loader import load_yaml
from companion.errors import ConfigError, LinkError
from companion.io.links.transports import udp_address
from companion.mav.endpoint import Address
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.faulty_link import Attacker, FaultyLink
from sim_link.lab.lockstep.observer import Lane

MAX_DATAGRAM = 65_535
READS = 200
"""Datagrams that are read at most before the queue is looked at again."""
LONGEST_WAIT_S = 0.5
BUFFER_BYTES = 1 << 21
ATTACK_PERIOD_S = 0.02
MOST_ATTACKS_AT_ONCE = 1000


@dataclass(slots=True)
class Counters:
    """Datagrams that passed, were lost to a fault, or were refused by the system."""

    to_companion: int = 0
    to_vehicle: int = 0
    lost: int = 0
    refused: int = 0
    attacks: int = 0


class FaultProxy(AbstractContextManager["FaultProxy"]):
    """Two sockets with faults between them from the start on; `LinkError`: no such address."""

    def __init__(
        self, vehicle_side: Address, companion: Address, schedule: faults.Schedule, seed: int
    ) -> None:
        self.counters = Counters()
        self._companion = companion
        self._vehicle: Address | None = None
        self._vehicle_side = _bound(vehicle_side)
        self._companion_side = _bound((companion[0], 0))
        self._attack_side = _bound((companion[0], 0))
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._vehicle_side, selectors.EVENT_READ, Lane.TO_COMPANION)
        self._selector.register(self._companion_side, selectors.EVENT_READ, Lane.TO_VEHICLE)
        self._began_s = time.monotonic()
        self._link = FaultyLink(schedule, seed)
        self._attacks = [f for f in schedule.faults if isinstance(f, faults.SecurityFault)]
        self._attacker = Attacker(np.random.default_rng((seed, 0xA77)))
        self._attacked_s = 0.0
        self._owed = 0.0
        self._queue: list[tuple[float, int, bytes, Lane]] = []
        self._count = 0

    @property
    def vehicle_side(self) -> Address:
        """Address to which the vehicle has to send."""
        host, port = self._vehicle_side.getsockname()
        return str(host), int(port)

    @property
    def companion_side(self) -> Address:
        """Address that the companion hears."""
        host, port = self._companion_side.getsockname()
        return str(host), int(port)

    def add(self, fault: FaultRecord) -> None:
        """Add a fault, its times counted from now."""
        self._link.add(fault, self._now_s())

    def run(self, duration_s: float) -> None:
        """Carry datagrams for a while."""
        until_s = self._now_s() + duration_s
        while (now_s := self._now_s()) < until_s:
            self._wait(min(until_s - now_s, LONGEST_WAIT_S))
            self._attack()
            self._deliver()

    def close(self) -> None:
        """Close everything; what waits is lost."""
        self._selector.close()
        for each in (self._vehicle_side, self._companion_side, self._attack_side):
            each.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _now_s(self) -> float:
        return time.monotonic() - self._began_s

    def _wait(self, longest_s: float) -> None:
        if self._queue:
            longest_s = min(longest_s, max(0.0, self._queue[0][0] - self._now_s()))
        if self._attacks:
            longest_s = min(longest_s, ATTACK_PERIOD_S)
        for key, _ in self._selector.select(longest_s):
            assert isinstance(key.fileobj, socket.socket)
            self._read(key.fileobj, key.data)

    def _read(self, source: socket.socket, lane: Lane) -> None:
        for _ in range(READS):
            try:
                data, peer = source.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # an earlier datagram had no receiver
                continue
            now_s = self._now_s()
            if lane is Lane.TO_COMPANION:
                self._vehicle = peer
                self._attacker.overhear(data)
            elif peer != self._companion:
                continue
            arriving = self._link.carry(data, lane, now_s)
            self.counters.lost += not arriving
            for due_s, each in arriving:
                self._count += 1
                heapq.heappush(self._queue, (due_s, self._count, each, lane))

    def _deliver(self) -> None:
        now_s = self._now_s()
        while self._queue and self._queue[0][0] <= now_s:
            _, _, data, lane = heapq.heappop(self._queue)
            if lane is Lane.TO_COMPANION:
                self.counters.to_companion += 1
                self._send(self._companion_side, data, self._companion)
            elif self._vehicle is not None:
                self.counters.to_vehicle += 1
                self._send(self._vehicle_side, data, self._vehicle)

    def _attack(self) -> None:
        now_s = self._now_s()
        elapsed_s, self._attacked_s = now_s - self._attacked_s, now_s
        for fault in (each for each in self._attacks if each.is_active(now_s)):
            self._owed = min(self._owed + fault.rate_hz * elapsed_s, MOST_ATTACKS_AT_ONCE)
            while self._owed >= 1.0:
                self._owed -= 1.0
                data = self._attacker.next(fault)
                if data is not None:
                    self.counters.attacks += 1
                    self._send(self._attack_side, data, self._companion)

    def _send(self, source: socket.socket, data: bytes, peer: Address) -> None:
        try:
            source.sendto(data, peer)
        except OSError:
            self.counters.refused += 1


def _bound(address: Address) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.setblocking(False)
    with suppress(OSError):
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    try:
        bound.bind(address)
    except OSError as error:
        bound.close()
        raise LinkError(f"udp {address[0]}:{address[1]}: {error.strerror}") from error
    return bound


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
    """Carry datagrams until asked to stop; a ConfigError or LinkError for what is bad input."""
    schedule = _schedule(arguments.fault, arguments.faults)
    listen = udp_address("--listen", arguments.listen)
    companion = udp_address("--companion", arguments.companion)
    with FaultProxy(listen, companion, schedule, arguments.seed) as proxy:
        host, port = proxy.vehicle_side
        print(f"proxy: vehicle to {host}:{port}, companion {arguments.companion}", flush=True)
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            proxy.run(arguments.for_s or math.inf)
        except KeyboardInterrupt:
            pass
        finally:
            signal.signal(signal.SIGTERM, before)
        print(f"proxy: {proxy.counters}", flush=True)
    return 0


def _schedule(texts: list[str], path: Path | None) -> faults.Schedule:
    found = [] if path is None else list(load_yaml(path, faults.Schedule).faults)
    for text in texts:
        try:
            found.append(faults.fault_from(yaml.safe_load(text)))
        except (yaml.YAMLError, msgspec.ValidationError) as error:
            problem = " ".join(str(error).split())
            raise ConfigError(f"--fault {text!r}: {problem}") from None
    for fault in found:
        if not isinstance(fault, faults.LinkFault | faults.ContentFault | faults.SecurityFault):
            kind = fault.__struct_config__.tag
            raise ConfigError(f"{kind} happens to a vehicle or a process, not to a link")
    return faults.Schedule(faults=tuple(found))
