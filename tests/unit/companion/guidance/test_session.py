"""The session against a scripted vehicle: who flies, when, and what leaves."""

from __future__ import annotations

import math

import pytest

from companion.config.schema import LimitsConfig
from companion.domain import Autopilot, FlightMode, LandedState, VehicleState
from companion.geometry.frames import LocalOrigin
from companion.guidance.commands import Arm, SendHeartbeat, SendSetpoint, SetMode, TakeOff
from companion.guidance.events import (
    AutopilotFenceRead,
    AutopilotRestarted,
    ControlGranted,
    OriginSet,
    Outcome,
    RequestKind,
    StopRequested,
    VehicleMoved,
)
from companion.guidance.session import TICK_S, SessionParams
from companion.guidance.states import Phase
from tests.unit.companion.guidance.scripted import ORIGIN, ScriptedFlight

FOREIGN_MODES = [mode for mode in FlightMode if mode is not FlightMode.OFFBOARD]


def silent_since(flight: ScriptedFlight, since_s: float) -> bool:
    """Whether nothing that moves the vehicle was sent or asked for."""
    kinds = (SendSetpoint, SetMode, Arm, TakeOff)
    return not any(flight.sent(kind, since_s) for kind in kinds)


# Before control


def test_silent_until_position_and_home_are_known() -> None:
    flight = ScriptedFlight()
    flight.has_position = False
    flight.heartbeat()
    flight.fly(2.0)
    assert flight.is_in(Phase.WAITING)
    assert silent_since(flight, -1.0)
    flight.has_position = True
    flight.fly(1.0)
    assert flight.is_in(Phase.WAITING)
    flight.locate()
    flight.fly(0.1)
    assert flight.is_in(Phase.STANDBY)


def test_in_standby_px4_gets_its_own_place_twenty_times_a_second() -> None:
    flight = ScriptedFlight().ready()
    flight.place = (3.0, 4.0, 21.0)
    since_s = flight.now_s
    flight.fly(3.0)
    sent = flight.sent(SendSetpoint, since_s)
    assert len(sent) == 60
    assert {c.setpoint.position_enu_m for c in sent} == {(3.0, 4.0, 21.0)}


def test_in_standby_ardupilot_gets_silence() -> None:
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    assert silent_since(flight, -1.0)


def test_ardupilot_in_guided_is_not_taken_before_its_takeoff_is_over() -> None:
    """A position target during the climb would end it (ArduCopter 4.5, observed)."""
    flight = ScriptedFlight(autopilot=Autopilot.ARDUPILOT).ready()
    for landed in (LandedState.ON_GROUND, LandedState.TAKEOFF):
        flight.report_landed(landed)
        flight.show(FlightMode.OFFBOARD)
        flight.fly(2.0)
        assert flight.is_in(Phase.STANDBY)
        assert silent_since(flight, -1.0)
    flight.report_landed(LandedState.IN_AIR)
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


def test_a_heartbeat_leaves_once_a_second_from_the_tick_and_stops_with_it() -> None:
    flight = ScriptedFlight().ready()
    since_s = flight.now_s
    flight.fly(5.0)
    assert len(flight.sent(SendHeartbeat, since_s)) == 5
    since_s = flight.now_s
    flight.heartbeat()
    assert flight.sent(SendHeartbeat, since_s) == []


@pytest.mark.parametrize("mode", FOREIGN_MODES)
def test_no_other_mode_gives_control(mode: FlightMode) -> None:
    flight = ScriptedFlight().ready()
    flight.show(mode)
    flight.fly(3.0)
    assert flight.is_in(Phase.STANDBY)
    assert flight.asked_modes() == []


def test_offboard_on_the_ground_gives_no_control_until_armed() -> None:
    flight = ScriptedFlight()
    flight.heartbeat()
    flight.locate()
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD, is_armed=False)
    flight.fly(1.0)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


# Hold


def test_holds_after_five_seconds_without_ranging_and_resumes() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(4.9)
    assert flight.is_in(Phase.DEGRADED)
    flight.fly(0.2)
    assert flight.is_in(Phase.HOLD)
    assert "hold: no ranging for 5 s" in flight.texts
    flight.fly(1.0)
    assert len(set(flight.setpoints[-20:])) == 1
    flight.has_ranging = True
    flight.fly(0.6)
    assert flight.is_in(Phase.NORMAL)


def test_holds_when_its_own_position_is_stale() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = False
    flight.fly(0.5)
    assert flight.is_in(Phase.NORMAL)
    flight.fly(0.05)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: own position is stale"
    flight.has_position = True
    flight.fly(1.1)
    assert flight.is_in(Phase.NORMAL)


