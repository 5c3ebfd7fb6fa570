"""A wake-up by data waits for the rest of its burst or for the timer, and never beyond it."""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from companion.io.shell import GATHER_S, GatheringSelector


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Return two connected datagram sockets."""
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with one, other:
        yield one, other


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the waits of the selector, which take no time."""
    waits: list[float] = []
    monkeypatch.setattr("companion.io.shell.time.sleep", waits.append)
    return waits


def _select(receiver: socket.socket, timeout: float | None) -> int:
    with GatheringSelector() as selector:
        selector.register(receiver, selectors.EVENT_READ)
        return len(selector.select(timeout))


def test_a_wake_up_by_data_waits_for_the_rest_of_the_burst(
    pair: tuple[socket.socket, socket.socket], slept: list[float]
) -> None:
    pair[0].send(b"first")
    assert _select(pair[1], None) == 1
    assert slept == [GATHER_S]


def test_it_waits_no_longer_than_the_timer(
    pair: tuple[socket.socket, socket.socket], slept: list[float]
) -> None:
    pair[0].send(b"first")
    assert _select(pair[1], 0.5 * GATHER_S) == 1
    assert len(slept) == 1
    assert 0.0 < slept[0] <= 0.5 * GATHER_S


def test_work_that_is_due_now_does_not_wait(
    pair: tuple[socket.socket, socket.socket], slept: list[float]
) -> None:
    pair[0].send(b"first")
    assert _select(pair[1], 0.0) == 1
    assert _select(pair[1], -1.0) == 1
    assert not slept


def test_a_timer_without_data_is_not_delayed(
    pair: tuple[socket.socket, socket.socket], slept: list[float]
) -> None:
    assert _select(pair[1], 0.001) == 0
    assert not slept


def test_stamped_data_wait_for_the_timer_and_take_no_wake_up() -> None:
    with _udp() as (sender, receiver), GatheringSelector(lambda: [receiver.fileno()]) as selector:
        selector.register(receiver, selectors.EVENT_READ)
        sender.send(b"first")
        began_s = time.monotonic()
        assert [key.fileobj for key, _ in selector.select(0.03)] == [receiver]
        assert time.monotonic() - began_s >= 0.03
        assert [key.fileobj for key, _ in selector.select(0.0)] == [receiver]


def test_data_of_a_radio_on_a_stream_end_the_wait_for_stamped_ones(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    with _udp() as (sender, receiver), GatheringSelector(lambda: [receiver.fileno()]) as selector:
        for each in (receiver, pair[1]):
            selector.register(each, selectors.EVENT_READ)
        sender.send(b"stamped")
        pair[0].send(b"range")
        began_s = time.monotonic()
        assert {key.fileobj for key, _ in selector.select(30.0)} == {receiver, pair[1]}
        assert time.monotonic() - began_s < 30.0


@contextmanager
def _udp() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Return a sender and a receiver of datagrams."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
    ):
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        yield sender, receiver
