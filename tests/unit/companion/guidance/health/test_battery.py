"""Low, critical and unknown charge."""

from __future__ import annotations

import pytest

from companion.domain import BatteryLevel, FlightMode
from companion.guidance.control_authority import Verdict
from companion.guidance.events import BatteryReported
from companion.guidance.health.autopilot_health import BatteryWatch


def watch_at(
    charge_pct: float | None, level: BatteryLevel = BatteryLevel.UNKNOWN, reports: int = 2
) -> BatteryWatch:
    watch = BatteryWatch(low_pct=20.0, critical_pct=10.0)
    for number in range(reports):
        watch.handle(BatteryReported(float(number), charge_pct, level))
    return watch


@pytest.mark.parametrize(
    ("charge_pct", "said", "expected"),
    [
        (80.0, BatteryLevel.GOOD, BatteryLevel.GOOD),
        (20.0, BatteryLevel.GOOD, BatteryLevel.LOW),
        (10.0, BatteryLevel.LOW, BatteryLevel.CRITICAL),
        (50.0, BatteryLevel.CRITICAL, BatteryLevel.CRITICAL),
        (None, BatteryLevel.LOW, BatteryLevel.LOW),
        (None, BatteryLevel.UNKNOWN, BatteryLevel.UNKNOWN),
        (0.0, BatteryLevel.UNKNOWN, BatteryLevel.CRITICAL),
    ],
)
def test_the_worse_of_charge_and_state_counts(
    charge_pct: float | None, said: BatteryLevel, expected: BatteryLevel
) -> None:
    assert watch_at(charge_pct, said).level is expected


def test_unknown_is_not_full() -> None:
    assert watch_at(None).level is BatteryLevel.UNKNOWN
    assert watch_at(None).charge_pct is None


def test_one_report_is_not_believed() -> None:
    watch = watch_at(80.0)
    watch.handle(BatteryReported(5.0, 3.0, BatteryLevel.CRITICAL))
    levels = [watch.level]
    watch.handle(BatteryReported(6.0, 79.0, BatteryLevel.GOOD))
    watch.handle(BatteryReported(7.0, 3.0, BatteryLevel.CRITICAL))
    levels.append(watch.level)
    watch.handle(BatteryReported(8.0, 3.0, BatteryLevel.CRITICAL))
    levels.append(watch.level)
    assert levels == [BatteryLevel.GOOD, BatteryLevel.GOOD, BatteryLevel.CRITICAL]


def test_critical_is_handed_back_once_in_a_flight() -> None:
    watch = watch_at(5.0)
    finding = watch.step(0.0)
    assert finding is not None
    assert (finding.verdict, finding.mode) == (Verdict.HAND_BACK, FlightMode.RETURN)
    watch.note_handback()
    finding = watch.step(0.0)
    assert finding is not None
    assert finding.verdict is Verdict.HOLD
    watch.note_flight_end()
    finding = watch.step(0.0)
    assert finding is not None
    assert finding.verdict is Verdict.HAND_BACK


def test_low_ends_a_mission_once_in_a_flight() -> None:
    watch = watch_at(15.0)
    assert watch.step(0.0) is None
    assert watch.ends_mission
    watch.note_mission_end()
    assert not watch.ends_mission
    watch.note_flight_end()
    assert watch.ends_mission


def test_other_charges_count_from_the_next_two_reports_on() -> None:
    watch = watch_at(30.0)
    watch.set_thresholds(low_pct=40.0, critical_pct=35.0)
    levels = [watch.level]
    for time_s in (2.0, 3.0):
        watch.handle(BatteryReported(time_s, 30.0, BatteryLevel.GOOD))
        levels.append(watch.level)
    assert levels == [BatteryLevel.GOOD, BatteryLevel.GOOD, BatteryLevel.CRITICAL]
    watch.set_thresholds(low_pct=40.0, critical_pct=10.0)
    for time_s in (4.0, 5.0):
        watch.handle(BatteryReported(time_s, 30.0, BatteryLevel.GOOD))
    assert watch.level is BatteryLevel.LOW