def test_holds_when_the_link_is_lost_and_goes_silent_in_the_end() -> None:
    flight = ScriptedFlight().in_control()
    flight.heartbeat()
    flight.has_link = flight.has_ranging = False
    cut_s = flight.now_s
    flight.fly(1.1)
    assert flight.is_in(Phase.HOLD)
    assert flight.texts[-1] == "hold: autopilot link lost"
    flight.fly(15.0)
    assert [at for at, c in flight.log if isinstance(c, SendSetpoint)][-1] == pytest.approx(
        cut_s + 10.0, abs=0.051
    )


def test_frames_without_a_heartbeat_do_not_end_the_silence() -> None:
    flight = ScriptedFlight().in_control()
    flight.heartbeat()
    flight.has_link = flight.has_ranging = False
    flight.fly(30.0)
    since_s = flight.now_s
    flight.has_link = flight.has_ranging = True
    flight.fly(0.5)  # positions only: the heartbeat of this second is still to come
    assert silent_since(flight, since_s)
    flight.show(FlightMode.HOLD, is_failsafe=True)
    flight.fly(3.0)
    assert silent_since(flight, since_s)
    assert flight.is_in(Phase.YIELD)


def test_holds_when_next_to_nothing_agrees_with_the_estimate() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly(6.0)
    flight.bearing_error_rad = math.pi
    flight.fly(2.5)
    assert flight.is_in(Phase.HOLD)
    assert "hold: measurements do not agree with the estimate" in flight.texts


def test_holds_while_the_filter_recovers() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly(6.0)
    flight.bearing_error_rad = math.pi
    flight.fly(4.5)
    assert flight.session.tracker.restarts == 1
    assert flight.is_in(Phase.HOLD)
    status = flight.session.status(flight.now_s)
    assert status.detail == "the filter is recovering from a contradiction"


# Losing control


@pytest.mark.parametrize("mode", FOREIGN_MODES)
@pytest.mark.parametrize("is_failsafe", [False, True])
def test_any_other_mode_means_silence_from_that_very_event_on(
    mode: FlightMode, is_failsafe: bool
) -> None:
    flight = ScriptedFlight().in_control()
    lost_s = flight.now_s
    flight.show(mode, is_failsafe=is_failsafe)
    assert flight.is_in(Phase.YIELD)
    assert flight.has_withdrawn
    flight.fly(60.0)
    assert silent_since(flight, lost_s)


def test_a_failsafe_while_holding_is_a_loss_too() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.fly(6.0)
    lost_s = flight.now_s
    flight.show(FlightMode.RETURN, is_failsafe=True)
    flight.has_ranging = True
    flight.fly(10.0)
    assert silent_since(flight, lost_s)


def test_offboard_seen_right_after_the_loss_is_our_own_echo() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.HOLD, is_failsafe=True)
    lost_s = flight.now_s
    flight.fly(1.9)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.YIELD)
    flight.show(FlightMode.HOLD)
    flight.fly(1.0)
    assert silent_since(flight, lost_s)


def test_offboard_seen_two_seconds_later_was_given() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.POSITION)
    flight.fly(2.0)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
    flight.fly(0.2)
    assert flight.is_in(Phase.NORMAL)
    assert flight.asked_modes() == []


def test_a_grant_makes_ready_and_the_mode_switch_engages() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.POSITION)
    flight.fly(1.0)
    flight.give(ControlGranted(flight.now_s))
    assert flight.is_in(Phase.STANDBY)
    granted_s = flight.now_s
    flight.fly(1.0)
    assert len(flight.sent(SendSetpoint, granted_s)) == 20
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)
    assert flight.asked_modes() == []


def test_the_first_setpoint_after_a_loss_is_where_the_vehicle_is() -> None:
    flight = ScriptedFlight().in_control()
    flight.show(FlightMode.POSITION)
    flight.place = (-60.0, -70.0, 30.0)
    flight.fly(3.0)
    since_s = flight.now_s
    flight.show(FlightMode.OFFBOARD)
    flight.fly(0.05)
    (first,) = flight.sent(SendSetpoint, since_s)
    assert math.dist(first.setpoint.position_enu_m, flight.place) < 0.5


