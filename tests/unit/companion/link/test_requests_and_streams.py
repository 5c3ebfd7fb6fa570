from __future__ import annotations

import pytest

from companion.domain import Autopilot
from companion.guidance.events import Outcome, RequestAnswered, RequestKind
from companion.link.autopilot_queries import (
    MAX_REQUESTS,
    ONE_SHOT,
    ONLY_FROM,
    STREAM_INTERVAL_S,
    StreamFreshness,
    StreamRequester,
    StreamStopper,
)
from companion.link.outbound import CommandMessage, RequestClient, arm
from companion.mav.dialect import MAVLink_ekf_status_report_message, Message, mavlink
from tests.unit.companion.link.wire import heartbeat, local_position

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, DENIED, IN_PROGRESS = 0, 2, 5
HIGHRES_IMU, ODOMETRY = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_ODOMETRY
POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
TICK_S = 0.05


def ack(command: int = ARM, result: int = ACCEPTED) -> mavlink.MAVLink_command_ack_message:
    return mavlink.MAVLink_command_ack_message(command, result, 0, 0, 1, 191)


def asked() -> RequestClient:
    client = RequestClient()
    client.submit(RequestKind.ARM, arm(), (1, 1))
    return client


def confirmation_of(due: Message | RequestAnswered | None) -> int:
    assert isinstance(due, CommandMessage)
    return int(due.confirmation)


def test_a_request_is_sent_four_times_half_a_second_apart_and_then_given_up() -> None:
    client = asked()
    sends: list[tuple[float, int]] = []
    for tick in range(100):
        now_s = 5.0 + tick * TICK_S
        due = client.due(now_s)
        if isinstance(due, RequestAnswered):
            assert due.outcome is Outcome.NO_ANSWER
            assert now_s == pytest.approx(7.0)
            break
        if due is not None:
            sends.append((round(now_s, 2), confirmation_of(due)))
    assert sends == [(5.0, 0), (5.5, 1), (6.0, 2), (6.5, 3)]
    assert client.due(100.0) is None


@pytest.mark.parametrize(
    ("result", "outcome", "detail"),
    [
        (0, Outcome.ACCEPTED, ""),
        (1, Outcome.REJECTED, "temporarily rejected"),
        (2, Outcome.REJECTED, "denied"),
        (99, Outcome.REJECTED, "result 99"),
    ],
)
def test_an_ack_ends_the_request(result: int, outcome: Outcome, detail: str) -> None:
    client = asked()
    client.due(0.0)
    answer = client.receive_ack(ack(result=result), 0.1)
    assert answer == RequestAnswered(0.1, RequestKind.ARM, outcome, detail)
    assert client.due(10.0) is None


def test_in_progress_means_wait_and_not_resend() -> None:
    client = asked()
    client.due(0.0)
    assert client.receive_ack(ack(result=IN_PROGRESS), 0.1) is None
    assert client.due(3.0) is None
    assert client.receive_ack(ack(result=IN_PROGRESS), 3.0) is None
    assert client.due(5.9) is None
    late = client.due(6.0)
    assert isinstance(late, RequestAnswered)
    assert late.outcome is Outcome.NO_ANSWER


def test_an_answer_to_another_command_is_not_ours() -> None:
    client = asked()
    client.due(0.0)
    assert client.receive_ack(ack(mavlink.MAV_CMD_DO_SET_MODE), 0.1) is None
    assert confirmation_of(client.due(0.5)) == 1


def test_progress_without_end_is_given_up() -> None:
    client = asked()
    client.due(0.0)
    given_up_s = None
    for tick in range(1, 400):
        now_s = tick * TICK_S
        client.receive_ack(ack(result=IN_PROGRESS), now_s)
        due = client.due(now_s)
        assert not isinstance(due, CommandMessage)
        if due is not None:
            given_up_s = now_s
    assert given_up_s == pytest.approx(10.0, abs=TICK_S)


