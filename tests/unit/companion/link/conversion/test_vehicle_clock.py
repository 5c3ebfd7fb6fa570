"""The autopilot's clock as it really runs: slow, fast, slipping, standing still, restarted."""

from __future__ import annotations

import csv
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from companion.link.conversion.clock_sync import NO_RATE, ClockSync
from companion.link.conversion.sender_clock import (
    CLOCK_TOLERANCE_S,
    ClockStep,
    SenderClock,
    VehicleClock,
)
from companion.link.ranging_sources import MavlinkRanging
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.payloads import TargetedTimesync

RECORDED = Path(__file__).parents[4] / "data/clocks/arducopter_stopped.csv"
UP_S = 100.0
"""Time since the autopilot's boot when it was first heard."""
TICK_S = 0.05
DELAY_S = 0.004
ARDUPILOT_BACK_S = (0.005, 0.027)
"""Time by which an ArduCopter 4.5 dated its answers back."""
GOOD_S = 0.03
"""A reading that errs by less is good: a quarter of a metre at the fastest flight."""


@dataclass
class Reading:
    """One stamp, as it was read."""

    now_s: float
    error_s: float
    """Read minus true time of sending."""
    step: ClockStep


class Autopilot:
    """Stamps 20 times a second and answers TIMESYNC, by a clock that a test may bend."""

    def __init__(
        self,
        *,
        rate: float = 1.0,
        answers: bool = True,
        jitter_s: float = 0.0,
        dated_back_s: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.sync = ClockSync()
        self.clock = VehicleClock(self.sync)
        self.remote_s = UP_S
        self.rate = rate
        self.answers = answers
        self.now_s = 0.0
        self._rng = random.Random(7)
        self._jitter_s = jitter_s
        self._dated_back_s = dated_back_s
        self._answers: list[tuple[float, Message]] = []

    def run(self, seconds: float) -> list[Reading]:
        """Let time pass on both clocks."""
        return list(self._steps(self.now_s + seconds))

    def stand_still(self, seconds: float) -> None:
        """The process is held up: nothing is sent, and its clock does not go on."""
        self.now_s += seconds

    def _steps(self, until_s: float) -> Iterator[Reading]:
        while self.now_s < until_s:
            self.now_s += TICK_S
            self.remote_s += self.rate * TICK_S
            arrival_s = self.now_s + DELAY_S + self._rng.uniform(0.0, self._jitter_s)
            for due_s, answer in [a for a in self._answers if a[0] <= arrival_s]:
                self._answers.remove((due_s, answer))
                self.sync.receive(answer, due_s)
            self._ask()
            stamp_s = int(1000.0 * self.remote_s) / 1000.0
            reading = self.clock.read(stamp_s, arrival_s)
            yield Reading(self.now_s, reading.time_s - self.now_s, reading.step)

    def _ask(self) -> None:
        question = self.sync.due(self.now_s, 1, 1)
        if self.answers and isinstance(question, TargetedTimesync):
            way_s = DELAY_S + self._rng.uniform(0.0, self._jitter_s)
            back_s = self._rng.uniform(*self._dated_back_s) if any(self._dated_back_s) else 0.0
            tc1 = round(1e9 * (self.remote_s + self.rate * DELAY_S - back_s))
            answer = mavlink.MAVLink_timesync_message(tc1, question.ts1)
            self._answers.append((self.now_s + DELAY_S + way_s, answer))


def worst_s(readings: list[Reading]) -> float:
    return max(abs(reading.error_s) for reading in readings)


def steps(readings: list[Reading]) -> list[ClockStep]:
    return [reading.step for reading in readings if reading.step is not ClockStep.NONE]


@pytest.mark.parametrize("rate", [0.95, 0.988, 0.9999, 1.0, 1.05])
@pytest.mark.parametrize("jitter_s", [0.0, 0.02])
def test_a_clock_of_any_steady_rate_is_read_well_from_the_second_second_on(
    rate: float, jitter_s: float
) -> None:
    autopilot = Autopilot(rate=rate, jitter_s=jitter_s)
    autopilot.run(2.0)
    readings = autopilot.run(120.0)
    assert worst_s(readings) < GOOD_S
    assert steps(readings) == []


@pytest.mark.parametrize("rate", [0.95, 0.988, 1.05])
def test_without_an_exchange_the_rate_is_known_by_arrival(rate: float) -> None:
    autopilot = Autopilot(rate=rate, answers=False)
    autopilot.run(10.0)
    readings = autopilot.run(60.0)
    assert worst_s(readings) < GOOD_S
    assert steps(readings) == []


@pytest.mark.parametrize("dated_back_s", [(0.0, 0.0), ARDUPILOT_BACK_S])
@pytest.mark.parametrize("rate", [0.5, 0.9, 1.1, 2.0, 3.0])
def test_a_clock_at_another_pace_is_named(rate: float, dated_back_s: tuple[float, float]) -> None:
    autopilot = Autopilot(dated_back_s=dated_back_s)
    autopilot.run(20.0)
    assert autopilot.sync.pace.wrong(autopilot.now_s) is None
    autopilot.rate = rate
    autopilot.run(6.0)
    assert autopilot.sync.pace.wrong(autopilot.now_s) == pytest.approx(rate, abs=0.02)
    autopilot.rate = 1.0
    autopilot.run(6.0)
    assert autopilot.sync.pace.wrong(autopilot.now_s) is None
    assert worst_s(autopilot.run(10.0)) < 2.0 * GOOD_S


@pytest.mark.parametrize("seconds", [3.0, 6.0, 20.0])
def test_a_clock_that_is_ten_percent_slow_for_seconds_is_followed(seconds: float) -> None:
    autopilot = Autopilot()
    autopilot.run(20.0)
    autopilot.rate = 0.9
    autopilot.run(seconds)
    autopilot.rate = 1.0
    autopilot.run(2.0)
    assert worst_s(autopilot.run(30.0)) < 2.0 * GOOD_S


@pytest.mark.parametrize("piece_s", [-0.06, -0.7, 1.0])
def test_a_slip_is_no_pace(piece_s: float) -> None:
    autopilot = Autopilot()
    autopilot.run(20.0)
    autopilot.remote_s += piece_s
    for _ in range(12):
        autopilot.run(0.5)
        assert autopilot.sync.pace.wrong(autopilot.now_s) is None


def test_a_rate_that_changes_is_followed() -> None:
    """The computer of a simulated autopilot gets busy, and free again."""
    autopilot = Autopilot()
    autopilot.run(20.0)
    for rate in (0.988, 1.0, 0.97, 1.03):
        autopilot.rate = rate
        assert worst_s(autopilot.run(15.0)) < 2.0 * GOOD_S


@pytest.mark.parametrize("slip_s", [-30.0, -5.0, -2.0, -0.7, -0.3, 0.3, 1.0, 5.0, 30.0])
@pytest.mark.parametrize("rate", [1.0, 0.95])
def test_after_a_slip_all_is_well_within_two_seconds_without_a_restart(
    slip_s: float, rate: float
) -> None:
    autopilot = Autopilot(rate=rate)
    autopilot.run(20.0)
    autopilot.remote_s += slip_s
    during = autopilot.run(2.0)
    after = autopilot.run(30.0)
    assert worst_s(after) < GOOD_S
    assert not autopilot.clock.is_too_fast
    assert set(steps(during + after)) == {ClockStep.SLIP}


@pytest.mark.parametrize("up_s", [5.0, 7.0])
def test_a_clock_that_slips_soon_after_its_start_has_not_restarted_where_answers_are_prompt(
    up_s: float,
) -> None:
    autopilot = Autopilot()
    autopilot.remote_s = up_s - 4.0
    autopilot.run(4.0)
    autopilot.remote_s -= 2.0
    during = autopilot.run(2.0)
    assert worst_s(autopilot.run(30.0)) < GOOD_S
    assert set(steps(during)) == {ClockStep.SLIP}


@pytest.mark.parametrize("still_s", [0.2, 0.7, 1.2, 3.0, 12.0])
def test_a_clock_that_stood_still_is_one_that_slipped(still_s: float) -> None:
    autopilot = Autopilot()
    autopilot.run(20.0)
    autopilot.stand_still(still_s)
    during = autopilot.run(2.5)
    assert worst_s(autopilot.run(30.0)) < GOOD_S
    assert set(steps(during)) == {ClockStep.SLIP}


@pytest.mark.parametrize("rate", [0.95, 0.988, 1.0, 1.05])
def test_answers_that_are_dated_back_bend_no_stamp(rate: float) -> None:
    autopilot = Autopilot(rate=rate, dated_back_s=ARDUPILOT_BACK_S)
    autopilot.run(15.0)
    readings = autopilot.run(120.0)
    assert worst_s(readings) < DELAY_S + CLOCK_TOLERANCE_S
    assert steps(readings) == []


@pytest.mark.parametrize("still_s", [0.2, 0.5, 0.7, 1.2, 3.0, 12.0])
@pytest.mark.parametrize("seen_s", [4.0, 20.0])
def test_a_clock_that_stood_still_is_found_out_though_answers_are_dated_back(
    still_s: float, seen_s: float
) -> None:
    autopilot = Autopilot(dated_back_s=ARDUPILOT_BACK_S)
    autopilot.run(seen_s)
    autopilot.stand_still(still_s)
    during = autopilot.run(3.0)
    assert worst_s(autopilot.run(30.0)) < GOOD_S
    assert set(steps(during)) == {ClockStep.SLIP}


def test_answers_that_waited_do_not_pass_for_the_clock_after_a_slip() -> None:
    """ArduCopter 4.5.5 in simulation, stopped for 1.2 and 3 s, as its TIMESYNC and stamps came.

    One answer in five is dated back by 70 ms, and those that waited by up to a second.
    """
    sync = ClockSync()
    clock = VehicleClock(sync)
    true_offset_s, misread_s = math.inf, []
    with RECORDED.open(newline="") as file:
        for row in csv.DictReader(file):
            now_s, autopilot_s = float(row["received_s"]), float(row["autopilot_s"])
            if row["sent_s"]:
                sync._open.append(sent_ns := round(1e9 * float(row["sent_s"])))
                answer = mavlink.MAVLink_timesync_message(round(1e9 * autopilot_s), sent_ns)
                sync.receive(answer, now_s)
                continue
            true_offset_s = now_s - autopilot_s
            if now_s > 4.0 and abs(clock.read(autopilot_s, now_s).time_s - now_s) > GOOD_S:
                misread_s.append(now_s)
    resumed_s = (misread_s[0], next(s for s in misread_s if s > misread_s[0] + 6.0))
    assert all(any(0.0 <= s - each_s < 2.5 for each_s in resumed_s) for s in misread_s)
    assert clock.offset_at_s(now_s) == pytest.approx(true_offset_s, abs=GOOD_S)
    assert clock.slips >= 2


@pytest.mark.parametrize("dated_back_s", [(0.0, 0.0), ARDUPILOT_BACK_S])
def test_a_slip_that_comes_in_pieces_is_followed(dated_back_s: tuple[float, float]) -> None:
    autopilot = Autopilot(dated_back_s=dated_back_s)
    autopilot.run(20.0)
    for piece_s, after_s in ((0.06, 0.3), (0.2, 0.15), (1.1, 0.0)):
        autopilot.stand_still(piece_s)
        autopilot.run(after_s)
    during = autopilot.run(3.0)
    assert worst_s(autopilot.run(30.0)) < GOOD_S
    assert set(steps(during)) == {ClockStep.SLIP}


def test_slips_at_any_time_are_followed_one_after_the_other() -> None:
    autopilot, rng = Autopilot(jitter_s=0.01), random.Random(3)
    autopilot.run(5.0)
    for _ in range(40):
        autopilot.remote_s += rng.choice([-2.0, -0.7, 1.0, 5.0])
        autopilot.run(rng.uniform(3.0, 6.0))
        assert worst_s(autopilot.run(1.0)) < GOOD_S


def test_a_slip_soon_after_another_ends_its_wildness_as_soon() -> None:
    autopilot = Autopilot(rate=0.95)
    autopilot.run(20.0)
    for _ in range(2):
        autopilot.remote_s += 5.0
        during = autopilot.run(1.5)
        assert steps(during) == [ClockStep.SLIP]
        assert not autopilot.clock.is_too_fast


def test_a_restart_is_still_a_restart() -> None:
    autopilot = Autopilot()
    autopilot.run(20.0)
    autopilot.stand_still(3.0)
    autopilot.remote_s = 0.5
    seen = steps(autopilot.run(3.0))
    assert seen[0] is ClockStep.RESTART or autopilot.sync.take_restart()
    assert ClockStep.SLIP not in seen


@pytest.mark.parametrize("late_s", [0.2, 0.5, 3.0])
def test_a_link_that_becomes_late_for_good_is_no_clock_that_slipped(late_s: float) -> None:
    """Late stamps that are read as fresh would make it fly on positions of the past."""
    autopilot = Autopilot()
    autopilot.run(20.0)
    clock = autopilot.clock
    autopilot.answers = False  # they are late, too, and say nothing
    for step in range(400):
        autopilot.now_s += TICK_S
        autopilot.remote_s += TICK_S
        reading = clock.read(autopilot.remote_s, autopilot.now_s + late_s)
        assert reading.step is ClockStep.NONE
        error_s = reading.time_s - autopilot.now_s
        assert abs(error_s) < GOOD_S, step


@pytest.mark.parametrize(("up_s", "down_s"), [(0.0, 0.5), (0.0, 2.0), (1.0, 0.0), (0.3, 0.3)])
def test_a_link_that_is_late_one_way_shows_no_slip_and_no_younger_stamps(
    up_s: float, down_s: float
) -> None:
    """An exchange over it is off by half of the difference, for good."""
    autopilot = Autopilot()
    autopilot.run(20.0)
    waiting: list[tuple[float, float, Message | None]] = []
    for _ in range(1200):
        autopilot.now_s += TICK_S
        autopilot.remote_s += TICK_S
        now_s, way_s = autopilot.now_s, down_s + DELAY_S
        waiting.append((now_s + way_s, now_s, None))
        question = autopilot.sync.due(now_s, 1, 1)
        if isinstance(question, TargetedTimesync):
            tc1 = round(1e9 * (autopilot.remote_s + up_s + DELAY_S))
            answer = mavlink.MAVLink_timesync_message(tc1, question.ts1)
            waiting.append((now_s + up_s + DELAY_S + way_s, now_s, answer))
        for arrival in sorted((w for w in waiting if w[0] <= now_s), key=lambda w: w[0]):
            waiting.remove(arrival)
            arrived_s, sent_s, message = arrival
            if message is not None:
                autopilot.sync.receive(message, arrived_s)
                continue
            reading = autopilot.clock.read(sent_s + UP_S, arrived_s)
            assert reading.step is ClockStep.NONE
            assert reading.time_s - sent_s < GOOD_S


def late_by_steps(step: int) -> float:
    return 0.2 if step > 300 else 0.0


def late_by_bursts(step: int) -> float:
    return max(0.0, 1.0 - 0.05 * (step % 100)) if step > 100 else 0.0


@pytest.mark.parametrize("late", [late_by_steps, late_by_bursts])
def test_a_radio_whose_link_gets_slower_keeps_its_rate(late: Callable[[int], float]) -> None:
    clock = SenderClock()
    for step in range(1200):
        now_s = TICK_S * step
        reading = clock.read(UP_S + now_s, now_s + late(step))
        assert abs(reading.time_s - now_s) < GOOD_S
    assert clock.timebase.rate == NO_RATE


def test_a_radio_on_its_clock_stays_on_it_through_small_losses_and_a_stop() -> None:
    """ArduCopter on a busy computer: then it stopped for 1 s, and no range was used for 20 s."""
    autopilot = Autopilot(jitter_s=0.01)
    source = MavlinkRanging(MavCodec(1, 191), autopilot.clock)
    errors_s: dict[str, float] = {}

    def hear(name: str, seconds: float) -> None:
        for _ in range(round(seconds / 0.2)):
            autopilot.run(0.2)
            stamp_us, sent_s = round(1e6 * autopilot.remote_s), autopilot.now_s
            nan = math.nan
            radio = MAVLink_radio_ranging_message(
                stamp_us, 80.0, 1.0, nan, nan, nan, nan, 7, 255, 0
            )
            (heard,) = source.receive(MavCodec(1, 158).encode(radio), sent_s + 0.04)
            errors_s[name] = abs(heard.measured_at_s - sent_s)

    hear("steady", 5.0)
    for lost_s in (0.09, 0.05, 0.02):
        autopilot.stand_still(lost_s)
        hear("busy", 10.0)
    autopilot.stand_still(1.0)
    hear("after the stop", 5.0)
    assert max(errors_s.values()) < GOOD_S + CLOCK_TOLERANCE_S, errors_s
