from __future__ import annotations

import math

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import TargetedTimesync, targets_of_frame
from sim_link.autopilot.protocols.addressing import Addressing
from sim_link.autopilot.protocols.command_protocol import Clocks
from tests.unit.sim_link.autopilot.protocols.wire import STATION, received, said

PX4 = Clocks(Addressing(1))
ARDUPILOT = Clocks(Addressing(1), names_targets=False, answers_ping=False)


def timesync(tc1: int = 0, ts1: int = 77) -> Message:
    return mavlink.MAVLink_timesync_message(tc1, ts1)


# TIMESYNC


def test_a_request_is_answered_with_its_stamp_mirrored_and_ours_beside_it() -> None:
    answer = PX4.timesync(received(timesync()), STATION, 2.5)
    assert isinstance(answer, mavlink.MAVLink_timesync_message)
    assert (answer.tc1, answer.ts1) == (2_500_000_000, 77)


def test_our_stamp_is_never_zero_which_would_make_it_a_request() -> None:
    answer = PX4.timesync(received(timesync()), STATION, 0.0)
    assert isinstance(answer, mavlink.MAVLink_timesync_message)
    assert answer.tc1 == 1


def test_the_answer_names_the_asker() -> None:
    answer = PX4.timesync(received(timesync()), STATION, 2.5)
    assert answer is not None
    assert targets_of_frame(bytes(said(answer).get_msgbuf())) == (255, 190)


def test_ardupilot_answers_without_targets() -> None:
    answer = ARDUPILOT.timesync(received(timesync()), STATION, 2.5)
    assert answer is not None
    assert targets_of_frame(bytes(said(answer).get_msgbuf())) == (0, 0)


def test_an_answer_is_never_answered() -> None:
    assert PX4.timesync(received(timesync(tc1=5)), STATION, 2.5) is None


@pytest.mark.parametrize(
    ("targets", "is_answered"), [((0, 0), True), ((1, 1), True), ((1, 191), False), ((2, 1), False)]
)
def test_a_request_to_another_is_not_answered(targets: tuple[int, int], is_answered: bool) -> None:
    request = received(TargetedTimesync(0, 77, *targets))
    assert targets_of_frame(bytes(request.get_msgbuf())) == targets
    assert (PX4.timesync(request, STATION, 2.5) is not None) is is_answered


def test_mavlink_1_leaves_the_targets_out() -> None:
    frame = MavCodec(1, 1).encode(TargetedTimesync(9, 77, 255, 190), is_mavlink1=True)
    assert frame[1] == 16
    (message,) = MavCodec(255, 190).decode(frame)
    assert targets_of_frame(bytes(message.get_msgbuf())) == (0, 0)


# PING


def test_a_ping_to_everyone_is_answered_to_its_sender() -> None:
    answer = PX4.ping(received(mavlink.MAVLink_ping_message(123, 7, 0, 0)), STATION)
    assert isinstance(answer, mavlink.MAVLink_ping_message)
    assert (answer.time_usec, answer.seq) == (123, 7)
    assert (answer.target_system, answer.target_component) == (255, 190)


@pytest.mark.parametrize("targets", [(1, 1), (1, 0), (0, 1), (255, 190)])
def test_a_ping_with_a_target_is_an_answer_and_never_answered(targets: tuple[int, int]) -> None:
    assert PX4.ping(received(mavlink.MAVLink_ping_message(123, 7, *targets)), STATION) is None


def test_ardupilot_does_not_answer_a_ping() -> None:
    assert ARDUPILOT.ping(received(mavlink.MAVLink_ping_message(123, 7, 0, 0)), STATION) is None


def test_ardupilot_dates_an_answer_back_by_what_waits_in_its_buffer() -> None:
    clocks = Clocks(Addressing(1), names_targets=False, dated_back_baud=57_600)
    request = received(timesync())
    assert clocks.timesync(request, STATION, 2.5) is None
    behind = received(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    clocks.count(behind, STATION)
    assert clocks.due(2.501) == []
    (answer,) = clocks.due(clocks.next_s())
    waiting = len(request.get_msgbuf()) + len(behind.get_msgbuf())
    assert isinstance(answer.message, mavlink.MAVLink_timesync_message)
    assert answer.message.ts1 == 77
    assert answer.message.tc1 / 1e9 == pytest.approx(2.5 - waiting * 10 / 57_600)
    assert answer.to == STATION.channel
    assert clocks.next_s() == math.inf
