"""The kernel's filter, on real loopback sockets."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from companion.io.links.udp import attach_source_filter, detach_source_filter

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="socket filters are Linux's")


@contextmanager
def bound(host: str = "127.0.0.1", port: int = 0) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind((host, port))
        made.setblocking(False)
        yield made


def received(sock: socket.socket) -> list[bytes]:
    data = []
    while True:
        try:
            data.append(sock.recv(100))
        except BlockingIOError:
            return data


def test_only_one_address_and_port_gets_through_until_all_do() -> None:
    with bound() as ours, bound() as friend, bound() as stranger:
        port = friend.getsockname()[1]
        with bound("127.0.0.2", port) as namesake:
            senders = {b"friend": friend, b"stranger": stranger, b"namesake": namesake}

            def all_send() -> None:
                for name, sender in senders.items():
                    sender.sendto(name, ours.getsockname())

            assert attach_source_filter(ours, ("127.0.0.1", port))
            all_send()
            assert received(ours) == [b"friend"]
            assert attach_source_filter(ours, ("127.0.0.2", port))
            all_send()
            assert received(ours) == [b"namesake"]
            detach_source_filter(ours)
            all_send()
            assert set(received(ours)) == set(senders)
            detach_source_filter(ours)


def test_a_socket_that_cannot_be_filtered_is_left_alone() -> None:
    with bound() as ours:
        ours.close()
        assert not attach_source_filter(ours, ("127.0.0.1", 1))
        detach_source_filter(ours)