def test_an_answer_before_the_question_belongs_to_an_older_one() -> None:
    client = asked()
    assert client.receive_ack(ack(), 0.0) is None
    assert confirmation_of(client.due(0.0)) == 0


def test_a_new_wish_replaces_the_old_and_a_withdrawn_one_is_gone() -> None:
    client = asked()
    client.due(0.0)
    client.submit(RequestKind.ARM, arm(), (1, 1))
    assert confirmation_of(client.due(0.1)) == 0
    client.cancel()
    assert client.due(5.0) is None


# Streams


FROM_PX4 = [n for n in STREAM_INTERVAL_S if ONLY_FROM.get(n) is not Autopilot.ARDUPILOT]


class Asking:
    """A requester on its ticks, and what it asked for when."""

    def __init__(self) -> None:
        self.freshness = StreamFreshness()
        self.requester = StreamRequester(self.freshness)
        self.now_s = 0.0
        self.asked: list[tuple[float, int, int]] = []

    def wait(self, duration_s: float) -> None:
        for _ in range(round(duration_s / TICK_S)):
            self.now_s += TICK_S
            due = self.requester.due(self.now_s, (1, 1), Autopilot.PX4)
            if due is not None:
                assert isinstance(due, CommandMessage)
                self.asked.append((self.now_s, due.command, int(due.param1)))

    def hear(self, interval_s: float, duration_s: float) -> None:
        """Positions come."""
        for _ in range(round(duration_s / interval_s)):
            message = local_position(round(1e3 * self.now_s))
            self.freshness.receive(message, self.now_s)
            self.wait(interval_s)

    def times(self, number: int) -> list[float]:
        return [at for at, command, n in self.asked if n == number and command == 511]


def test_every_stream_is_asked_for_one_a_tick() -> None:
    asking = Asking()
    asking.wait(0.9)
    assert {n for _, command, n in asking.asked if command == 511} == set(FROM_PX4)
    assert {n for _, command, n in asking.asked if command == 512} == set(ONE_SHOT)
    assert len({at for at, _, _ in asking.asked}) == len(asking.asked)


def test_each_autopilot_is_asked_for_its_own_view_of_its_estimator() -> None:
    asked = {autopilot: set[int]() for autopilot in Autopilot}
    for autopilot, numbers in asked.items():
        requester = StreamRequester(StreamFreshness())
        for tick in range(30):
            request = requester.due(0.05 * tick, (1, 1), autopilot)
            if isinstance(request, CommandMessage):
                numbers.add(int(request.param1))
    px4, copter = asked[Autopilot.PX4], asked[Autopilot.ARDUPILOT]
    assert px4 - copter == {mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS}
    assert copter - px4 == {MAVLink_ekf_status_report_message.id}
    assert asked[Autopilot.OTHER] == px4 & copter


def test_an_interval_is_asked_for_in_microseconds() -> None:
    requester = StreamRequester(StreamFreshness())
    first = requester.due(0.0, (3, 1))
    assert isinstance(first, CommandMessage)
    assert (first.target_system, first.param1, first.param2) == (3, POSITION, 50_000.0)


def test_an_unheard_stream_is_asked_for_again_and_again_ever_more_slowly() -> None:
    asking = Asking()
    asking.wait(120.0)
    gaps = [b - a for a, b in zip(asking.times(POSITION), asking.times(POSITION)[1:], strict=False)]
    assert gaps[:5] == pytest.approx([1.0, 2.0, 4.0, 8.0, 16.0], abs=0.6)
    assert max(gaps) <= 16.6


def test_a_stream_that_flows_is_left_alone_and_one_that_stops_is_asked_for() -> None:
    asking = Asking()
    asking.wait(0.5)
    asking.hear(0.05, 20.0)
    assert len(asking.times(POSITION)) == 1
    asking.wait(1.5)
    assert len(asking.times(POSITION)) == 2


def test_a_stream_that_is_slow_is_asked_for_ever_more_slowly() -> None:
    asking = Asking()
    asking.wait(0.5)
    asking.hear(0.3, 60.0)
    assert len(asking.times(POSITION)) == pytest.approx(1 + 6, abs=1)
    asking.hear(0.05, 60.0)
    assert len(asking.times(POSITION)) <= 8


