"""Texts, outside of control, when setpoints stop or control can no longer be given."""

from __future__ import annotations

import pytest

from companion.domain import Autopilot, FlightMode
from companion.guidance.commands import SendSetpoint
from companion.guidance.events import AutopilotClockSlipped
from companion.guidance.phases import Phase
from tests.unit.companion.guidance.scripted import ScriptedFlight
from tests.unit.companion.guidance.session_helpers import silent_since

ABOUT = ("not ready", "ready again", "setpoints stopped", "autopilot's clock")


def texts_since(flight: ScriptedFlight, count: int) -> list[str]:
    """Return the texts about readiness after the first `count` texts."""
    return [text for text in flight.texts[count:] if text.startswith(ABOUT)]


def test_a_stale_position_on_the_ground_is_reported_when_setpoints_stop_and_when_it_is_back() -> (
    None
):
    flight = ScriptedFlight().on_the_ground()
    assert flight.is_in(Phase.STANDBY)
    before = len(flight.texts)
    flight.has_position = False
    flight.fly(0.6)
    stopped_s = flight.now_s
    assert texts_since(flight, before) == [
        "not ready: vehicle position is stale; setpoints stopped"
    ]
    flight.fly(20.0)
    assert silent_since(flight, stopped_s)
    assert len(texts_since(flight, before)) == 1
    flight.has_position = True
    flight.fly(4.0)
    assert texts_since(flight, before)[1:] == ["ready again: switch to offboard mode"]
    assert flight.sent(SendSetpoint, flight.now_s - 0.5)


def test_a_dead_link_and_an_unknown_mode_are_reported_in_standby() -> None:
    flight = ScriptedFlight().ready()
    before = len(flight.texts)
    flight.has_link = False
    flight.fly(15.0)
    assert texts_since(flight, before) == [
        "not ready: vehicle position is stale; setpoints stopped",
        "not ready: autopilot link lost",
    ]
    flight.has_link = True
    flight.fly(5.0)
    before = len(flight.texts)
    flight.has_heartbeat = False
    flight.fly(12.0)
    assert texts_since(flight, before) == [
        "not ready: autopilot's mode is unknown; setpoints stopped"
    ]


def test_a_clock_that_slips_on_the_ground_is_reported_with_what_follows() -> None:
    flight = ScriptedFlight().on_the_ground()
    before = len(flight.texts)
    flight.has_position = False
    flight.give(AutopilotClockSlipped(flight.now_s))
    flight.fly(0.1)
    assert texts_since(flight, before) == [
        "autopilot's clock or link delay jumped: resyncing",
        "not ready: vehicle position is stale; setpoints stopped",
    ]


def test_on_ardupilot_where_no_setpoints_flow_yet_it_is_reported_that_it_is_not_ready() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    before = len(flight.texts)
    flight.has_position = False
    flight.fly(1.0)
    assert texts_since(flight, before) == ["not ready: vehicle position is stale"]
    flight.has_position = True
    flight.fly(4.0)
    assert texts_since(flight, before)[1:] == ["ready again: switch to GUIDED"]


def test_a_position_that_comes_and_goes_does_not_fill_the_log() -> None:
    flight = ScriptedFlight().ready()
    before = len(flight.texts)
    for _ in range(40):
        flight.has_position = not flight.has_position
        flight.fly(0.7)
    assert texts_since(flight, before) == [
        "not ready: vehicle position is stale; setpoints stopped"
    ]


def test_after_the_report_an_autopilot_that_stays_ours_is_reported_when_setpoints_end() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    before = len(flight.texts)
    flight.fly(5.5)
    text = "setpoints stopped in offboard mode: choose a mode"
    assert texts_since(flight, before) == [text]


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.POSITION])
def test_after_the_report_a_mode_that_followed_ends_setpoints_without_a_word(
    mode: FlightMode,
) -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    before = len(flight.texts)
    flight.show(mode)
    flight.fly(10.0)
    assert texts_since(flight, before) == []
