"""Datagrams that are read late count as having arrived when they did."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable

import pytest

from companion.io.links.link import MAX_READS
from companion.io.links.transports import UdpBind
from companion.io.shell import Clock, Shell
from companion.mav.endpoint import Chunk
from tests.e2e.shell_helpers import EchoEndpoint

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux stamps datagrams")
PERIOD_S = 0.5
"""Period of the endpoint's timer."""


class Listener(EchoEndpoint):
    """Ticks every half second, and calls `at_tick` with the number of each."""

    def __init__(self, at_tick: Callable[[int], None]) -> None:
        super().__init__()
        self.arrivals: list[tuple[int, bytes, float]] = []
        """Link, data and time of everything received."""
        self.handed_s: list[float] = []
        """Monotonic time at which it was handed over."""
        self.times_s: list[float] = []
        """Every time that it was given."""
        self._at_tick = at_tick

    def receive(self, chunk: Chunk, now_s: float) -> None:
        self.arrivals.append((chunk.link, chunk.data, now_s))
        self.handed_s.append(time.monotonic())
        self.times_s.append(now_s)

    def handle_timer(self, now_s: float) -> None:
        super().handle_timer(now_s)
        self.times_s.append(now_s)
        self._due_s = now_s + PERIOD_S
        self._at_tick(len(self.ticks_s))


class Rig:
    """A shell with two links, and a sender to each."""

    def __init__(self, at_tick: Callable[[Rig, int], None], speed: float = 1.0) -> None:
        self.endpoint = Listener(lambda number: at_tick(self, number))
        links = [UdpBind("127.0.0.1", 0), UdpBind("127.0.0.1", 0)]
        self.clock = Clock(speed)
        self.shell = Shell(self.endpoint, links, self.clock, may_gather=lambda: True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def run(self) -> Listener:
        with self._socket:
            self.shell.run_blocking()
        return self.endpoint

    def send(self, link: int, data: bytes) -> None:
        bound = self.shell.links[link]
        self._socket.sendto(data, bound.local_address)  # type: ignore[attr-defined]


def test_what_waited_for_the_timer_keeps_its_time_and_its_order_across_links() -> None:
    sent_s: list[float] = []

    def at_tick(rig: Rig, number: int) -> None:
        if number == 1:
            for link, data in ((1, b"a"), (0, b"b"), (1, b"c")):
                sent_s.append(rig.clock.now_s())
                rig.send(link, data)
                time.sleep(0.02)
        if number == 2:
            rig.shell.request_stop()

    heard = Rig(at_tick).run()
    assert [(link, data) for link, data, _ in heard.arrivals] == [(1, b"a"), (0, b"b"), (1, b"c")]
    for at_s, (_, _, heard_s) in zip(sent_s, heard.arrivals, strict=True):
        assert heard_s == pytest.approx(at_s, abs=0.015)
    assert heard.times_s == sorted(heard.times_s)
    assert heard.ticks_s[1] > heard.arrivals[-1][2]


def test_a_clock_that_is_set_meanwhile_moves_no_arrival_out_of_the_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The stamps are from the wall clock, which NTP may set by hours in a flight."""
    real, step_s = time.time, [0.0]
    monkeypatch.setattr("companion.io.links.udp.time.time", lambda: real() + step_s[0])

    def at_tick(rig: Rig, number: int) -> None:
        if number in (1, 2):
            step_s[0] = 3600.0 if number == 1 else -3600.0
            rig.send(0, b"x")
        if number == 3:
            rig.shell.request_stop()

    heard = Rig(at_tick).run()
    first, second = (heard_s for _, _, heard_s in heard.arrivals)
    assert heard.ticks_s[0] <= first <= heard.ticks_s[1] <= second <= heard.ticks_s[2]
    assert heard.times_s == sorted(heard.times_s)


def test_a_flood_waits_for_no_timer_after_the_first() -> None:
    """Its buffer would overflow, and lose the vehicle's frames among the others."""
    ticked_s: list[float] = []

    def at_tick(rig: Rig, number: int) -> None:
        ticked_s.append(time.monotonic())
        if number == 1:
            for _ in range(3 * MAX_READS):
                rig.send(0, b"x")
        if number == 2:
            rig.send(0, b"y")
        if number == 3:
            rig.shell.request_stop()

    heard = Rig(at_tick).run()
    assert [data for _, data, _ in heard.arrivals] == [*3 * MAX_READS * [b"x"], b"y"]
    assert heard.handed_s[MAX_READS - 1] < ticked_s[1] < heard.handed_s[MAX_READS]
    assert heard.handed_s[-1] < ticked_s[2] - 0.5 * PERIOD_S
