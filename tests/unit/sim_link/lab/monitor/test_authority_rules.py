"""Origin of the mode: a person's switch counts, an autopilot's own return does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance import control_authority
from companion.guidance.commands import SessionParams
from companion.guidance.control_authority import Authority
from companion.guidance.events import HeartbeatReceived
from companion.guidance.phases import Phase
from companion.mav.codec import message_id
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import BatteryCharge
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import CompanionKilled, LinkBlackout, Schedule
from sim_link.lab.observer import Delivery, Lane
from tests.planted_companions import KeepsFlying, maker
from tools.campaign.flights import Monitored, monitored_flight

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
COPTER = Scenario(autopilot=AutopilotParams(flavour="ardupilot"))
AUTO = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))


def taken_over(*, is_planted: bool = False) -> Monitored:
    """A flight that the operator took over a few seconds ago."""
    around = monitored_flight(
        AUTO, COPTER, 1, make_companion=maker(KeepsFlying) if is_planted else None
    )
    around.flight.run(18.0)
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(5.0)
    return around


@pytest.mark.slow
def test_silence_after_a_take_over_breaks_nothing() -> None:
    around = taken_over()
    assert around.monitor.authority.late == 0
    assert around.monitor.violations == []


@pytest.mark.slow
def test_what_is_sent_after_it_is_counted_with_how_late_it_was() -> None:
    authority = taken_over(is_planted=True).monitor.authority
    assert authority.late >= 2
    assert authority.worst_late_s == pytest.approx(1.5, abs=0.6)  # free after two seconds


@pytest.mark.slow
def test_a_mode_that_the_operator_gives_back_is_no_offence() -> None:
    around = taken_over()
    around.operator.grant()
    around.operator.choose(FlightMode.OFFBOARD)
    around.flight.run(6.0)
    assert around.flight.mode is FlightMode.OFFBOARD
    assert around.monitor.violations == []


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_mode_that_was_chosen_is_given_back_by_the_switch_alone(flavour: FlavourName) -> None:
    around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour=flavour)), 1)
    around.flight.run(18.0)
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(5.0)
    around.operator.choose(FlightMode.OFFBOARD)
    around.flight.run(6.0)
    assert around.flight.mode is FlightMode.OFFBOARD
    assert around.flight.companion.session.phase is Phase.NORMAL
    assert around.monitor.violations == []


def another_mode(around: Monitored) -> None:
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(5.0)


def long_silence(around: Monitored) -> None:
    """PX4 leaves offboard by failsafe, and would return to it with the first setpoint."""
    around.injector.add(LinkBlackout(duration_s=13.0))
    around.flight.run(16.0)


@pytest.mark.slow
@pytest.mark.parametrize("is_broken", [False, True])
@pytest.mark.parametrize(
    ("lose", "rule", "broken"),
    [
        (another_mode, "REGAIN_QUIET_S", 0.0),
        (long_silence, "FAILSAFE_REASON", None),
    ],
)
def test_a_companion_that_is_ready_again_too_early_is_found(
    monkeypatch: pytest.MonkeyPatch,
    lose: Callable[[Monitored], None],
    rule: str,
    broken: object,
    *,
    is_broken: bool,
) -> None:
    px4 = Scenario(autopilot=AutopilotParams(flavour="px4", parameters={"COM_OBL_RC_ACT": 5}))
    if is_broken:
        monkeypatch.setattr(control_authority, rule, broken)
        if broken is None:  # a failsafe counts as if it were not shown
            monkeypatch.setattr(Authority, "observe", observe_without_failsafes)
    around = monitored_flight(AUTO, px4, 1)
    around.flight.run(18.0)
    lose(around)
    found = {violation.invariant for violation in around.monitor.violations}
    assert found == ({"I3"} if is_broken else set())


OBSERVE = Authority.observe


def observe_without_failsafes(authority: Authority, heartbeat: HeartbeatReceived) -> None:
    OBSERVE(authority, replace(heartbeat, is_failsafe=False))


@pytest.mark.slow
def test_a_mode_that_was_not_selected_again_gives_no_right_to_fly() -> None:
    around = taken_over(is_planted=True)
    before = len(around.monitor.violations)
    mode_s = around.flight.now_s
    around.flight.sim.vehicle.flavour.pilot_chooses(FlightMode.OFFBOARD, mode_s)
    around.flight.run(3.0)
    assert len(around.monitor.violations) > before


class WithoutHeartbeats:
    """A wire that loses all of the vehicle's heartbeats."""

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[Delivery]:
        is_lost = lane is Lane.TO_COMPANION and message_id(data) == HEARTBEAT
        return [] if is_lost else [(now_s, data)]


def test_a_grant_takes_nothing_away_from_who_could_not_know_of_the_take_over() -> None:
    around = monitored_flight(AUTO, COPTER, 1)
    around.flight.run(16.0)
    around.flight.wire = WithoutHeartbeats()
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(1.5)
    around.operator.grant()
    around.flight.run(0.5)
    assert around.flight.mode is FlightMode.HOLD
    assert around.flight.companion.session.phase in (Phase.NORMAL, Phase.HOLD)
    assert around.monitor.violations == []


def test_a_mode_that_ends_shortly_after_a_grant_was_given_back_before_it() -> None:
    around = monitored_flight(AUTO, COPTER, 1)
    around.flight.run(16.0)
    around.operator.grant()
    around.flight.run(0.2)
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(3.0)
    assert around.monitor.violations == []


@pytest.mark.parametrize("keeps_latch", [True, False])
def test_guided_that_a_failed_launch_left_behind_gives_no_right_to_fly(
    monkeypatch: pytest.MonkeyPatch, *, keeps_latch: bool
) -> None:
    if not keeps_latch:
        monkeypatch.setattr(Authority, "may_begin", property(lambda _: True))
    around = monitored_flight(AUTO, COPTER, 1)
    around.flight.run(6.5)
    around.injector.add(BatteryCharge(share=0.05))
    around.flight.run(2.0)
    assert around.flight.mode is FlightMode.OFFBOARD
    around.flight.run(6.0)
    found = {violation.invariant for violation in around.monitor.violations}
    assert found == (set() if keeps_latch else {"I3"})


@pytest.mark.slow
@pytest.mark.parametrize("is_too_bold", [False, True])
def test_a_companion_that_begins_again_in_the_air_has_nothing_to_lose(
    monkeypatch: pytest.MonkeyPatch, *, is_too_bold: bool
) -> None:
    """The offboard mode that it saw was its predecessor's; the pilot's next mode frees it."""
    around = monitored_flight(AUTO, Scenario(autopilot=AutopilotParams(flavour="px4")), 1)
    around.flight.run(16.3)
    if is_too_bold:
        monkeypatch.setattr(Authority, "may_begin", True)
    around.injector.inject(Schedule(faults=(CompanionKilled(down_s=0.1),)))
    around.flight.run(6.0)
    around.operator.choose(FlightMode.RETURN)
    around.flight.run(4.0)
    assert around.flight.companion.session.phase is Phase.STANDBY
    found = {violation.invariant for violation in around.monitor.violations}
    assert ("I3" in found) is is_too_bold
