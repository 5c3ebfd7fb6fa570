"""TIMESYNC against delays, spikes, drift, a new clock and inventions."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from companion.link.conversion.clock_sync import (
    BEST_OF,
    MAX_OPEN,
    PERIOD_S,
    RESET_AFTER,
    ClockSync,
    Lateness,
)
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import TargetedTimesync, targets_of_frame

Delay = Callable[[], tuple[float, float]]
OFFSET_S = 1234.5


def received(message: Message) -> Message:
    (decoded,) = MavCodec(9, 9).decode(MavCodec(1, 1).encode(message))
    return decoded


class Autopilot:
    """Answers TIMESYNC after the line's delays, from a clock of its own."""

    def __init__(self, delay: Delay, ppm: float = 0.0) -> None:
        self.sync = ClockSync()
        self.delay = delay
        self.ppm = ppm
        self.offset_s = OFFSET_S
        self.now_s = 0.0
        self._waiting: list[tuple[float, Message]] = []

    def clock_s(self, now_s: float) -> float:
        return (now_s + 5000.0) * (1.0 + 1e-6 * self.ppm) - 5000.0 - self.offset_s + 5000.0

    @property
    def error_s(self) -> float:
        offset_s = self.sync.offset_at_s(self.now_s)
        assert offset_s is not None
        return offset_s - (self.now_s - self.clock_s(self.now_s))

    def run(self, seconds: float) -> None:
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s += 0.05
            for due_s, message in [w for w in self._waiting if w[0] <= self.now_s]:
                self._waiting.remove((due_s, message))
                self.sync.receive(message, due_s)
            question = self.sync.due(self.now_s, 1, 1)
            if isinstance(question, TargetedTimesync):
                up_s, down_s = self.delay()
                tc1 = round(self.clock_s(self.now_s + up_s) * 1e9)
                answer = mavlink.MAVLink_timesync_message(tc1, question.ts1)
                self._waiting.append((self.now_s + up_s + down_s, received(answer)))


def constant(up_s: float, down_s: float) -> Delay:
    return lambda: (up_s, down_s)


def test_the_question_names_the_autopilot_and_our_time() -> None:
    question = ClockSync().due(2.5, 7, 1)
    assert question is not None
    decoded = received(question)
    assert isinstance(decoded, mavlink.MAVLink_timesync_message)
    assert (decoded.tc1, decoded.ts1) == (0, 2_500_000_000)
    assert targets_of_frame(bytes(decoded.get_msgbuf())) == (7, 1)


def test_the_offset_is_known_within_a_second() -> None:
    autopilot = Autopilot(constant(0.02, 0.02))
    autopilot.run(1.3)
    assert autopilot.sync.answered >= 10
    assert abs(autopilot.error_s) < 1e-6


@pytest.mark.parametrize(("up_s", "down_s"), [(0.0, 0.1), (0.1, 0.0), (0.2, 0.05)])
def test_unequal_ways_leave_half_of_their_difference(up_s: float, down_s: float) -> None:
    autopilot = Autopilot(constant(up_s, down_s))
    autopilot.run(5.0)
    assert abs(autopilot.error_s) == pytest.approx(abs(up_s - down_s) / 2.0, abs=1e-6)
    assert autopilot.sync.round_trip_s == pytest.approx(up_s + down_s)


def test_spikes_of_the_round_trip_are_left_out() -> None:
    rng = random.Random(5)

    def delay() -> tuple[float, float]:
        spike_s = rng.uniform(0.02, 0.5) if rng.random() < 0.4 else 0.0
        return (0.01, 0.01 + spike_s)

    autopilot = Autopilot(delay)
    autopilot.run(120.0)
    assert abs(autopilot.error_s) < 0.005
    assert autopilot.sync.slow > 30


def test_a_line_that_becomes_slow_for_good_is_followed() -> None:
    autopilot = Autopilot(constant(0.01, 0.01))
    autopilot.run(10.0)
    autopilot.delay = constant(0.06, 0.06)
    autopilot.run(BEST_OF + 5.0)
    assert autopilot.sync.round_trip_s == pytest.approx(0.12)


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-100.0, 100.0])
def test_drift_is_followed_for_hours(ppm: float) -> None:
    autopilot = Autopilot(constant(0.01, 0.01), ppm)
    autopilot.run(2.0)
    worst_s = 0.0
    for _ in range(240):
        autopilot.run(60.0)
        worst_s = max(worst_s, abs(autopilot.error_s))
    assert worst_s < 0.0015


