"""Ranging that ages, is lost and comes back; a link and a position that do the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

from companion.config.schema import PlannerConfig
from companion.domain import Autopilot, FlightMode, LandedState
from companion.guidance.commands import SendSetpoint, SessionParams
from companion.guidance.control import TICK_S
from companion.guidance.control_authority import Reason
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight


def seconds_until(flight: ScriptedFlight, phase: Phase, limit_s: float = 70.0) -> float:
    """Return the time, s, until a phase begins."""
    began_s = flight.now_s
    while flight.phase is not phase:
        assert flight.now_s - began_s < limit_s, flight.texts
        flight.fly(TICK_S)
    return flight.now_s - began_s


def speeds_mps(flight: ScriptedFlight) -> list[float]:
    """Return the speed of the setpoints from tick to tick."""
    sent = [(at_s, c.setpoint) for at_s, c in flight.log if isinstance(c, SendSetpoint)]
    return [
        math.dist(a.position_enu_m[:2], b.position_enu_m[:2]) / (t1 - t0)
        for (t0, a), (t1, b) in itertools.pairwise(sent)
    ]


# Ranging


@pytest.mark.parametrize("start_s", [1.0, 3.1, 7.4])
def test_a_dropout_degrades_after_two_seconds_and_holds_after_five(start_s: float) -> None:
    flight = ScriptedFlight(SessionParams(stop_radius_m=0.1)).in_control()
    flight.fly(start_s)
    flight.has_ranging = False
    assert seconds_until(flight, Phase.DEGRADED) == pytest.approx(2.05, abs=TICK_S)
    assert flight.texts[-1] == "degraded: no ranging for 2 s: coasting, slower"
    assert seconds_until(flight, Phase.HOLD) == pytest.approx(3.0, abs=TICK_S)
    assert flight.texts[-1] == "hold: no ranging for 5 s"


def test_half_a_second_without_ranging_changes_nothing() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(0.5)
    flight.has_ranging = True
    flight.fly(1.0)
    assert flight.is_in(Phase.NORMAL)
    assert not any("degraded" in text or "hold:" in text for text in flight.texts)


def test_degraded_ends_with_the_next_measurement() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    seconds_until(flight, Phase.DEGRADED)
    flight.has_ranging = True
    assert seconds_until(flight, Phase.NORMAL) <= 0.15
    flight.fly(1.0)
    assert flight.texts[-1] == "following the plan; cleared: no ranging for 2 s"


def test_a_hold_for_ranging_ends_with_five_measurements_that_agree() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    seconds_until(flight, Phase.HOLD)
    for _ in range(4):
        flight.fly(0.5)
        flight.measure()
    flight.fly(0.5)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: waiting for 5 consistent measurements"
    flight.measure()
    flight.fly(TICK_S)
    assert flight.is_in(Phase.NORMAL)


def test_while_ranging_ages_it_flies_slower_and_slower() -> None:
    flight = ScriptedFlight()
    flight.follows = True
    flight.in_control()
    flight.fly(2.0)
    flight.has_ranging = False
    seconds_until(flight, Phase.DEGRADED)
    flight.fly(1.2)  # braking takes a moment
    early = max(speeds_mps(flight)[-2:])
    flight.fly(1.6)
    late = max(speeds_mps(flight)[-2:])
    assert flight.is_in(Phase.DEGRADED)
    assert 0.0 < late < early <= 2.5


def test_a_vague_estimate_is_not_coasted_on() -> None:
    flight = ScriptedFlight().in_control()
    estimate = flight.session.estimate
    assert estimate is not None
    flight.has_ranging = False
    flight.session.context.estimate = replace(estimate, r95_m=90.0)
    flight.fly(1.9)
    assert flight.is_in(Phase.NORMAL)
    seconds_until(flight, Phase.HOLD)
    assert flight.texts[-1] == "hold: estimate too uncertain to coast: relative R95 90 m"
    assert Phase.DEGRADED.value not in [record["new"] for record in flight.records("phase")]


def test_a_search_needs_no_ranging() -> None:
    planner = PlannerConfig(search="lawnmower", lost_after_s=1.0)
    flight = ScriptedFlight(planner=planner).in_control()
    flight.has_ranging = False
    flight.fly(10.0)
    assert flight.is_in(Phase.NORMAL)


# Link and position


def test_a_position_that_was_stale_must_be_there_for_a_second_again() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = False
    flight.fly(1.0)
    assert flight.is_in(Phase.HOLD)
    flight.has_position = True
    assert seconds_until(flight, Phase.NORMAL) == pytest.approx(1.0, abs=2 * TICK_S)


def test_a_link_that_comes_and_goes_is_not_flown_on() -> None:
    flight = ScriptedFlight().in_control()
    for _ in range(5):
        flight.has_link = flight.has_ranging = False
        flight.fly(1.2)
        flight.has_link = flight.has_ranging = True
        flight.fly(0.9)
        assert flight.is_in(Phase.HOLD)


def test_a_link_that_is_back_shows_the_mode_first() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_link = flight.has_ranging = False
    flight.fly(3.0)
    flight.has_link = flight.has_ranging = True
    flight.has_heartbeat = False
    flight.fly(1.5)
    assert flight.is_in(Phase.HOLD)
    flight.heartbeat()
    flight.fly(TICK_S)
    assert flight.is_in(Phase.NORMAL)


@pytest.mark.parametrize("outage_s", [0.7, 1.5, 5.0, 9.0])
def test_it_goes_on_without_a_step_after_an_outage(outage_s: float) -> None:
    flight = ScriptedFlight()
    flight.follows = True
    flight.in_control()
    flight.fly(2.0)
    flight.has_link = flight.has_ranging = False
    flight.fly(outage_s)
    held = flight.setpoints[-1]
    flight.has_link = flight.has_ranging = True
    seconds_until(flight, Phase.NORMAL, 3.0)
    assert math.dist(flight.setpoints[-1], held) < 0.2
    assert max(speeds_mps(flight)) < 5.2


def test_after_a_silence_the_first_setpoint_is_where_the_vehicle_is() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT)
    flight.report_landed(LandedState.IN_AIR)
    flight.in_control()
    flight.has_link = flight.has_ranging = False
    flight.fly(20.0)
    flight.position_enu_m = (3.0, -2.0, 22.0)
    flight.has_link = flight.has_ranging = True
    since_s = flight.now_s
    flight.fly(1.5)
    first = flight.sent(SendSetpoint, since_s)[0]
    assert first.setpoint.position_enu_m == flight.position_enu_m


def test_reasons_are_counted() -> None:
    flight = ScriptedFlight().in_control()
    for _ in range(2):
        flight.has_ranging = False
        seconds_until(flight, Phase.HOLD)
        flight.has_ranging = True
        seconds_until(flight, Phase.NORMAL)
    flight.show(FlightMode.POSITION)
    reasons = flight.session.context.reasons
    assert reasons[Reason.NO_RANGING] == 2
    assert reasons[Reason.RANGING_AGES] == 2
    assert [r["reason"] for r in flight.records("finding")].count("no ranging") == 2
