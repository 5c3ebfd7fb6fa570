"""The end of a run of the shell: by itself, by signals, by a bug."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time

import pytest

from companion.io.links.transports import UdpBind
from companion.io.shell import SAME_SIGNAL_S, Clock, Shell
from tests.e2e.shell_helpers import TIMEOUT_S, EchoEndpoint, TimeOfOurs


def test_a_finished_endpoint_ends_the_run() -> None:
    endpoint = EchoEndpoint()
    wakeups: list[float] = []

    def on_wakeup(now_s: float) -> None:
        wakeups.append(now_s)
        endpoint.is_finished = len(wakeups) == 5

    Shell(endpoint, [], Clock(speed=10.0), on_wakeup).run_blocking()
    assert wakeups == sorted(wakeups)
    assert len(endpoint.ticks_s) == 5
    assert endpoint.stops_s == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_asks_the_endpoint_to_stop(number: signal.Signals) -> None:
    heard: list[int] = []

    def own_handler(*_: object) -> None:
        heard.append(len(heard))

    before = signal.signal(number, own_handler)
    endpoint = EchoEndpoint()

    def on_wakeup(_: float) -> None:
        if len(endpoint.ticks_s) == 3 and not endpoint.stops_s:
            os.kill(os.getpid(), number)

    try:
        Shell(endpoint, [], Clock(), on_wakeup).run_blocking()
        os.kill(os.getpid(), number)
        assert heard == [], "the echo of the first must not disturb the closing of the files"
        time.sleep(1.1 * SAME_SIGNAL_S)
        os.kill(os.getpid(), number)
        assert heard == [0]
        assert signal.getsignal(number) is own_handler
    finally:
        signal.signal(number, before)
    assert len(endpoint.stops_s) == 1


@pytest.fixture
def time_of_ours(monkeypatch: pytest.MonkeyPatch) -> TimeOfOurs:
    """Replace the clock of the shell by invented time."""
    ours = TimeOfOurs()
    monkeypatch.setattr("companion.io.shell.time", ours)
    monkeypatch.setattr("companion.io.shell.time", ours)
    return ours


@pytest.mark.parametrize(
    ("again_s", "ends_s"),
    [([0.05, 0.2], 1.5), ([0.5], 0.5), ([0.1, 0.5], 0.5)],
    ids=["at once", "later", "both"],
)
def test_a_second_signal_ends_at_once_if_it_is_not_the_echo_of_the_first(
    again_s: list[float], ends_s: float, time_of_ours: TimeOfOurs
) -> None:
    """timeout(1) signals the process, and then its group: within 0.3 s that is one wish."""
    endpoint = EchoEndpoint(finishes=False)
    signals_s = [0.0, *again_s]

    def on_wakeup(now_s: float) -> None:
        if signals_s and now_s >= signals_s[0]:
            signals_s.pop(0)
            os.kill(os.getpid(), signal.SIGTERM)

    took_s = time_of_ours.run(Shell(endpoint, [], Clock(), on_wakeup))
    assert took_s == pytest.approx(ends_s, abs=0.05)
    assert signals_s == []
    assert len(endpoint.stops_s) == 1


def test_an_endpoint_that_never_finishes_is_cut_off(time_of_ours: TimeOfOurs) -> None:
    endpoint = EchoEndpoint(finishes=False)
    shell = Shell(endpoint, [], Clock())
    shell.request_stop()
    assert time_of_ours.run(shell) == pytest.approx(1.5, abs=0.01)
    assert len(endpoint.stops_s) == 1
    assert len(endpoint.ticks_s) > 140


def test_a_shell_runs_and_stops_outside_the_main_thread() -> None:
    endpoint = EchoEndpoint()
    shell = Shell(endpoint, [UdpBind("127.0.0.1", 0)], Clock())
    thread = threading.Thread(target=lambda: asyncio.run(shell.run()))
    thread.start()
    while not endpoint.ticks_s:
        time.sleep(0.002)
    shell.request_stop()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert len(endpoint.stops_s) == 1
    shell.request_stop()


def test_a_bug_in_the_endpoint_ends_the_run_with_its_exception() -> None:
    class Broken(EchoEndpoint):
        def handle_timer(self, now_s: float) -> None:
            raise ZeroDivisionError(f"at {now_s >= 0}")

    with pytest.raises(ZeroDivisionError):
        Shell(Broken(), [UdpBind("127.0.0.1", 0)], Clock()).run_blocking()


def test_an_endpoint_that_is_always_late_does_not_take_the_processor() -> None:
    class Late(EchoEndpoint):
        def next_timer_s(self) -> float:
            return 0.0

    endpoint = Late()

    def on_wakeup(now_s: float) -> None:
        endpoint.is_finished = now_s > 0.2

    Shell(endpoint, [], Clock(), on_wakeup).run_blocking()
    assert len(endpoint.ticks_s) <= 250
