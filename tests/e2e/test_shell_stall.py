"""The shell after a stall: what arrived during it is taken in before it acts."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable

import pytest

from companion.io.links.transports import UdpBind
from companion.io.shell import Clock, Shell
from tests.e2e.shell_helpers import TIMEOUT_S, EchoEndpoint, drive, heartbeat, port_of, until

SLEEP_S = 100.0
"""No machine is so busy that it stalls for half as long by itself."""


class SteppedClock(Clock):
    """Goes on like any other, and may step ahead."""

    def __init__(self) -> None:
        super().__init__()
        self.ahead_s = 0.0

    def now_s(self) -> float:
        return super().now_s() + self.ahead_s


class Dozing(EchoEndpoint):
    """Falls asleep once, in a tick, while the world goes on."""

    def __init__(self, meanwhile: Callable[[], None], clock: SteppedClock) -> None:
        super().__init__()
        self._meanwhile = meanwhile
        self._clock = clock
        self.heard_before_next_tick: int | None = None
        self.slept_until_s = 0.0

    def handle_timer(self, now_s: float) -> None:
        super().handle_timer(now_s)
        if len(self.ticks_s) == 5:
            self._meanwhile()
            self._clock.ahead_s += SLEEP_S
            self.slept_until_s = self._clock.now_s()
        elif len(self.ticks_s) == 6:
            self.heard_before_next_tick = len(self.marks)


def test_after_a_stall_the_past_is_taken_in_before_the_first_tick(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.io.shell.STALL_S", 0.5 * SLEEP_S)
    monkeypatch.setattr("companion.io.shell.CATCH_UP_S", TIMEOUT_S)  # the next test is about it

    def meanwhile() -> None:
        for number in range(150):
            peer.sendto(heartbeat(number), ("127.0.0.1", port_of(shells[0])))

    clock = SteppedClock()
    endpoint, shells = Dozing(meanwhile, clock), list[Shell]()

    async def scene(shell: Shell) -> None:
        shells.append(shell)
        await until(lambda: endpoint.heard_before_next_tick is not None)

    shell = drive(endpoint, [UdpBind("127.0.0.1", 0)], scene, clock)
    assert endpoint.heard_before_next_tick == 150
    assert shell.timing.stalls == 1
    assert shell.timing.worst_late_s >= SLEEP_S - 0.02
    assert shell.timing.late >= 1


def test_after_a_stall_a_flood_puts_the_first_tick_off_for_a_moment_only() -> None:
    stopped = threading.Event()
    threads: list[threading.Thread] = []

    def flood() -> None:
        frame = heartbeat(7)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stopped.is_set():
                sender.sendto(frame, ("127.0.0.1", port_of(shells[0])))

    def meanwhile() -> None:
        threads.append(threading.Thread(target=flood))
        threads[0].start()

    clock = SteppedClock()
    endpoint, shells = Dozing(meanwhile, clock), list[Shell]()

    async def scene(shell: Shell) -> None:
        shells.append(shell)
        try:
            await until(lambda: endpoint.heard_before_next_tick is not None)
        finally:  # the flood went on until then
            stopped.set()
            threads[0].join()

    shell = drive(endpoint, [UdpBind("127.0.0.1", 0)], scene, clock)
    assert endpoint.ticks_s[5] - endpoint.slept_until_s < 0.5 * TIMEOUT_S
    assert shell.timing.stalls >= 1


def test_a_timer_in_time_is_not_counted_as_late() -> None:
    endpoint = EchoEndpoint()

    async def scene(_: Shell) -> None:
        await until(lambda: len(endpoint.ticks_s) > 10)

    shell = drive(endpoint, [], scene)
    assert shell.timing.fired == len(endpoint.ticks_s)
    assert shell.timing.late_total_s <= shell.timing.fired * shell.timing.worst_late_s
