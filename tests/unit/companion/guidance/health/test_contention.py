"""A second source of setpoints, setpoints that do not arrive, and links that only look so."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from companion.domain import PositionEnu
from companion.guidance.control_authority import Finding, Reason, Verdict
from companion.guidance.events import SetpointEchoed
from companion.guidance.health.contention import TOLERANCE_M, EchoWatch

TICK_S = 0.05
ECHO_S = 0.1
SPEED_MPS = 5.0
FOREIGN: PositionEnu = (80.0, -40.0, 15.0)


class Line:
    """Our setpoints to an autopilot that obeys the newest it got, and its echoes back to us."""

    def __init__(self, loss: float = 0.0, latency_s: float = 0.0, seed: int = 1) -> None:
        self.watch = EchoWatch()
        self.now_s = 0.0
        self.intruder_hz = 0.0
        self.intruder_share = 1.0
        """Share of a tick in which its setpoint stands before ours replaces it."""
        self.is_uplink_up = self.is_echo_up = True
        self.is_moving = True
        self.is_sending = True
        self.findings: list[tuple[float, Finding]] = []
        self._loss, self._latency_s = loss, latency_s
        self._rng = np.random.default_rng(seed)
        self._up: deque[tuple[float, PositionEnu]] = deque()
        self._down: deque[tuple[float, PositionEnu]] = deque()
        self._target: PositionEnu | None = None
        self._ticks = 0
        self._path_m = 0.0

    def run(self, duration_s: float) -> None:
        if not self._ticks:
            self.watch.begin(0.0)
        for _ in range(round(duration_s / TICK_S)):
            self._ticks += 1
            self.now_s = self._ticks * TICK_S
            self._carry()
            finding = self.watch.step(self.now_s)
            if finding is not None:
                self.findings.append((self.now_s, finding))
            if self.is_moving:
                self._path_m += SPEED_MPS * TICK_S
            if not self.is_sending:
                continue
            position = self._position()
            self.watch.note_setpoint(position, self.now_s)
            if self.is_uplink_up and self._rng.random() >= self._loss:
                self._up.append((self.now_s + self._latency_s, position))

    def _position(self) -> PositionEnu:
        """A zigzag, as planners fly."""
        leg, along = divmod(self._path_m, 40.0)
        return (along if leg % 2 == 0 else 40.0 - along, 3.0 * leg, 20.0)

    def _carry(self) -> None:
        while self._up and self._up[0][0] <= self.now_s:
            self._target = self._up.popleft()[1]
        is_intruded = self.intruder_hz * TICK_S > self._rng.random()
        if is_intruded and (self.intruder_share == 1.0 or self._stands()):
            self._target = FOREIGN
        is_due = self.is_echo_up and self._ticks % round(ECHO_S / TICK_S) == 0
        if is_due and self._target is not None and self._rng.random() >= self._loss:
            self._down.append((self.now_s + self._latency_s, self._target))
        while self._down and self._down[0][0] <= self.now_s:
            self.watch.handle(SetpointEchoed(self.now_s, self._down.popleft()[1]))

    def _stands(self) -> bool:
        """Return True if an echo at a random time in the tick shows the intruder's setpoint."""
        return self._rng.random() < self.intruder_share

    @property
    def reasons(self) -> set[Reason]:
        return {finding.reason for _, finding in self.findings}

    def first(self, verdict: Verdict) -> float:
        """Return the time of the first verdict of a kind; infinite without one."""
        return min((at for at, f in self.findings if f.verdict is verdict), default=math.inf)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("loss", "latency_s"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.5), (0.1, 0.5)])
def test_a_bad_link_is_no_second_source(loss: float, latency_s: float, seed: int) -> None:
    line = Line(loss, latency_s, seed)
    for _ in range(10):
        line.run(20.0)
        line.is_moving = not line.is_moving
    assert line.findings == []


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("intruder_hz", [5.0, 10.0, 20.0])
@pytest.mark.parametrize(("loss", "latency_s"), [(0.0, 0.0), (0.3, 0.5)])
def test_a_second_source_is_held_on_for_a_second_and_then_given_way_to(
    loss: float, latency_s: float, intruder_hz: float, seed: int
) -> None:
    line = Line(loss, latency_s, seed)
    line.run(10.0)
    line.intruder_hz = intruder_hz
    began_s = line.now_s
    line.run(20.0)
    hold_s, way_s = line.first(Verdict.HOLD), line.first(Verdict.YIELD)
    assert line.reasons == {Reason.SECOND_SOURCE}
    assert hold_s - began_s <= 4.0 + 2.0 * latency_s
    assert 1.0 <= way_s - hold_s <= 3.0


def test_a_second_source_that_stops_is_forgotten() -> None:
    line = Line()
    line.run(10.0)
    line.intruder_hz = 20.0
    line.run(0.8)
    line.intruder_hz = 0.0
    line.run(6.0)
    assert line.first(Verdict.YIELD) == math.inf
    assert line.watch.step(line.now_s) is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("intruder_hz", [1.0, 2.0])