def test_a_stream_whose_stamps_stand_still_has_stopped() -> None:
    asking = Asking()
    asking.hear(0.05, 5.0)
    message = local_position(round(1e3 * asking.now_s))
    for _ in range(60):
        asking.freshness.receive(message, asking.now_s)
        asking.wait(0.05)
    assert len(asking.times(POSITION)) >= 2


def test_channels_of_a_transmitter_that_is_not_there_are_not_asked_for_for_ever() -> None:
    channels = mavlink.MAVLINK_MSG_ID_RC_CHANNELS
    asking = Asking()
    asking.wait(300.0)
    gaps = [b - a for a, b in zip(asking.times(channels), asking.times(channels)[1:], strict=False)]
    assert gaps == pytest.approx([1.0, 2.0, 4.0, 8.0], abs=0.6)
    asking.requester.note_rc(True)
    asking.wait(60.0)
    assert len(asking.times(channels)) == 5 + 5


def test_after_a_restart_everything_is_asked_for_again() -> None:
    asking = Asking()
    asking.wait(0.6)
    asking.hear(0.05, 0.5)
    asking.asked.clear()
    asking.requester.restart()
    asking.wait(0.9)
    assert len(asking.asked) == len(FROM_PX4) + len(ONE_SHOT)


def heartbeats_asked(asking: Asking) -> list[float]:
    number = mavlink.MAVLINK_MSG_ID_HEARTBEAT
    return [at for at, command, n in asking.asked if (command, n) == (512, number)]


def test_a_heartbeat_that_does_not_come_is_asked_for_often_before_the_mode_is_unknown() -> None:
    asking = Asking()
    asking.freshness.receive(heartbeat(), 0.0)
    asking.wait(10.0)
    asked = heartbeats_asked(asking)
    assert asked[0] == pytest.approx(3.0, abs=0.2)
    assert len(asked) > 20


def test_one_that_comes_once_a_second_is_not_asked_for_nor_one_that_never_came() -> None:
    asking = Asking()
    asking.wait(20.0)
    for _ in range(20):
        asking.freshness.receive(heartbeat(), asking.now_s)
        asking.wait(1.0)
    assert heartbeats_asked(asking) == []


def test_who_does_not_know_the_question_is_asked_seldom() -> None:
    asking = Asking()
    asking.freshness.receive(heartbeat(), 0.0)
    asking.wait(112.0)
    late = [at for at in heartbeats_asked(asking) if at > 13.0]
    assert len(late) == pytest.approx(20, abs=1)


# Unread streams


def stops(stopper: StreamStopper, seconds: float) -> list[int]:
    """Return the streams that are requested to stop, while all of them go on."""
    asked = []
    for tick in range(round(seconds / TICK_S)):
        for number in [HIGHRES_IMU, ODOMETRY]:
            stopper.hear(number, tick * TICK_S)
        request = stopper.due(tick * TICK_S, (1, 1))
        if isinstance(request, CommandMessage):
            assert (request.command, request.param2) == (511, -1.0)
            asked.append(int(request.param1))
    return asked


def test_each_unread_stream_is_requested_to_stop() -> None:
    assert set(stops(StreamStopper(), 1.0)) == {HIGHRES_IMU, ODOMETRY}


def test_a_stream_that_does_not_stop_is_asked_a_few_times_only() -> None:
    assert len(stops(StreamStopper(), 100.0)) == 2 * MAX_REQUESTS


def test_a_restarted_autopilot_is_asked_again() -> None:
    stopper = StreamStopper()
    stops(stopper, 100.0)
    stopper.restart()
    assert set(stops(stopper, 1.0)) == {HIGHRES_IMU, ODOMETRY}


def test_a_stream_that_stopped_is_not_asked_for_again() -> None:
    stopper = StreamStopper()
    stops(stopper, 1.0)
    assert stopper.due(50.0, (1, 1)) is None
