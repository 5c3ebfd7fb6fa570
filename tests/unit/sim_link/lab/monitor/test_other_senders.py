"""Acts of another sender, on the vehicle or with its ids, do not count as the companion's."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import (
    CompanionStalled,
    Disarm,
    Fault,
    ForgedFrames,
    LinkBlackout,
    Schedule,
    SecondSender,
    UnsignedFrames,
)
from sim_link.lab.lockstep import MakeCompanion
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.independent_checks import SILENCE_S, SenderTrust, depth_m
from sim_link.lab.observer import Frame, Lane
from tests.loop.loop_helpers import said
from tests.planted_companions import FollowsTheNextPeer
from tools.campaign.flights import Monitored, monitored_flight

AUTO = CompanionConfig(mission=SessionParams(engage="auto"))
COPTER = Scenario(autopilot=AutopilotParams(flavour="ardupilot"))
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3)
ATTITUDE = mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def in_flight(flavour: FlavourName, uid: int | None = None) -> Monitored:
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour, uid=uid))
    around = monitored_flight(AUTO, scenario, 1)
    around.flight.run(18.0)
    return around


def true_depth_m(around: Monitored) -> float:
    position = around.flight.sim.vehicle.body.position_enu_m
    return depth_m(rules_of(AUTO).fence_enu_m, rules_of(AUTO).keep_out_enu_m, position[:2])


@pytest.mark.slow
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_another_system_that_flies_it_out_of_the_fence_is_no_breach(flavour: FlavourName) -> None:
    around = in_flight(flavour)
    away = SecondSender(rate_hz=15.0, east_m=-200.0, north_m=-200.0, duration_s=40.0)
    around.injector.inject(Schedule(faults=(away,)))
    around.flight.run(60.0)
    assert true_depth_m(around) < -5.0
    assert said(around.notes, "control yielded")
    assert around.monitor.fence.breaches == 0
    assert around.monitor.violations == []


@pytest.mark.slow
def test_a_vehicle_that_its_own_return_took_out_is_not_out_by_the_companion() -> None:
    around = in_flight("ardupilot")
    around.operator.choose(FlightMode.RETURN)
    around.flight.run(0.1)
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(0.1)
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(1.0)
    assert true_depth_m(around) < -5.0
    assert around.monitor.fence.breaches == 0


@pytest.mark.slow
def test_who_yielded_answers_for_nothing_where_the_mode_flaps_back() -> None:
    around = in_flight("ardupilot")
    around.operator.choose(FlightMode.HOLD)
    around.flight.run(1.2)
    around.operator.choose(FlightMode.OFFBOARD)
    around.flight.run(1.2)
    assert around.flight.companion.session.phase is Phase.YIELD
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(0.5)
    assert around.monitor.fence.breaches == 0


@pytest.mark.slow
def test_a_vehicle_without_motors_falls_wherever_it_falls() -> None:
    around = in_flight("ardupilot")
    around.injector.inject(Schedule(faults=(Disarm(),)))
    around.flight.run(0.3)
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(0.3)
    assert not body.is_on_ground
    assert around.monitor.fence.breaches == 0


@pytest.mark.slow
def test_its_own_way_out_of_the_fence_is_one() -> None:
    around = in_flight("ardupilot")
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(1.0)
    assert around.monitor.fence.breaches == 1


@pytest.mark.slow
def test_without_key_and_hardware_id_a_stranger_is_followed_after_a_silence() -> None:
    around = in_flight("ardupilot", uid=0)
    silence = LinkBlackout(start_s=1.0, duration_s=12.0, direction="to_companion")
    stranger = UnsignedFrames(start_s=6.0, duration_s=4.0, rate_hz=130.0)
    around.injector.inject(Schedule(faults=(silence, stranger)))
    around.flight.run(30.0)
    assert said(around.notes, "from another address")
    assert [v for v in around.monitor.violations if v.invariant == "I10"] == []


@pytest.mark.slow
def test_places_in_a_flood_of_a_stranger_that_is_followed_are_no_measure() -> None:
    around = in_flight("px4", uid=0)
    hold = LinkBlackout(start_s=1.0, duration_s=12.0, direction="to_companion")
    liar = ForgedFrames(start_s=5.0, duration_s=7.0, rate_hz=400.0)
    around.injector.inject(Schedule(faults=(hold, liar)))
    around.flight.run(9.0)
    assert around.monitor.scene.is_lied_to
    around.flight.run(25.0)
    assert not around.monitor.scene.is_lied_to
    assert around.monitor.violations == []


def frame(time_s: float, message: Message = ATTITUDE, *, is_genuine: bool = True) -> Frame:
    data = MavCodec(1, 1).encode(message)
    return Frame(time_s, data, Lane.TO_COMPANION, is_genuine=is_genuine)


def followed() -> SenderTrust:
    whose = SenderTrust()
    assert whose.accepts(frame(0.0, HEARTBEAT))
    return whose


def test_a_stranger_is_not_believed_beside_the_vehicle() -> None:
    whose = followed()
    assert not whose.accepts(frame(SILENCE_S - 0.1, is_genuine=False))
    assert whose.accepts(frame(SILENCE_S - 0.05))


def test_the_payload_of_a_stranger_is_believed_while_that_is_followed() -> None:
    whose = followed()
    payload = Frame(0.1, MavCodec(1, 158).encode(ATTITUDE), Lane.TO_COMPANION, is_genuine=False)
    of_another = Frame(0.1, MavCodec(77, 158).encode(ATTITUDE), Lane.TO_COMPANION, is_genuine=False)
    assert not whose.is_beside_unknown_peer(payload)
    assert whose.accepts(frame(SILENCE_S, is_genuine=False))
    assert whose.is_beside_unknown_peer(payload)
    assert not whose.is_beside_unknown_peer(of_another)


def test_a_stranger_is_followed_after_a_silence_and_the_vehicle_after_another() -> None:
    whose = followed()
    assert whose.accepts(frame(SILENCE_S, is_genuine=False))
    assert not whose.accepts(frame(SILENCE_S + 0.1))
    assert whose.accepts(frame(2.0 * SILENCE_S + 0.1))


def attitude(stamp_s: float) -> Message:
    return mavlink.MAVLink_attitude_message(round(1e3 * stamp_s), *[0.0] * 6)


def position(stamp_s: float, east_m: float) -> Message:
    stamp_ms = round(1e3 * stamp_s)
    return mavlink.MAVLink_local_position_ned_message(stamp_ms, 0.0, east_m, *[0.0] * 4)


@pytest.mark.parametrize(
    ("message", "is_followed"),
    [
        (attitude(108.0), True),
        (position(108.0, 100.0), True),
        (attitude(3.0), True),  # of a clock that restarted
        (HEARTBEAT, False),
        (attitude(96.0), False),
        (attitude(112.0), False),
        (position(108.0, 400.0), False),
    ],
)
def test_a_stranger_is_followed_only_if_its_clock_and_place_go_on(
    message: Message, *, is_followed: bool
) -> None:
    whose = followed()
    assert whose.accepts(frame(100.0, position(100.0, 0.0)))
    assert whose.accepts(frame(108.0, message, is_genuine=False)) is is_followed
    assert whose.follows_unknown_peer is is_followed
    assert whose.accepts(frame(108.1, HEARTBEAT)) is not is_followed


def test_with_a_hardware_id_a_stranger_is_followed_that_answers_the_same() -> None:
    whose = followed()
    answer = mavlink.MAVLink_autopilot_version_message(
        0, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 7
    )
    assert whose.accepts(frame(0.1, answer))
    assert not whose.accepts(frame(0.1 + SILENCE_S, is_genuine=False))
    assert whose.accepts(frame(0.2 + SILENCE_S, answer, is_genuine=False))


def test_in_a_stall_the_vehicle_is_not_silent() -> None:
    whose = followed()
    whose.ticked_s = 1.0
    assert not whose.accepts(frame(9.0, is_genuine=False))
    whose.ticked_s = SILENCE_S
    assert whose.accepts(frame(9.0, is_genuine=False))


def test_a_stranger_whose_frame_was_dropped_unread_is_not_followed() -> None:
    whose = followed()
    assert whose.accepts(frame(SILENCE_S, is_genuine=False))
    whose.dropped()
    assert not whose.follows_unknown_peer
    assert whose.accepts(frame(SILENCE_S + 0.1))


def quiet_beside_a_stranger(make: MakeCompanion | None, quiet: Fault) -> set[str]:
    """Return the broken invariants if the vehicle falls silent and a stranger with its ids not."""
    around = monitored_flight(AUTO, COPTER, 1, make_companion=make)
    around.flight.run(18.0)
    flood = UnsignedFrames(start_s=0.9, duration_s=8.0, rate_hz=70.0)
    around.injector.inject(Schedule(faults=(flood, quiet)))
    around.flight.run(13.0)
    return {violation.invariant for violation in around.monitor.violations}


STALL = CompanionStalled(start_s=1.008, duration_s=9.0)
"""Frames of both wait in the socket, a stranger's first."""
BLACKOUT = LinkBlackout(start_s=1.0, duration_s=6.0, direction="to_companion")


