"""The hub: one vehicle's link for several programs, with faults on the companion's way only."""

from __future__ import annotations

from unittest.mock import create_autospec

import msgspec
import pytest

from companion.io.child_processes import ChildProcess
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from sim_link.lab.faults.fault_models import (
    CompanionKilled,
    CompanionStalled,
    LinkBlackout,
    LinkDelay,
    Schedule,
)
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.mission.processes import (
    COMPANION,
    OPERATOR,
    PERIOD_S,
    RADIO,
    VEHICLE,
    Hub,
    ProcessHarness,
)
from sim_link.lab.observer import Observer

PEER = ("127.0.0.1", 14580)


class Routed:
    """A hub and what it does."""

    def __init__(self, *, has_radio: bool = False) -> None:
        self.wire = FaultyLink(Schedule(), 1)
        self.watched: list[tuple[int, float]] = []
        self.ticks: list[float] = []
        self.stops: list[float] = []
        self.hub = Hub(
            self.wire,
            lambda link, _, now_s: self.watched.append((link, now_s)),
            self.ticks.append,
            self.stops.append,
            has_radio=has_radio,
        )
        self._codec = MavCodec(1, 1)

    def say(self, link: int, now_s: float = 0.0, *, is_datagram: bool = True) -> list[Chunk]:
        data = self._codec.encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
        self.hub.receive(Chunk(link, data, PEER, is_datagram=is_datagram), now_s)
        return self.hub.take_output()


def links(chunks: list[Chunk]) -> list[int]:
    return [chunk.link for chunk in chunks]


def test_the_vehicle_is_heard_by_all_and_every_client_by_the_vehicle_and_the_others() -> None:
    routed = Routed()
    assert links(routed.say(VEHICLE)) == [COMPANION, OPERATOR]
    assert links(routed.say(COMPANION)) == [VEHICLE, OPERATOR]
    assert links(routed.say(OPERATOR)) == [VEHICLE, COMPANION]
    assert [link for link, _ in routed.watched] == [VEHICLE, COMPANION, OPERATOR]


def test_what_reaches_the_companion_is_reported_when_it_does() -> None:
    wire, delivered_s = FaultyLink(Schedule(), 1), list[float]()
    hub = Hub(
        wire,
        lambda *_: None,
        lambda _: None,
        lambda _: None,
        delivered=lambda _, now_s: delivered_s.append(now_s),
    )
    frame = MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
    hub.receive(Chunk(VEHICLE, frame, PEER), 1.0)
    hub.receive(Chunk(COMPANION, frame, PEER), 1.5)
    assert delivered_s == [1.0]
    wire.add(LinkDelay(delay_s=0.4), 2.0)
    hub.receive(Chunk(OPERATOR, frame, PEER), 2.0)
    hub.handle_timer(2.3)
    assert delivered_s == [1.0]
    hub.handle_timer(2.5)
    assert delivered_s == [1.0, 2.5]
    wire.add(LinkBlackout(), 3.0)
    hub.receive(Chunk(VEHICLE, frame, PEER), 3.1)
    assert delivered_s == [1.0, 2.5]


def test_a_radio_beside_the_vehicle_is_one_more_client() -> None:
    routed = Routed(has_radio=True)
    assert links(routed.say(VEHICLE)) == [COMPANION, OPERATOR, RADIO]
    assert COMPANION in links(routed.say(RADIO))


def test_answers_go_to_where_the_vehicle_was_heard() -> None:
    routed = Routed()
    routed.say(VEHICLE)
    to_vehicle = next(chunk for chunk in routed.say(OPERATOR) if chunk.link == VEHICLE)
    assert to_vehicle.peer == PEER


def test_faults_hit_the_companion_and_never_the_operator() -> None:
    routed = Routed()
    routed.wire.add(LinkBlackout(), 0.0)
    assert links(routed.say(VEHICLE, 1.0)) == [OPERATOR]
    assert links(routed.say(COMPANION, 1.0)) == [OPERATOR]
    assert links(routed.say(OPERATOR, 1.0)) == [VEHICLE]


def test_what_is_late_is_delivered_when_it_is_due() -> None:
    routed = Routed()
    routed.wire.add(LinkDelay(delay_s=0.03), 0.0)
    routed.hub.handle_timer(0.0)
    assert links(routed.say(VEHICLE, 0.01)) == [OPERATOR]
    assert routed.hub.next_timer_s() == 0.04
    routed.hub.handle_timer(0.04)
    assert links(routed.hub.take_output()) == [COMPANION]
    assert routed.ticks == [0.0]


def test_a_stream_is_passed_on_in_whole_frames() -> None:
    routed = Routed()
    data = MavCodec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
    routed.hub.receive(Chunk(VEHICLE, data[:9], is_datagram=False), 0.0)
    assert routed.hub.take_output() == []
    routed.hub.receive(Chunk(VEHICLE, data[9:], is_datagram=False), 0.1)
    assert [chunk.data for chunk in routed.hub.take_output()] == [data, data]


def test_the_mission_is_looked_at_ten_times_a_second_and_decides_about_the_end() -> None:
    routed = Routed()
    routed.hub.handle_timer(0.0)
    assert routed.hub.next_timer_s() == PERIOD_S
    routed.hub.handle_timer(0.1)
    assert routed.ticks == [0.0, 0.1]
    routed.hub.request_stop(0.2)
    assert routed.stops == [0.2]
    assert not routed.hub.is_finished
    routed.hub.finish()
    assert routed.hub.is_finished


@pytest.mark.parametrize(
    "fault",
    [CompanionKilled(down_s=2.0), CompanionStalled(duration_s=2.0)],
    ids=["killed", "stalled"],
)
def test_a_companion_that_a_fault_stops_is_not_waited_for(
    fault: CompanionKilled | CompanionStalled,
) -> None:
    child = create_autospec(ChildProcess, instance=True)
    harness = ProcessHarness(FaultyLink(Schedule(), 1), None, child, Observer())
    harness.inject(msgspec.structs.replace(fault, start_s=1.0), 0.0)
    running = []
    for now_s in (0.5, 1.0, 2.9, 3.1):
        harness.tick(now_s)
        running.append(harness.is_companion_running)
    assert running == [True, False, False, True]
