"""The UDP proxy on real sockets, with the faults that are tested in memory."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from companion.errors import ConfigError, LinkError
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from sim_link.lab.faults.fault_models import (
    Fault,
    ForeignFrames,
    LinkBlackout,
    LinkDelay,
    LinkLoss,
    Schedule,
)
from sim_link.lab.faults.proxy import FaultProxy
from sim_link.lab.subcommands import run_subcommand

HOST = "127.0.0.1"
PATIENCE_S = 30.0


@contextmanager
def ends(*faults: Fault) -> Iterator[tuple[socket.socket, FaultProxy, socket.socket]]:
    """A vehicle, a proxy and a companion."""
    with (
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as vehicle,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as companion,
    ):
        for each in (vehicle, companion):
            each.bind((HOST, 0))
            each.settimeout(PATIENCE_S)
        address = companion.getsockname()
        with FaultProxy((HOST, 0), (HOST, address[1]), Schedule(faults=faults), 1) as proxy:
            yield vehicle, proxy, companion


def arrived(end: socket.socket) -> list[bytes]:
    end.setblocking(False)
    found = []
    while True:
        try:
            found.append(end.recv(2048))
        except BlockingIOError:
            return found


def carried(proxy: FaultProxy, end: socket.socket) -> list[bytes]:
    """What arrives first, however long the proxy is kept from running."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not (found := arrived(end)):
        assert time.monotonic() < deadline_s, "nothing arrives"
        proxy.run(0.02)
    return found


def test_both_directions_pass() -> None:
    with ends() as (vehicle, proxy, companion):
        vehicle.sendto(b"down", proxy.vehicle_side)
        proxy.run(0.05)
        data, peer = companion.recvfrom(2048)
        assert (data, peer) == (b"down", proxy.companion_side)
        companion.sendto(b"up", peer)
        proxy.run(0.05)
        assert vehicle.recv(2048) == b"up"


def test_loss_takes_its_share_and_counts_it() -> None:
    with ends(LinkLoss(share=0.3)) as (vehicle, proxy, companion):
        for i in range(100):
            vehicle.sendto(bytes((i, 0)), proxy.vehicle_side)
        proxy.run(0.2)
        count = len(arrived(companion))
        assert 50 < count < 90
        assert (proxy.counters.to_companion, proxy.counters.lost) == (count, 100 - count)


def test_a_late_datagram_waits() -> None:
    with ends(LinkDelay(delay_s=0.2)) as (vehicle, proxy, companion):
        sent_s = time.monotonic()
        vehicle.sendto(b"late", proxy.vehicle_side)
        assert carried(proxy, companion) == [b"late"]
        assert time.monotonic() - sent_s >= 0.2


@pytest.mark.slow
def test_a_fault_may_be_added_on_the_run() -> None:
    with ends() as (vehicle, proxy, companion):
        proxy.add(LinkBlackout(duration_s=1.0))
        vehicle.sendto(b"lost", proxy.vehicle_side)
        proxy.run(1.1)
        vehicle.sendto(b"found", proxy.vehicle_side)
        assert carried(proxy, companion) == [b"found"]


def test_an_attacker_has_an_address_of_its_own() -> None:
    with ends(ForeignFrames(rate_hz=200.0)) as (vehicle, proxy, companion):
        frame = MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
        vehicle.sendto(frame, proxy.vehicle_side)
        proxy.run(0.3)
        assert proxy.counters.attacks > 20
        senders = {companion.recvfrom(2048)[1] for _ in range(20)}
        assert proxy.companion_side in senders
        assert len(senders) == 2


def test_nobody_else_reaches_the_vehicle() -> None:
    with ends() as (vehicle, proxy, _):
        vehicle.sendto(b"here I am", proxy.vehicle_side)
        proxy.run(0.05)
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as stranger:
            stranger.sendto(b"obey me", proxy.companion_side)
            proxy.run(0.05)
        assert arrived(vehicle) == []


def test_a_taken_port_is_told() -> None:
    with ends() as (_, proxy, _), pytest.raises(LinkError, match="in use"):
        FaultProxy(proxy.vehicle_side, (HOST, 1), Schedule(), 1)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--fault", "{kind: link_los}"],
        ["--fault", "{kind: vehicle_reboot}"],
        ["--fault", "[unclosed"],
        ["--listen", "nowhere"],
        ["--companion", "127.0.0.1:99999"],
        ["--seed", "-1"],
        ["--faults", "/does/not/exist.yaml"],
    ],
)
def test_bad_arguments_open_no_socket(arguments: list[str]) -> None:
    with pytest.raises(ConfigError):
        run_subcommand(["proxy", *arguments])
