"""One vehicle's link shared by companion, operator and radio, with faults on the companion's way.

Theory of operation. The hub is a router: what the vehicle says goes to all of its clients, what a
client says to the vehicle and to the other clients. It knows nothing about who the vehicle is; it
answers to wherever that was heard. Between vehicle and companion lies a wire, which may be a
`FaultyLink`: the operator's link is never touched by faults. A timer drives the mission.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

from companion.mav.codec import MavCodec
from companion.mav.endpoint import Address, Chunk
from sim_link.lockstep.wire import Lane, Wire

VEHICLE, COMPANION, OPERATOR, RADIO = range(4)
"""The hub's links."""
PERIOD_S = 0.1
"""Between two looks at the mission."""


class Hub:
    """Implements `companion.mav.endpoint.Endpoint`.

    Args:
        wire: What lies between vehicle and companion.
        watch: Told of every frame with the link it came from and the time.
        tick: Called every 0.1 s with the time; the mission.
        stop: Called when an end is asked for; the mission then calls `finish`.
        has_radio: Whether there is a radio beside the vehicle.
        delivered: Told of every frame that goes to the companion, and when.
    """

    def __init__(
        self,
        wire: Wire,
        watch: Callable[[int, bytes, float], None],
        tick: Callable[[float], None],
        stop: Callable[[float], None],
        *,
        has_radio: bool = False,
        delivered: Callable[[bytes, float], None] | None = None,
    ) -> None:
        self._wire = wire
        self._watch = watch
        self._tick = tick
        self._stop = stop
        self._delivered = delivered
        self._clients = (COMPANION, OPERATOR, RADIO) if has_radio else (COMPANION, OPERATOR)
        self._splitters = [MavCodec(0, 0) for _ in range(4)]
        self._peers: dict[int, Address] = {}
        self._late: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        self._due_s = 0.0
        self._output: list[Chunk] = []
        self._is_finished = False

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Route what arrived, frame by frame."""
        if chunk.peer is not None:
            self._peers[chunk.link] = chunk.peer
        splitter = self._splitters[chunk.link]
        for frame in splitter.split(chunk.data, is_datagram=chunk.is_datagram):
            self._watch(chunk.link, frame, now_s)
            for link in (VEHICLE, *self._clients):
                if link != chunk.link:
                    self._route(frame, chunk.link, link, now_s)

    def _route(self, frame: bytes, source: int, target: int, now_s: float) -> None:
        if target == COMPANION:
            lane = Lane.TO_COMPANION
        elif source == COMPANION and target == VEHICLE:
            lane = Lane.TO_VEHICLE
        else:
            self._send(target, frame, now_s)
            return
        for due_s, data in self._wire.carry(frame, lane, now_s):
            if due_s <= now_s:
                self._send(target, data, now_s)
            else:
                self._count += 1
                heapq.heappush(self._late, (due_s, self._count, target, data))

    def _send(self, link: int, data: bytes, now_s: float) -> None:
        if link == COMPANION and self._delivered is not None:
            self._delivered(data, now_s)
        self._output.append(Chunk(link, data, self._peers.get(link)))

    def handle_timer(self, now_s: float) -> None:
        """Deliver what was late, and look at the mission when that is due."""
        while self._late and self._late[0][0] <= now_s:
            _, _, link, data = heapq.heappop(self._late)
            self._send(link, data, now_s)
        if now_s >= self._due_s:
            self._due_s = max(self._due_s + PERIOD_S, now_s)
            self._tick(now_s)

    def next_timer_s(self) -> float:
        """When something is due."""
        return min(self._due_s, self._late[0][0]) if self._late else self._due_s

    def take_output(self) -> list[Chunk]:
        """What is to be sent; taken once."""
        output, self._output = self._output, []
        return output

    def request_stop(self, now_s: float) -> None:
        """Ask the mission to end."""
        self._stop(now_s)

    def finish(self) -> None:
        """End at once."""
        self._is_finished = True

    @property
    def is_finished(self) -> bool:
        """Whether the mission is over."""
        return self._is_finished
