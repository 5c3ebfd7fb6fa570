"""Every planted bug is found by the invariant that it breaks, and the genuine companion by none."""

from __future__ import annotations

from typing import Any

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from sim_link.autopilot.incidents import EkfJump, GpsLoss, PilotMode, WindChange
from sim_link.autopilot.scenario import AutopilotParams, Scenario
from sim_link.lab.faults.fault_models import (
    ForgedFrames,
    LinkBlackout,
    LinkDelay,
    Schedule,
    UnsignedFrames,
)
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.monitor import Monitor
from tests.planted_companions import (
    DEFECTS,
    ChasesJumps,
    HasMoods,
    Pauses,
    Planted,
    RushesIn,
    maker,
    twisted,
)
from tools.campaign.flights import Monitored, monitored_flight

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
    around = monitored_flight(AUTO, COPTER, seed, make_companion=make)
    around.flight.run(18.0)
    around.injector.inject(SCHEDULE)
    around.flight.run(18.0)
    return around


@pytest.mark.slow
@pytest.mark.parametrize(("blind_s", "delay_s"), [(3.0, 0.0), (3.0, 0.4), (12.0, 0.0)])
def test_a_stream_that_pauses_is_found_after_a_blind_time_too(
    blind_s: float, delay_s: float
) -> None:
    """A companion that may be silent until it knows who flies may not be silent for ever."""
    around = monitored_flight(AUTO, COPTER, 1, make_companion=maker(Pauses))
    around.flight.run(18.0)
    slow = LinkDelay(delay_s=delay_s, direction="to_companion")
    around.injector.inject(Schedule(faults=(slow,)))
    around.flight.run(1.0)
    if blind_s < around.monitor.scene.rules.silence_s:
        around.flight.suspend_companion(blind_s)
    else:
        blackout = LinkBlackout(duration_s=blind_s, direction="to_companion")
        around.injector.inject(Schedule(faults=(blackout,)))
    around.flight.run(blind_s + 2.0)
    before = around.monitor.scene.counts["I7", "the stream paused while in control"]
    around.flight.run(10.0)
    assert around.monitor.scene.counts["I7", "the stream paused while in control"] > before


@pytest.mark.slow
def test_the_genuine_companion_breaks_no_invariant() -> None:
    assert flown(None).monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("defect", [d for d in DEFECTS if d is not HasMoods])
def test_a_planted_bug_is_found(defect: type[Planted]) -> None:
    found = {violation.invariant for violation in flown(defect).monitor.violations}
    assert defect.invariant in found


@pytest.mark.slow
def test_moods_show_in_the_digest_of_two_flights() -> None:
    first, second = flown(HasMoods).monitor, flown(HasMoods).monitor
    first.repeat.compare(second.repeat.digest)
    assert [v.invariant for v in first.violations] == ["I12"]
    calm, again = flown(None).monitor, flown(None).monitor
    calm.repeat.compare(again.repeat.digest)
    assert calm.violations == []


@pytest.mark.slow
def test_a_covariance_that_is_not_positive_is_found() -> None:
    around = monitored_flight(AUTO, COPTER, 1)
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


def jumped_out(defect: type[Planted] | None, **jump_m: float) -> set[str]:
    """Return the broken invariants after a jump to outside of a small fence, or its band."""
    square = ((-25.0, -25.0), (25.0, -25.0), (25.0, 25.0), (-25.0, 25.0))
    config = CompanionConfig(mission=AUTO.mission, limits=LimitsConfig(fence_enu_m=square))
    make = None if defect is None else maker(defect)
    around = monitored_flight(config, Scenario(), 1, make_companion=make)
    around.flight.run(18.0)
    around.injector.add(EkfJump(duration_s=30.0, **jump_m))
    around.flight.run(8.0)
    return {violation.invariant for violation in around.monitor.violations}


JUMPS = [{"east_m": 50.0}, {"north_m": -60.0}, {"up_m": 50.0}, {"up_m": -30.0}]


@pytest.mark.slow
@pytest.mark.parametrize("jump_m", JUMPS)
def test_who_chases_a_position_that_jumped_is_found(jump_m: dict[str, float]) -> None:
    assert jumped_out(ChasesJumps, **jump_m) == {"I1", "I2"}


@pytest.mark.slow
@pytest.mark.parametrize("jump_m", JUMPS)
def test_who_stays_is_not(jump_m: dict[str, float]) -> None:
    assert jumped_out(None, **jump_m) == set()


def begun_outside(defect: type[Planted] | None) -> tuple[set[str], float]:
    """Return the broken invariants of a start 50 m outside, and the last position's east."""
    field = ((-120.0, -40.0), (-50.0, -40.0), (-50.0, 40.0), (-120.0, 40.0))
    config = CompanionConfig(mission=AUTO.mission, limits=LimitsConfig(fence_enu_m=field))
    make = None if defect is None else maker(defect)
    around = monitored_flight(config, Scenario(), 1, make_companion=make)
    around.flight.run(40.0)
    east_m = around.flight.sim.vehicle.body.position_enu_m[0]
    return {violation.invariant for violation in around.monitor.violations}, east_m


@pytest.mark.slow
def test_who_rushes_in_from_outside_is_found() -> None:
    assert begun_outside(RushesIn)[0] == {"I2"}


@pytest.mark.slow
def test_who_goes_farther_out_is_found_by_what_freezing_that_would_come_to() -> None:
    class GoesOut(RushesIn):
        def _change(self, message: Any) -> None:
            message.y = 20.0

    assert begun_outside(GoesOut)[0] == {"I1", "I2", "I4"}


@pytest.mark.slow
def test_who_is_walked_in_is_not() -> None:
    found, east_m = begun_outside(None)
    assert found == set()
    assert east_m < -50.0


@pytest.mark.slow
def test_drift_with_the_wind_without_any_position_is_no_violation() -> None:
    """Its autopilot lands it with the wind; the companion has handed it back."""
    field = ((-40.0, -40.0), (40.0, -40.0), (40.0, 24.0), (-40.0, 24.0))
    limits = LimitsConfig(fence_enu_m=field, fence_margin_m=1.0)
    around = monitored_flight(CompanionConfig(mission=AUTO.mission, limits=limits), COPTER, 2)
    flight = around.flight
    flight.run(18.0)
    around.injector.add(WindChange(duration_s=60.0, north_mps=12.0))
    around.injector.add(GpsLoss(duration_s=60.0))
    flight.run(25.0)  # holds for 5 s on its estimator, then sinks and drifts
    vehicle = flight.sim.vehicle
    assert vehicle.body.position_enu_m[0] - abs(vehicle.estimator.bias_enu_m[0]) > 41.0
    assert around.monitor.violations == []
