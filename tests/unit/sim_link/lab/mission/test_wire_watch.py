"""Records of real processes, dated and judged."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from sim_link.lab.mission.flight_readers import MACHINE_S, WireWatch
from sim_link.lab.mission.results import FlightRecord
from sim_link.lab.monitor.monitor import WIRE
from sim_link.lab.observer import Frame, Lane, Observer


class Dates(Observer):
    """Times of what was recorded."""

    def __init__(self) -> None:
        self.noted_s: list[tuple[object, float]] = []

    def noted(self, kind: object, fields: object, now_s: float) -> None:  # noqa: ARG002
        self.noted_s.append((kind, now_s))


def test_the_log_of_every_process_is_dated_by_its_own_clock() -> None:
    watch, dates = WireWatch(1.0), Dates()
    watch.noted("a", {}, 5.0)
    watch.date_events(2.0)
    watch.noted("b", {}, 0.5)
    watch.date_events(8.0)
    watch.noted("never read", {}, 0.5)
    watch.date_events(None)
    watch.recording.play(dates)
    assert dates.noted_s == [("a", 7.0), ("b", 8.5)]


def test_limits_are_wider_by_what_the_machine_was_late() -> None:
    watch = WireWatch(4.0)
    assert watch.slack_s == 4.0 * MACHINE_S
    for now_s in (0.0, 0.1, 0.2, 0.8, 0.9):
        watch.looked(now_s)
    assert watch.slack_s == pytest.approx(4.0 * MACHINE_S + 0.5)
    record = FlightRecord()
    watch.judge(CompanionConfig(), record)
    assert record.late_s == pytest.approx(0.5)


def test_a_setting_of_a_parameter_is_found_in_the_record() -> None:
    watch, record = WireWatch(1.0), FlightRecord()
    message = mavlink.MAVLink_param_set_message(1, 1, b"MPC_XY_VEL_MAX", 20.0, 9)
    watch.recording.sent(Frame(3.0, MavCodec(1, 191).encode(message), Lane.TO_VEHICLE))
    watch.judge(CompanionConfig(), record)
    assert record.scope is WIRE
    assert record.slack_s == MACHINE_S
    assert [(each.time_s, each.invariant) for each in record.violations] == [(3.0, "I6")]