def test_a_clock_that_jumped_is_believed_after_five_exchanges() -> None:
    autopilot = Autopilot(constant(0.01, 0.01))
    autopilot.run(20.0)
    answered = autopilot.sync.answered
    autopilot.offset_s += 3.0
    while autopilot.sync.resets == 0:
        autopilot.run(0.05)
    assert autopilot.sync.answered - answered == RESET_AFTER
    assert abs(autopilot.error_s) < 1e-3


def test_single_strange_exchanges_move_nothing() -> None:
    autopilot = Autopilot(constant(0.01, 0.01))
    autopilot.run(20.0)
    for _ in range(20):
        autopilot.offset_s += 3.0
        autopilot.run(PERIOD_S)
        autopilot.offset_s -= 3.0
        autopilot.run(1.0)
    assert abs(autopilot.error_s) < 1e-3
    assert autopilot.sync.resets == 0


@pytest.mark.parametrize(
    ("tc1", "ts1"), [(0, 1_000_000_000), (77, 5), (77, 0), (-1, 1_000_000_000)]
)
def test_what_is_no_answer_to_our_question_is_ignored(tc1: int, ts1: int) -> None:
    sync = ClockSync()
    sync.due(1.0, 1, 1)
    sync.receive(received(mavlink.MAVLink_timesync_message(tc1, ts1)), 1.01)
    assert sync.offset_at_s(1.1) is None


def test_an_answer_counts_once() -> None:
    sync = ClockSync()
    sync.due(1.0, 1, 1)
    answer = received(mavlink.MAVLink_timesync_message(10**12, 10**9))
    sync.receive(answer, 1.01)
    sync.receive(answer, 400.0)
    assert sync.answered == 1
    assert sync.offset_at_s(1.1) == pytest.approx(1.005 - 1000.0)


def test_unanswered_requests_are_not_kept() -> None:
    sync = ClockSync()
    for step in range(1000):
        sync.due(0.1 * step, 1, 1)
    assert len(sync._open) <= MAX_OPEN


def test_after_a_restart_it_begins_again() -> None:
    autopilot = Autopilot(constant(0.01, 0.01))
    autopilot.run(20.0)
    autopilot.sync.restart()
    assert autopilot.sync.offset_at_s(autopilot.now_s) is None
    autopilot.offset_s += 2000.0
    autopilot.run(1.3)
    assert abs(autopilot.error_s) < 1e-3


@pytest.mark.parametrize(
    ("up_s", "has_restarted"), [(0.1, True), (0.5, True), (10.0, False), (400.0, False)]
)
def test_only_a_clock_that_begins_again_is_one_that_restarted(
    up_s: float, has_restarted: bool
) -> None:
    """One that goes back and shows more time than has passed since then slipped."""
    autopilot = Autopilot(constant(0.2, 0.3))
    autopilot.run(20.0)
    assert not autopilot.sync.take_restart()
    autopilot.offset_s += autopilot.clock_s(autopilot.now_s) - up_s
    autopilot.run(PERIOD_S + 0.6)
    assert autopilot.sync.take_restart() is has_restarted
    autopilot.run(10.0)
    assert not autopilot.sync.take_restart()


def test_an_answer_that_was_overtaken_is_no_clock_that_goes_back() -> None:
    delays = iter([(0.001, 2.0), (0.001, 0.001)] * 100)
    autopilot = Autopilot(lambda: next(delays))
    autopilot.run(30.0)
    assert not autopilot.sync.take_restart()


@pytest.mark.parametrize("way_s", [0.5, 1.0])
def test_a_line_with_long_ways_is_synchronised_too(way_s: float) -> None:
    autopilot = Autopilot(constant(way_s, way_s))
    autopilot.run(5.0)
    assert abs(autopilot.error_s) < 0.05


def test_a_line_that_answers_late_or_no_more_is_late() -> None:
    line = Autopilot(constant(0.1, 0.1))
    assert (
        line.sync.lateness(line.now_s) is Lateness.NONE
    )  # without an answer there is no sign of one
    line.run(5.0)
    assert line.sync.lateness(line.now_s) is Lateness.NONE
    line.delay = constant(0.1, 6.0)
    line.run(5.0)
    assert line.sync.lateness(line.now_s) is Lateness.UNKNOWN
    line.run(10.0)
    assert line.sync.lateness(line.now_s) is Lateness.SLOW
    line.delay = constant(0.1, 0.1)
    line.run(1.0)
    assert line.sync.lateness(line.now_s) is Lateness.NONE