def test_disarming_ends_the_flight_and_leftover_offboard_does_not_begin_the_next() -> None:
    flight = ScriptedFlight().in_control()
    ended_s = flight.now_s
    flight.show(FlightMode.OFFBOARD, is_armed=False)
    assert flight.is_in(Phase.WAITING)
    flight.fly(2.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(2.0)
    assert silent_since(flight, ended_s)
    flight.show(FlightMode.HOLD)
    flight.fly(0.1)
    assert flight.is_in(Phase.STANDBY)
    flight.show(FlightMode.OFFBOARD)
    assert flight.is_in(Phase.HOLD)


@pytest.mark.parametrize(
    ("mode", "is_failsafe"),
    [(FlightMode.OFFBOARD, False), (FlightMode.RETURN, True), (FlightMode.HOLD, True)],
)
def test_a_vehicle_found_in_flight_is_left_alone(mode: FlightMode, is_failsafe: bool) -> None:
    flight = ScriptedFlight()
    flight.show(mode, is_failsafe=is_failsafe)
    flight.locate()
    flight.fly(20.0)
    assert flight.is_in(Phase.WAITING)
    assert silent_since(flight, -1.0)
    assert flight.session.status(flight.now_s).detail.startswith("found in offboard")
    flight.show(FlightMode.HOLD)
    flight.fly(0.1)
    assert flight.is_in(Phase.STANDBY)


def test_a_grant_is_enough_for_a_vehicle_found_in_offboard() -> None:
    flight = ScriptedFlight()
    flight.show(FlightMode.OFFBOARD)
    flight.locate()
    flight.fly(3.0)
    flight.give(ControlGranted(flight.now_s))
    flight.fly(1.2)
    assert flight.is_in(Phase.HOLD, Phase.NORMAL)


@pytest.mark.parametrize(("missed", "is_anew"), [(4, False), (7, True)])
def test_after_a_pause_the_stream_begins_where_the_vehicle_is(missed: int, is_anew: bool) -> None:
    """The vehicle stays behind its setpoint; then ticks are missed."""
    flight = ScriptedFlight().in_control()
    flight.fly(4.0)
    assert math.dist(flight.setpoints[-1], flight.place) > 3.0
    flight.skip(missed)
    flight.fly(TICK_S)
    assert (math.dist(flight.setpoints[-1], flight.place) < 0.5) is is_anew


# Restart and frame


def test_a_restart_of_the_autopilot_forgets_tracker_and_frame() -> None:
    flight = ScriptedFlight(SessionParams(engage="auto")).launched_by_itself()
    flight.give(AutopilotRestarted(flight.now_s))
    restarted_s = flight.now_s
    assert flight.is_in(Phase.WAITING)
    assert flight.session.estimate is None
    assert flight.session.tracker.estimate(flight.now_s) is None
    assert flight.session.vehicle.origin is None
    assert flight.texts[-1].startswith("autopilot restarted")
    flight.show(FlightMode.HOLD, is_armed=False)
    flight.locate()
    flight.give(AutopilotFenceRead(flight.now_s))
    flight.fly(30.0)
    assert flight.is_in(Phase.STANDBY)
    assert "launching" not in flight.texts[-1]
    assert flight.sent(Arm, restarted_s) == []
    assert flight.asked_modes(restarted_s) == []


def test_a_vehicle_that_flies_in_offboard_after_a_restart_is_left_alone() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(AutopilotRestarted(flight.now_s))
    restarted_s = flight.now_s
    flight.locate()
    flight.fly(10.0)
    assert silent_since(flight, restarted_s)


@pytest.mark.parametrize(("north_m", "is_new_frame"), [(0.9, False), (1.1, True), (1000.0, True)])
def test_an_origin_that_moves_takes_the_estimate_with_it(
    north_m: float, is_new_frame: bool
) -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    moved = LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))
    flight.give(OriginSet(flight.now_s, moved))
    assert (flight.session.estimate is None) == is_new_frame
    assert (flight.is_in(Phase.HOLD)) == is_new_frame
    assert any("local origin moved" in text for text in flight.texts) == is_new_frame


def test_an_origin_that_creeps_takes_the_estimate_with_it_after_a_metre() -> None:
    flight = ScriptedFlight().in_control()
    for north_m in (0.4, 0.8):
        flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, north_m, 0.0)))))
        assert flight.session.estimate is not None
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 1.2, 0.0)))))
    assert flight.session.estimate is None


def test_heights_stay_above_the_same_home_when_the_origin_moves() -> None:
    flight = ScriptedFlight().in_control()
    flight.give(OriginSet(0.0, LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 5.0, 7.0)))))
    assert flight.session.vehicle.home_enu_m == pytest.approx((0.0, -5.0, -7.0), abs=1e-3)


