"""Flights judged by frames and log alone, as those of real processes are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.incidents import PilotMode
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.faults.fault_models import (
    CompanionKilled,
    CompanionStalled,
    LinkBlackout,
    Schedule,
)
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.monitor import LOCKSTEP, TITLES, WIRE
from sim_link.lab.monitor.scene import InvariantViolation
from sim_link.lab.monitor.wire_monitor import Recording, WireMonitor
from sim_link.lab.observer import Frame, Lane
from tests.planted_companions import DEFECTS, Planted, maker
from tools.campaign.flights import monitored_flight

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
SCHEDULE = Schedule(
    faults=(
        LinkBlackout(start_s=3.0, duration_s=2.0, direction="to_companion"),
        PilotMode(start_s=12.0, mode=FlightMode.HOLD),
    )
)
SLACK_S = 0.25
LITTLE_S = 0.05
JUDGED_DEFECTS = [defect for defect in DEFECTS if defect.invariant in WIRE.judged]


class Late(Recording):
    """Every frame passes the recorder a little later than it was sent, as in another process."""

    def sent(self, frame: Frame) -> None:
        super().sent(replace(frame, time_s=frame.time_s + 0.03 * (frame.data[4] % 5)))


def recorded(
    defect: type[Planted] | None = None,
    *,
    flavour: Any = "ardupilot",
    schedule: Schedule = SCHEDULE,
    recording: Recording | None = None,
) -> Recording:
    """Half a minute with a blind spell and a pilot who takes over, as a hub would see it."""
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    make = None if defect is None else maker(defect)
    around = monitored_flight(AUTO, scenario, 1, make_companion=make)
    kept = Recording() if recording is None else recording
    around.flight.observers.append(kept)
    around.flight.run(18.0)
    around.injector.inject(schedule)
    around.flight.run(18.0)
    return kept


def judged(recording: Recording, slack_s: float = SLACK_S) -> list[InvariantViolation]:
    monitor = WireMonitor(rules_of(AUTO), slack_s)
    recording.play(monitor)
    return monitor.violations


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_the_genuine_companion_breaks_nothing(flavour: str) -> None:
    assert judged(recorded(flavour=flavour)) == []


@pytest.mark.slow
def test_frames_that_pass_late_break_nothing() -> None:
    assert judged(recorded(recording=Late())) == []


@pytest.mark.slow
@pytest.mark.parametrize("fault", [CompanionKilled(down_s=2.0), CompanionStalled(duration_s=2.0)])
def test_a_process_that_stops_and_comes_back_breaks_nothing(fault: Any) -> None:
    assert judged(recorded(schedule=Schedule(faults=(fault,)))) == []


@pytest.mark.slow
@pytest.mark.parametrize("defect", JUDGED_DEFECTS)
def test_a_planted_bug_is_found(defect: type[Planted]) -> None:
    found = judged(recorded(defect), LITTLE_S)
    assert defect.invariant in {violation.invariant for violation in found}


def test_most_planted_bugs_can_be_found_without_the_truth() -> None:
    assert len(JUDGED_DEFECTS) >= 8


@pytest.mark.slow
def test_a_mode_that_came_back_may_be_flown_in_again() -> None:
    again = Schedule(
        faults=(
            PilotMode(start_s=2.0, mode=FlightMode.HOLD),
            PilotMode(start_s=8.0, mode=FlightMode.OFFBOARD),
        )
    )
    assert judged(recorded(schedule=again)) == []


def walked(monitor: WireMonitor, speeds_mps: list[float], periods_s: list[float]) -> None:
    """Setpoints eastwards from the vehicle, after every period, at a speed for 0.2 s at most."""
    east_m, time_s = 0.0, 10.0
    mavlink_home = mavlink.MAVLink_gps_global_origin_message(473977418, 85455939, 488000)
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3)
    here = mavlink.MAVLink_local_position_ned_message(10_000, 0.0, 0.0, -30.0, 0.0, 0.0, 0.0)
    for message in (beat, mavlink_home, here):
        monitor.vehicle_sent(frame(message, time_s))
        monitor.heard(frame(message, time_s))
    for speed_mps, period_s in zip(speeds_mps, periods_s, strict=True):
        time_s += period_s
        east_m += speed_mps * min(period_s, 0.2)
        setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
            round(time_s * 1e3), 1, 1, 1, 0xDF8, 0.0, east_m, -30.0, *[0.0] * 8
        )
        monitor.sent(frame(setpoint, time_s, 1, 191))


def test_a_tick_that_comes_late_is_no_braking_and_what_follows_no_acceleration() -> None:
    monitor = WireMonitor(rules_of(AUTO), LITTLE_S)
    walked(monitor, [4.0] * 8, [0.05] * 4 + [0.3] + [0.05] * 3)
    assert [v for v in monitor.violations if "fast" in v.what] == []


def test_a_setpoint_that_accelerates_too_fast_is_found_in_spite_of_a_late_tick() -> None:
    monitor = WireMonitor(rules_of(AUTO), LITTLE_S)
    walked(monitor, [2.0] * 5 + [4.5] * 3, [0.05] * 4 + [0.3] + [0.05] * 3)
    assert "setpoint accelerates too fast" in {v.what for v in monitor.violations}


def in_control(monitor: WireMonitor, text: str) -> None:
    """A second of setpoints, then a text and silence, while the vehicle goes on in GUIDED."""
    walked(monitor, [0.0] * 20, [0.05] * 20)
    monitor.noted("phase", {"old": "standby", "new": "hold"}, 10.1)
    here = mavlink.MAVLink_local_position_ned_message(11_000, 0.0, 0.0, -30.0, 0.0, 0.0, 0.0)
    monitor.noted("text", {"severity": "warning", "text": text}, 11.05)
    for step in range(8):
        monitor.heard(frame(here, 11.05 + 0.1 * step))


def test_a_companion_that_stood_still_may_look_first_who_flies() -> None:
    monitor = WireMonitor(rules_of(AUTO), LITTLE_S)
    in_control(monitor, "control loop stalled 0.7 s: reacquiring state")
    assert [str(violation) for violation in monitor.violations] == []


def test_the_same_silence_without_a_reason_is_found() -> None:
    monitor = WireMonitor(rules_of(AUTO), LITTLE_S)
    in_control(monitor, "all is well")
    assert {violation.invariant for violation in monitor.violations} == {"I7"}


def test_a_stream_that_begins_again_after_a_late_tick_is_at_the_vehicle() -> None:
    monitor = WireMonitor(rules_of(AUTO), LITTLE_S)
    walked(monitor, [1.0] * 5 + [-4.0] + [0.0] * 2, [0.05] * 5 + [0.32] + [0.05] * 2)
    assert [v for v in monitor.violations if "fast" in v.what] == []


def frame(message: Message, time_s: float, system: int = 1, component: int = 1) -> Frame:
    return Frame(time_s, MavCodec(system, component).encode(message), Lane.TO_COMPANION)


def test_a_station_and_a_payload_are_no_vehicle() -> None:
    monitor = WireMonitor(rules_of(AUTO), SLACK_S)
    invalid = mavlink.MAV_AUTOPILOT_INVALID
    for system, component in ((255, 190), (1, 26), (7, 1)):
        monitor.vehicle_sent(
            frame(mavlink.MAVLink_heartbeat_message(6, invalid, 0, 0, 4, 3), 0.0, system, component)
        )
    assert monitor.scene.system_id is None
    monitor.vehicle_sent(frame(mavlink.MAVLink_heartbeat_message(2, 3, 128, 4, 4, 3), 1.0))
    assert monitor.scene.system_id == 1
    assert not monitor.scene.is_px4
    assert monitor.scene.is_flying


def test_a_covariance_in_the_log_is_judged() -> None:
    fields: dict[str, object] = {
        "state": "localised",
        "position_enu_m": [1.0, 2.0],
        "covariance_m2": [[1.0, 3.0], [3.0, 1.0]],
        "r95_m": 2.0,
    }
    monitor = WireMonitor(rules_of(AUTO), SLACK_S)
    monitor.noted("estimate", {**fields, "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}, 1.0)
    assert monitor.violations == []
    monitor.noted("estimate", fields, 2.0)
    monitor.noted("estimate", {**fields, "r95_m": None}, 3.0)
    assert [violation.invariant for violation in monitor.violations] == ["I9", "I9"]


@pytest.mark.parametrize("scope", [LOCKSTEP, WIRE])
def test_every_invariant_is_judged_or_not_and_the_reason_is_reported(scope: Any) -> None:
    assert list(TITLES) == [f"I{number}" for number in range(1, 14)]
    assert {*scope.judged} | {*scope.unjudged} == {*TITLES}
    assert not {*scope.judged} & {*scope.unjudged}
    assert all(scope.unjudged.values())
