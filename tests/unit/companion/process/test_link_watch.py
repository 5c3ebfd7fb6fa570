from __future__ import annotations

from companion.diagnostics import LinkWatch
from companion.io.links.byte_streams import TcpClientLink
from companion.io.links.link import Link
from companion.io.links.udp import UdpLink
from tests.unit.companion.link.wire import Journal


class ConnectedLine(TcpClientLink):
    """A line with a peer at the other end."""

    @property
    def is_connected(self) -> bool:
        return True


def udp() -> UdpLink:
    return UdpLink("127.0.0.1", 14550, 0, print)


def line() -> ConnectedLine:
    return ConnectedLine("127.0.0.1", 5760, 0, print)


def watched(link: Link) -> tuple[LinkWatch, Journal]:
    journal = Journal()
    return LinkWatch([link], journal), journal


def test_a_link_that_refuses_is_reported_with_the_reason() -> None:
    link = udp()
    watch, journal = watched(link)
    watch.check(0.0)
    link.counters.send_errors, link.counters.last_error = 3, "Connection refused"
    watch.check(1.0)
    assert journal.texts == [
        "udp 127.0.0.1:14550: the system rejected 3 frames (Connection refused)"
    ]


def test_it_is_reported_rarely_and_nothing_is_left_out_of_the_sum() -> None:
    link = udp()
    watch, journal = watched(link)
    for tenth in range(1000):
        link.counters.send_errors += 1
        watch.check(tenth / 10.0)
    assert len(journal.texts) in (9, 10)
    announced = sum(int(text.split("rejected ")[1].split()[0]) for text in journal.texts)
    assert announced > 900


def test_before_a_peer_is_heard_unsent_frames_are_not_reported() -> None:
    link = udp()
    watch, journal = watched(link)
    for second in range(30):
        link.counters.dropped += 1
        watch.check(float(second))
    assert journal.texts == []


def test_a_line_that_is_too_slow_is_reported() -> None:
    link = line()
    watch, journal = watched(link)
    watch.check(0.0)
    link.counters.dropped = 7
    watch.check(1.0)
    assert journal.texts == ["tcp 127.0.0.1:5760: 7 frames dropped, the link is too slow"]


def test_the_counters_are_in_the_event_log_every_ten_seconds() -> None:
    link = udp()
    watch, journal = watched(link)
    for tenth in range(601):
        watch.check(tenth / 10.0)
    records = [fields for kind, fields in journal.records if kind == "io"]
    assert len(records) in (6, 7)
    counters = records[0]["udp 127.0.0.1:14550"]
    assert isinstance(counters, dict)
    assert {"sent", "send_errors", "dropped", "received"} <= set(counters)
