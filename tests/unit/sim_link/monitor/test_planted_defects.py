"""Every planted bug is found by the invariant that it breaks, and the genuine companion by none."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.session import SessionParams
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.campaign.flights import Monitored, monitored, rules_of
from sim_link.faults.kinds import ForgedFrames, LinkBlackout, PilotMode, UnsignedFrames
from sim_link.faults.planted import DEFECTS, HasMoods, Planted, maker, twisted
from sim_link.faults.schedule import Schedule
from sim_link.monitor.monitor import Monitor

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
COPTER = Scenario(autopilot=AutopilotParams(flavour="ardupilot"))
SCHEDULE = Schedule(
    faults=(
        LinkBlackout(start_s=3.0, duration_s=2.0, direction="to_companion"),
        UnsignedFrames(start_s=8.0, duration_s=1.0, rate_hz=20.0),
        ForgedFrames(start_s=9.0, duration_s=1.0, rate_hz=20.0),
        PilotMode(start_s=12.0, mode=FlightMode.HOLD),
    )
)


def flown(defect: type[Planted] | None, seed: int = 1) -> Monitored:
    """Half a minute with a blind spell, strangers on the link and a pilot who takes over."""
    make = None if defect is None else maker(defect)
    around = monitored(AUTO, COPTER, seed, make_companion=make)
    around.flight.run(18.0)
    around.injector.inject(SCHEDULE)
    around.flight.run(18.0)
    return around


def test_the_genuine_companion_breaks_no_invariant() -> None:
    assert flown(None).monitor.violations == []


@pytest.mark.parametrize("defect", [d for d in DEFECTS if d is not HasMoods])
def test_a_planted_bug_is_found(defect: type[Planted]) -> None:
    found = {violation.invariant for violation in flown(defect).monitor.violations}
    assert defect.invariant in found


def test_moods_show_in_the_digest_of_two_flights() -> None:
    first, second = flown(HasMoods).monitor, flown(HasMoods).monitor
    first.repeat.compare(second.repeat.digest)
    assert [v.invariant for v in first.violations] == ["I12"]
    calm, again = flown(None).monitor, flown(None).monitor
    calm.repeat.compare(again.repeat.digest)
    assert calm.violations == []


def test_a_covariance_that_is_not_positive_is_found() -> None:
    around = monitored(AUTO, COPTER, 1)
    flight = around.flight
    monitor = Monitor(
        rules_of(AUTO),
        flight.sim.vehicle,
        estimate=lambda: twisted(flight.companion.session.estimate),
    )
    flight.observers.append(monitor)
    flight.run(25.0)
    assert {v.invariant for v in monitor.violations} == {"I9"}
    assert around.monitor.violations == []