@pytest.mark.slow
@pytest.mark.parametrize("quiet", [STALL, BLACKOUT])
def test_who_asks_a_new_address_for_proof_breaks_nothing(quiet: Fault) -> None:
    assert quiet_beside_a_stranger(None, quiet) == set()


@pytest.mark.slow
def test_who_moves_to_a_new_address_without_proof_is_found() -> None:
    assert FollowsTheNextPeer.invariant in quiet_beside_a_stranger(FollowsTheNextPeer, BLACKOUT)


def test_before_a_heartbeat_and_after_a_restart_no_sender_is_followed() -> None:
    whose = followed()
    whose.restart()
    assert not whose.accepts(frame(1.0, is_genuine=False))
    assert whose.accepts(frame(1.1, HEARTBEAT, is_genuine=False))
    assert not whose.accepts(frame(1.2))


def test_of_two_autopilots_the_first_that_is_heard_is_followed_for_good() -> None:
    whose = SenderTrust()
    other = MavCodec(77, 1).encode(HEARTBEAT)
    assert whose.accepts(Frame(1.0, other, Lane.TO_COMPANION, is_genuine=False))
    assert whose.follows_unknown_peer
    assert not whose.accepts(frame(1.1, HEARTBEAT))
    assert not whose.accepts(frame(1.0 + 2.0 * SILENCE_S, HEARTBEAT))
    whose.restart()
    assert whose.accepts(frame(9.0, HEARTBEAT))
    assert not whose.accepts(Frame(20.0, other, Lane.TO_COMPANION, is_genuine=False))


def test_a_station_and_a_vehicle_that_is_not_wanted_are_not_followed() -> None:
    station = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    other = Frame(1.0, MavCodec(77, 1).encode(HEARTBEAT), Lane.TO_COMPANION, is_genuine=False)
    whose = SenderTrust(wanted_system_id=1)
    assert not whose.accepts(frame(0.5, station, is_genuine=False))
    assert not whose.accepts(other)
    assert whose.accepts(frame(1.5, HEARTBEAT))
    assert not whose.follows_unknown_peer


@pytest.mark.slow
def test_who_yields_answers_for_its_last_setpoint_while_that_is_flown() -> None:
    """An ArduPilot that was left in GUIDED flies to it, however long no setpoints come."""
    around = in_flight("ardupilot")
    around.monitor.noted("phase", {"new": "yield"}, around.flight.now_s)
    around.flight.run(6.0)
    body = around.flight.sim.vehicle.body
    body.position_enu_m = (-200.0, -200.0, body.position_enu_m[2])
    around.flight.run(0.1)
    assert around.monitor.fence.breaches == 1
