"""`sim-link proxy`: faults between a real vehicle or simulator and a real companion on UDP.

    vehicle  <-->  its link | faults | the companion's link  <-->  companion

Theory of operation. Either side stands for the other one. Every datagram passes a `FaultyLink`, the
same as in memory, and what is late waits in a queue; attackers send to the companion from a socket
of their own. What the system refuses to send is counted and gone, as on any network.
"""

from __future__ import annotations

import argparse
import heapq
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import yaml

from companion.arguments import number_in
from companion.config.loader import load_yaml
from companion.errors import ConfigError
from companion.io.links.transports import UdpBind, UdpConnect, udp_address
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Address, Chunk, OneShotEndpoint
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.faulty_link import Attacker, FaultyLink
from sim_link.lab.lockstep.observer import Lane

VEHICLE, COMPANION, ATTACK = range(3)
"""Links: where the vehicle sends to, and two to the companion, each with an address of its own."""
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
        """Deliver what is due, and attack."""
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
            self._owed = min(self._owed + fault.rate_hz * elapsed_s, MOST_ATTACKS_AT_ONCE)
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
    """Carry datagrams until asked to stop; a ConfigError or LinkError for what is bad input."""
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
            problem = " ".join(str(error).split())
            raise ConfigError(f"--fault {text!r}: {problem}") from None
    for fault in found:
        if not isinstance(fault, faults.LinkFault | faults.ContentFault | faults.SecurityFault):
            kind = fault.__struct_config__.tag
            raise ConfigError(f"{kind} happens to a vehicle or a process, not to a link")
    return faults.Schedule(faults=tuple(found))