def test_a_slow_source_of_which_few_echoes_tell_is_given_way_to(
    intruder_hz: float, seed: int
) -> None:
    line = Line(seed=seed)
    line.run(10.0)
    line.intruder_share, line.intruder_hz = 0.5, intruder_hz
    began_s = line.now_s
    line.run(45.0)
    assert line.reasons == {Reason.SECOND_SOURCE}
    assert line.first(Verdict.HOLD) - began_s <= 30.0 / intruder_hz
    assert line.first(Verdict.YIELD) - began_s <= 40.0 / intruder_hz


def test_echoes_just_beside_our_way_now_and_then_are_no_source() -> None:
    line = Line()
    for _ in range(40):
        line.run(2.5)
        beside = (line._position()[0], line._position()[1], 20.0 + 1.1 * TOLERANCE_M)
        line.watch.handle(SetpointEchoed(line.now_s, beside))
    assert line.findings == []


def test_a_slow_source_that_stops_is_not_held_on_for_longer_than_it_was_there() -> None:
    line = Line()
    line.run(10.0)
    for _ in range(3):
        line.watch.handle(SetpointEchoed(line.now_s, FOREIGN))
        line.run(4.0)
    assert line.watch.step(line.now_s) is not None
    line.run(5.0)
    assert line.watch.step(line.now_s) is None
    assert line.first(Verdict.YIELD) == math.inf


def test_one_foreign_echo_is_no_source() -> None:
    line = Line()
    line.run(10.0)
    line.watch.handle(SetpointEchoed(line.now_s, FOREIGN))
    line.run(5.0)
    assert line.findings == []


def test_a_target_that_is_no_position_is_foreign() -> None:
    line = Line()
    line.run(10.0)
    line.is_echo_up = False
    for _ in range(10):
        line.watch.handle(SetpointEchoed(line.now_s, None))
        line.run(0.1)
    assert Reason.SECOND_SOURCE in line.reasons


def test_setpoints_that_do_not_arrive_are_noticed_within_two_seconds() -> None:
    line = Line()
    line.run(10.0)
    line.is_uplink_up = False
    cut_s = line.now_s
    line.run(5.0)
    assert line.reasons == {Reason.SETPOINTS_LOST}
    assert line.findings[0][0] - cut_s <= 2.5
    line.is_uplink_up = True
    line.run(1.0)
    assert line.watch.step(line.now_s) is None


def test_echoes_that_stop_are_noticed_within_two_seconds() -> None:
    line = Line()
    line.run(10.0)
    line.is_echo_up = False
    cut_s = line.now_s
    line.run(5.0)
    assert line.reasons == {Reason.NO_ECHO}
    assert line.findings[0][0] - cut_s <= 2.2


def test_an_autopilot_that_never_echoes_is_flown() -> None:
    line = Line()
    line.is_echo_up = False
    line.run(60.0)
    assert line.findings == []


def test_what_was_flown_before_control_began_is_not_held_against_it() -> None:
    watch = EchoWatch()
    watch.begin(100.0)
    for tick in range(40):
        now_s = 100.0 + TICK_S * tick
        watch.note_setpoint((0.0, 0.0, 20.0), now_s)
        watch.handle(SetpointEchoed(now_s, FOREIGN))
        assert watch.step(now_s) is None


def test_a_frame_that_moved_begins_again() -> None:
    line = Line()
    line.run(10.0)
    line.watch.frame_moved(line.now_s)
    for _ in range(20):
        line.watch.handle(SetpointEchoed(line.now_s, FOREIGN))
        line.now_s += 0.05
    assert line.watch.step(line.now_s) is None


def test_what_the_autopilot_follows_while_we_pause_is_no_second_source() -> None:
    """ArduPilot in GUIDED without setpoints echoes the position where it stopped."""
    line = Line()
    line.run(10.0)
    line.is_sending = False
    line.run(0.6)
    line._target = FOREIGN
    line.run(3.0)
    line.is_sending = True
    line.run(10.0)
    assert line.findings == []


def test_a_second_source_that_began_during_a_pause_is_found() -> None:
    line = Line()
    line.run(10.0)
    line.is_sending = False
    line.intruder_hz = 10.0
    line.run(3.0)
    line.is_sending = True
    line.run(6.0)
    assert line.findings[-1][1].verdict is Verdict.YIELD


def test_only_a_single_foreign_target_is_reported_as_replaced() -> None:
    line = Line()
    line.run(5.0)
    line.watch.handle(SetpointEchoed(line.now_s, FOREIGN))
    assert line.watch.take_far_echo()

    line.intruder_hz = 20.0
    line.run(3.0)
    assert any(finding.reason is Reason.SECOND_SOURCE for _, finding in line.findings)
    line.watch.handle(SetpointEchoed(line.now_s, FOREIGN))
    assert not line.watch.take_far_echo()
