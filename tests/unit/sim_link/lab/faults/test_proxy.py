"""The proxy as an endpoint on invented time, with the faults that are tested in memory."""

from __future__ import annotations

import socket
from contextlib import closing

import pytest

from companion.errors import ConfigError, LinkError
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Address, Chunk
from sim_link.cli import run_subcommand
from sim_link.lab.faults.fault_models import (
    Fault,
    ForeignFrames,
    LinkBlackout,
    LinkDelay,
    LinkLoss,
    Schedule,
)
from sim_link.lab.faults.faulty_link import ATTACK, COMPANION, VEHICLE, FaultProxy

VEHICLE_PEER: Address = ("127.0.0.1", 14580)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)


class Ends:
    """Vehicle and companion of a proxy."""

    def __init__(self, *faults: Fault) -> None:
        self.proxy = FaultProxy(Schedule(faults=faults), 1)

    def down(self, data: bytes, now_s: float = 0.0) -> None:
        self.proxy.receive(Chunk(VEHICLE, data, VEHICLE_PEER), now_s)

    def up(self, data: bytes, now_s: float = 0.0) -> None:
        self.proxy.receive(Chunk(COMPANION, data, ("127.0.0.1", 14550)), now_s)

    def sent(self, now_s: float) -> list[Chunk]:
        self.proxy.handle_timer(now_s)
        return self.proxy.take_output()


def test_both_directions_pass() -> None:
    ends = Ends()
    ends.down(b"down")
    assert ends.sent(0.0) == [Chunk(COMPANION, b"down")]
    ends.up(b"up")
    assert ends.sent(0.0) == [Chunk(VEHICLE, b"up", VEHICLE_PEER)]


def test_nothing_is_sent_to_a_vehicle_that_was_not_heard() -> None:
    ends = Ends()
    ends.up(b"up")
    assert ends.sent(0.0) == []


def test_loss_takes_its_share_and_counts_it() -> None:
    ends = Ends(LinkLoss(share=0.3))
    for i in range(100):
        ends.down(bytes((i, 0)))
    count = len(ends.sent(0.0))
    assert 50 < count < 90
    assert (ends.proxy.counters.to_companion, ends.proxy.counters.lost) == (count, 100 - count)


def test_a_late_datagram_waits() -> None:
    ends = Ends(LinkDelay(delay_s=0.01))
    assert ends.sent(0.0) == []
    ends.down(b"late")
    assert ends.proxy.next_timer_s() == 0.01
    assert ends.sent(0.009) == []
    assert ends.sent(0.01) == [Chunk(COMPANION, b"late")]


def test_a_fault_may_be_added_on_the_run() -> None:
    ends = Ends()
    ends.proxy.add(LinkBlackout(duration_s=1.0), 5.0)
    ends.down(b"lost", 5.5)
    ends.down(b"found", 6.1)
    assert [chunk.data for chunk in ends.sent(6.1)] == [b"found"]


def test_an_attacker_has_an_address_of_its_own_and_is_not_answered() -> None:
    ends = Ends(ForeignFrames(rate_hz=200.0))
    ends.down(MavCodec(1, 1).encode(HEARTBEAT))
    links = {chunk.link for tick in range(16) for chunk in ends.sent(0.02 * tick)}
    assert links == {COMPANION, ATTACK}
    assert ends.proxy.counters.attacks == pytest.approx(60, abs=1)
    ends.proxy.receive(Chunk(ATTACK, b"who are you?", ("127.0.0.1", 14550)), 0.32)
    assert all(chunk.link != VEHICLE for chunk in ends.sent(0.32))


def test_it_ends_after_its_time() -> None:
    proxy = FaultProxy(Schedule(), 1, 2.0)
    proxy.handle_timer(1.99)
    assert not proxy.is_finished
    proxy.handle_timer(2.0)
    assert proxy.is_finished


def test_a_taken_port_is_an_error_of_the_link() -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(LinkError, match=f"{port} is in use"):
            run_subcommand(["proxy", "--listen", f"127.0.0.1:{port}"])


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
