"""The autopilot's reports of its own health, and their consequences."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, BatteryLevel, FlightMode
from companion.guidance.control_authority import Finding, Reason, Verdict
from companion.guidance.events import (
    BatteryReported,
    EstimatorStatusReported,
    FixReported,
    HeartbeatReceived,
)
from companion.guidance.health.autopilot_health import RECEIVER_S, BatteryWatch, HealthWatch

STEP_S = 0.2


def heartbeat(time_s: float, *, is_failsafe: bool) -> HeartbeatReceived:
    return HeartbeatReceived(
        time_s, Autopilot.ARDUPILOT, FlightMode.OFFBOARD, True, True, is_failsafe
    )


def times(
    watch: HealthWatch,
    *,
    worst: float = 0.1,
    has_fix: bool = True,
    has_second: bool = False,
    for_s: float = 10.0,
) -> dict[tuple[Reason, Verdict], float]:
    """Report the same for a while; when each finding came first."""
    first: dict[tuple[Reason, Verdict], float] = {}
    for number in range(round(for_s / STEP_S)):
        now_s = 100.0 + STEP_S * number
        watch.handle(EstimatorStatusReported(now_s, worst))
        watch.handle(FixReported(now_s, has_fix))
        if has_second:
            watch.handle(FixReported(now_s, True, 1))
        for finding in only(watch, now_s):
            first.setdefault((finding.reason, finding.verdict), now_s - 100.0)
    return first


def only(watch: HealthWatch, now_s: float) -> list[Finding]:
    worst = watch.step(now_s)
    return [] if worst is None else [worst]


def test_a_healthy_autopilot_is_flown() -> None:
    assert times(HealthWatch(BatteryWatch(20.0, 10.0))) == {}


@pytest.mark.parametrize("worst", [1.0, 1.9, 50.0])
def test_a_filter_that_doubts_is_held_on_after_a_second_and_handed_back_after_five(
    worst: float,
) -> None:
    first = times(HealthWatch(BatteryWatch(20.0, 10.0)), worst=worst)
    assert first[Reason.ESTIMATOR_POOR, Verdict.HOLD] == pytest.approx(1.0, abs=0.01)
    assert first[Reason.ESTIMATOR_POOR, Verdict.HAND_BACK] == pytest.approx(5.2, abs=0.01)


def test_a_short_doubt_changes_nothing() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    assert times(watch, worst=1.5, for_s=0.9) == {}
    for number in range(20):
        watch.handle(EstimatorStatusReported(101.0 + STEP_S * number, 0.2))
        assert only(watch, 101.0 + STEP_S * number) == []


def test_a_lost_fix_is_held_on_at_once_and_handed_back_after_five_seconds() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    watch.handle(FixReported(99.0, True))
    first = times(watch, has_fix=False)
    assert first[Reason.NO_FIX, Verdict.HOLD] == 0.0
    assert first[Reason.NO_FIX, Verdict.HAND_BACK] == pytest.approx(5.2, abs=0.01)


def test_a_receiver_of_two_may_lose_its_fix() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    for receiver in (0, 1):
        watch.handle(FixReported(99.0, True, receiver))
    assert times(watch, has_fix=False, has_second=True) == {}
    watch.handle(FixReported(110.0, False, 1))
    assert [finding.reason for finding in only(watch, 110.0)] == [Reason.NO_FIX]


def test_a_receiver_that_is_silent_has_no_fix_any_more() -> None:
    """Its last report was good, and it was unplugged."""
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    for receiver in (0, 1):
        watch.handle(FixReported(99.0, True, receiver))
    first = times(watch, has_fix=False)
    assert first[Reason.NO_FIX, Verdict.HOLD] == pytest.approx(RECEIVER_S - 1.0, abs=0.3)


@pytest.mark.parametrize(
    ("lasted_s", "verdict"), [(1.0, Verdict.HOLD), (9.9, Verdict.HOLD), (10.5, Verdict.SLOW)]
)
def test_without_gnss_the_estimators_own_position_is_flown_on_after_dead_reckoning(
    lasted_s: float, verdict: Verdict
) -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    watch.handle(FixReported(99.0, True))
    watch.handle(FixReported(100.0, False))
    watch.handle(EstimatorStatusReported(100.0 + lasted_s, 0.2, has_position=True))
    (finding,) = only(watch, 100.0 + lasted_s)
    assert finding.verdict is verdict


def test_an_estimator_without_a_position_is_held_on_and_handed_back() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    watch.handle(EstimatorStatusReported(100.0, 0.1, has_position=False))
    assert only(watch, 100.0)[0].verdict is Verdict.HOLD
    watch.handle(EstimatorStatusReported(105.5, 0.1, has_position=False))
    assert only(watch, 105.5)[0].verdict is Verdict.HAND_BACK


def test_a_vehicle_that_never_had_a_fix_flies_without() -> None:
    assert times(HealthWatch(BatteryWatch(20.0, 10.0)), has_fix=False) == {}


def test_trouble_ends_after_a_second_without() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    times(watch, worst=1.5, for_s=3.0)
    watch.handle(EstimatorStatusReported(103.0, 0.2))
    assert only(watch, 103.5) != []
    watch.handle(EstimatorStatusReported(103.6, 1.5))
    assert only(watch, 104.2) != []
    watch.handle(EstimatorStatusReported(104.4, 0.2))
    assert only(watch, 105.3) != []
    assert only(watch, 105.5) == []


def test_a_failsafe_raised_in_flight_is_held_on_until_it_is_over() -> None:
    battery = BatteryWatch(20.0, 10.0)
    watch = HealthWatch(battery)
    watch.handle(heartbeat(10.0, is_failsafe=False))
    watch.begin(10.0)
    watch.handle(heartbeat(20.0, is_failsafe=True))
    (finding,) = only(watch, 21.0)
    assert (finding.verdict, finding.reason) == (Verdict.HOLD, Reason.FAILSAFE)
    for _ in range(2):
        battery.handle(BatteryReported(20.9, 15.0, BatteryLevel.UNKNOWN))
    assert watch.step(21.0) is None
    watch.handle(heartbeat(22.0, is_failsafe=False))
    assert only(watch, 22.0) == []


def test_a_failsafe_that_was_there_when_control_was_given_is_the_operators() -> None:
    watch = HealthWatch(BatteryWatch(20.0, 10.0))
    watch.handle(heartbeat(10.0, is_failsafe=True))
    watch.begin(10.0)
    assert only(watch, 11.0) == []
    watch.handle(heartbeat(12.0, is_failsafe=False))
    watch.handle(heartbeat(13.0, is_failsafe=True))
    assert only(watch, 14.0) != []