def test_after_the_origin_moved_it_holds_in_the_new_frame_until_new_ranging() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_ranging = False
    flight.place = (0.0, -50.0, 20.0)
    since_s = flight.now_s
    flight.locate(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0))))
    flight.fly(3.0)
    assert flight.is_in(Phase.HOLD)
    sent = flight.sent(SendSetpoint, since_s)
    assert {c.setpoint.position_enu_m for c in sent} == {(0.0, -50.0, 20.0)}
    flight.has_ranging = True
    flight.fly(1.1)
    assert flight.is_in(Phase.NORMAL)


def test_a_position_of_the_old_frame_is_not_flown_in_the_new_one() -> None:
    flight = ScriptedFlight().in_control()
    flight.has_position = flight.has_ranging = False
    since_s = flight.now_s
    flight.locate(LocalOrigin(*ORIGIN.geodetic_from_enu((0.0, 50.0, 0.0))))
    flight.fly(0.3)
    assert flight.sent(SendSetpoint, since_s) == []
    flight.has_position = True
    flight.fly(0.1)
    assert len(flight.sent(SendSetpoint, since_s)) == 2


# The end


@pytest.mark.parametrize(
    ("on_localised", "mode"),
    [("hold", FlightMode.HOLD), ("return", FlightMode.RETURN), ("land", FlightMode.LAND)],
)
def test_reports_after_the_confirmation_time_and_asks_for_the_mode_that_follows(
    on_localised: str, mode: FlightMode
) -> None:
    params = SessionParams(on_localised=on_localised)  # type: ignore[arg-type]
    flight = ScriptedFlight(params).in_control()
    flight.follows = True
    flight.fly_until_reported()
    (result,) = flight.results
    assert result.estimate.r95_m <= params.stop_radius_m
    assert result.latitude_deg == pytest.approx(47.4 + 30.0 / 111_200, abs=1e-5)
    assert flight.asked_modes() == [mode]
    assert flight.is_in(Phase.FINISHED)
    confident_s = next(at for at, r95_m in flight.r95_history if r95_m <= params.stop_radius_m)
    assert flight.now_s - confident_s >= params.stop_confirm_s - 0.051


def test_a_break_in_control_breaks_the_confirmation() -> None:
    flight = ScriptedFlight(SessionParams(stop_confirm_s=10.0, stop_radius_m=2.0)).in_control()
    flight.follows = True
    while flight.session.estimate is None or flight.session.estimate.r95_m > 1.9:
        flight.fly(0.5)
    flight.fly(1.0)
    flight.show(FlightMode.POSITION)
    flight.fly(12.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(9.0)
    assert flight.results == []
    flight.fly(1.5)
    assert len(flight.results) == 1


def test_after_the_report_setpoints_flow_until_the_mode_is_left_and_never_again() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    reported_s = flight.now_s
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, reported_s)) == 10
    flight.show(FlightMode.POSITION)
    assert flight.has_withdrawn
    taken_s = flight.now_s
    flight.fly(1.0)
    flight.show(FlightMode.OFFBOARD)
    flight.fly(1.0)
    assert silent_since(flight, taken_s)


def test_a_stop_asks_for_hold_and_streams_until_it_is_confirmed() -> None:
    flight = ScriptedFlight().in_control()
    asked_s = flight.now_s
    flight.give(StopRequested(asked_s))
    assert flight.asked_modes() == [FlightMode.HOLD]
    flight.fly(0.5)
    assert len(flight.sent(SendSetpoint, asked_s)) == 10
    assert not flight.session.is_stopped
    flight.answer(RequestKind.SET_MODE)
    assert flight.session.is_stopped
    stopped_s = flight.now_s
    flight.fly(1.0)
    assert silent_since(flight, stopped_s)


def test_a_stop_that_nobody_confirms_ends_within_a_second_and_a_half() -> None:
    flight = ScriptedFlight().in_control()
    asked_s = flight.now_s
    flight.give(StopRequested(asked_s))
    while not flight.session.is_stopped:
        flight.fly(0.05)
    assert flight.now_s - asked_s <= 1.5 + 1e-9
    assert flight.texts[-1] == "hand-back: not confirmed in time"


@pytest.mark.parametrize("situation", ["waiting", "standby", "yield"])
def test_a_stop_out_of_control_ends_at_once_without_a_request(situation: str) -> None:
    flight = ScriptedFlight()
    if situation == "standby":
        flight.ready()
    if situation == "yield":
        flight.in_control().show(FlightMode.RETURN)
    flight.give(StopRequested(flight.now_s))
    assert flight.session.is_stopped
    assert flight.asked_modes() == []


def test_a_stop_right_after_the_report_still_hands_back() -> None:
    flight = ScriptedFlight(SessionParams(on_localised="return")).in_control()
    flight.follows = True
    flight.fly_until_reported()
    flight.give(StopRequested(flight.now_s))
    assert flight.is_in(Phase.HANDBACK)
    assert flight.asked_modes() == [FlightMode.RETURN, FlightMode.RETURN]


def test_a_refused_follow_up_is_told() -> None:
    flight = ScriptedFlight().in_control()
    flight.follows = True
    flight.fly_until_reported()
    flight.answer(RequestKind.SET_MODE, Outcome.REJECTED)
    assert flight.texts[-1] == "set mode: rejected"


# Limits


def test_setpoints_stay_inside_fence_and_band_wherever_the_target_is() -> None:
    limits = LimitsConfig(
        fence_enu_m=((-10.0, -10.0), (25.0, -10.0), (25.0, 20.0), (-10.0, 20.0)),
        altitude_max_m=22.0,
    )
    flight = ScriptedFlight(limits=limits).in_control()
    flight.follows = True
    flight.fly(40.0)
    assert len(flight.setpoints) > 800
    for east, north, up in flight.setpoints:
        assert -7.0 - 1e-9 <= east <= 22.0 + 1e-9
        assert -7.0 - 1e-9 <= north <= 17.0 + 1e-9
        assert 5.0 <= up <= 22.0
    assert max(p[0] for p in flight.setpoints) > 20.0


@pytest.mark.parametrize("place", [(200.0, 0.0, 20.0), (0.0, -900.0, 0.0), (-300.0, 300.0, 500.0)])
def test_a_vehicle_outside_is_only_called_inside(place: tuple[float, float, float]) -> None:
    flight = ScriptedFlight()
    flight.place = place
    flight.ready()
    flight.show(FlightMode.OFFBOARD)
    flight.fly(5.0)
    assert flight.setpoints
    for east, north, up in flight.setpoints:
        assert max(abs(east), abs(north)) <= 147.0 + 1e-6
        assert 5.0 <= up <= 60.0


def test_parked_on_the_reported_target_it_learns_nothing_more() -> None:
    flight = ScriptedFlight(SessionParams(stop_confirm_s=1.0)).in_control()
    flight.follows = True
    flight.fly(60.0)
    assert flight.is_in(Phase.FINISHED)
    before, accepted = flight.session.estimate, flight.session.tracker.accepted
    flight.fly(20.0)
    assert flight.session.estimate is before
    assert flight.session.tracker.accepted == accepted


def test_a_vehicle_that_is_left_alone_is_told_so_once() -> None:
    flight = ScriptedFlight()
    flight.mode, flight.is_armed = FlightMode.OFFBOARD, True
    flight.heartbeat()
    flight.locate()
    flight.fly(30.0)
    assert flight.is_in(Phase.WAITING)
    assert [text for text in flight.texts if text.startswith("left alone")] == [
        "left alone: in offboard, not given; switch to another mode"
    ]


def test_what_is_missing_is_named_after_a_while() -> None:
    flight = ScriptedFlight()
    flight.heartbeat()
    flight.fly(9.0)
    assert not any("waiting for" in text for text in flight.texts)
    flight.fly(3.0)
    assert [text for text in flight.texts if "waiting for" in text] == [
        "still waiting for a home position"
    ]


def test_positions_that_are_always_late_are_told_apart_from_none() -> None:
    """Over a slow link they come, and every one is too old to be flown on."""
    flight = ScriptedFlight()
    flight.has_position = False
    flight.heartbeat()
    flight.locate()
    for _ in range(240):
        late = VehicleState(flight.now_s - 0.6, flight.place, (0.0, 0.0, 0.0))
        flight.give(VehicleMoved(flight.now_s, late))
        flight.fly(0.05)
    assert flight.is_in(Phase.WAITING)
    assert [text for text in flight.texts if "waiting for" in text] == [
        "still waiting for a local position that is not 0.5 s late (is the link slow?)"
    ]


def test_a_target_beyond_the_fence_is_announced_once() -> None:
    limits = LimitsConfig(fence_enu_m=((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)))
    flight = ScriptedFlight(limits=limits).in_control()
    flight.follows = True
    flight.fly(20.0)
    assert len([text for text in flight.texts if "outside the fence" in text]) == 1
