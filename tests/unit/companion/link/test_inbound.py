from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.domain import Attitude, FlightMode, LandedState
from companion.guidance.events import (
    AutopilotRestarted,
    Event,
    HeartbeatReceived,
    HomeSet,
    LandedStateChanged,
    OriginSet,
    VehicleMoved,
    YawMeasured,
)
from companion.guidance.vehicle_track import VehicleTrack
from companion.link.conversion.clock_sync import ClockSync
from companion.link.inbound import VehicleInbound, is_time_request
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.link.wire import (
    ARDUPILOT,
    E7,
    NOBODY,
    OFFBOARD,
    heartbeat,
    home_position,
    local_position,
    origin,
)

NAN = math.nan
INT32_MAX = 2**31 - 1
FENCE_BIT = mavlink.MAV_SYS_STATUS_GEOFENCE


def attitude(boot_ms: int) -> Message:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def only(events: list[Event]) -> Event:
    (event,) = events
    return event


def test_north_east_down_becomes_east_north_up() -> None:
    event = only(VehicleInbound().events(local_position(0, 1, 2, -3, 4, 5, -6), 10.0))
    assert isinstance(event, VehicleMoved)
    assert event.state.position_enu_m == (2.0, 1.0, 3.0)
    assert event.state.velocity_enu_mps == (5.0, 4.0, 6.0)
    assert event.state.time_s == 10.0


def test_a_late_position_is_dated_back() -> None:
    inbound = VehicleInbound()
    inbound.events(local_position(1000), 10.0)
    event = only(inbound.events(local_position(1100), 10.5))
    assert isinstance(event, VehicleMoved)
    assert event.state.time_s == pytest.approx(10.1, abs=1e-3)


def test_an_attitude_keeps_its_sense() -> None:
    message = mavlink.MAVLink_attitude_message(0, 0.1, 0.2, 1.5, 0, 0, 0)
    event = only(VehicleInbound().events(message, 1.0))
    assert isinstance(event, YawMeasured)
    assert (event.measured_at_s, event.yaw_ned_rad) == (1.0, 1.5)
    assert event.tilt_rad == pytest.approx((0.1, 0.2))


@pytest.mark.parametrize("tilt_rad", [math.inf, -math.inf, NAN, 1e30])
def test_a_tilt_that_is_no_number_is_not_reported_and_the_yaw_is(tilt_rad: float) -> None:
    inbound, track = VehicleInbound(), VehicleTrack()
    for boot_ms, roll in ((0, 0.0), (100, tilt_rad)):
        message = mavlink.MAVLink_attitude_message(boot_ms, roll, 0.2, 1.5, 0, 0, 0)
        event = only(inbound.events(message, 1.0 + boot_ms / 1000.0))
        assert isinstance(event, YawMeasured)
        assert (event.tilt_rad is None) == (boot_ms > 0)
        track.add_attitude(event.measured_at_s, Attitude(event.yaw_ned_rad, event.tilt_rad))
    assert track.attitude_at(1.05) == Attitude(1.5)


@pytest.mark.parametrize(("status", "is_ready", "is_failsafe"), [
    (0, False, False), (3, True, False), (4, True, False), (5, False, True), (6, False, True),
    (7, False, False), (8, False, True),
])  # fmt: skip
def test_the_state_of_the_autopilot(status: int, is_ready: bool, is_failsafe: bool) -> None:
    event = only(VehicleInbound().events(heartbeat(status=status), 1.0))
    assert isinstance(event, HeartbeatReceived)
    assert (event.is_ready, event.is_failsafe) == (is_ready, is_failsafe)


def test_modes_of_both_autopilots() -> None:
    px4 = only(VehicleInbound().events(heartbeat(custom_mode=OFFBOARD, is_armed=True), 1.0))
    ardupilot = only(VehicleInbound().events(heartbeat(ARDUPILOT, 4), 1.0))
    assert isinstance(px4, HeartbeatReceived)
    assert isinstance(ardupilot, HeartbeatReceived)
    assert px4.mode is ardupilot.mode is FlightMode.OFFBOARD
    assert px4.is_armed
    assert not ardupilot.is_armed
    assert VehicleInbound().events(heartbeat(NOBODY), 1.0) == []


def test_a_failed_prearm_check_is_not_ready() -> None:
    inbound = VehicleInbound()
    bit = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    for health, is_ready in ((0, False), (bit, True)):
        inbound.events(mavlink.MAVLink_sys_status_message(bit, bit, health, *[0] * 10), 1.0)
        event = only(inbound.events(heartbeat(), 1.0))
        assert isinstance(event, HeartbeatReceived)
        assert event.is_ready == is_ready


@pytest.mark.parametrize(("enabled", "health", "is_failsafe"), [
    (0, 0, False), (0, FENCE_BIT, False), (FENCE_BIT, FENCE_BIT, False), (FENCE_BIT, 0, True),
])  # fmt: skip
def test_a_breached_fence_is_a_failsafe_until_it_is_healthy(
    enabled: int, health: int, is_failsafe: bool
) -> None:
    """ArduPilot's HEARTBEAT stays ACTIVE when its fence changes the mode."""
    inbound = VehicleInbound()
    for now_s, healthy in ((1.0, health), (3.0, FENCE_BIT)):
        fence = (FENCE_BIT, enabled, healthy)
        inbound.events(mavlink.MAVLink_sys_status_message(*fence, *[0] * 10), now_s)
        event = only(inbound.events(heartbeat(ARDUPILOT, 6, is_armed=True), now_s + 0.5))
        assert isinstance(event, HeartbeatReceived)
        assert event.is_failsafe == (is_failsafe and now_s < 3.0)


def test_home_is_placed_by_the_origin_whichever_comes_first() -> None:
    home = home_position(47 * E7 + 900, 8 * E7, 490_000, NAN, NAN, NAN)
    first, second = VehicleInbound(), VehicleInbound()
    events = first.events(origin(), 1.0) + first.events(home, 1.0)
    assert second.events(home, 1.0) == []
    events_other = second.events(origin(), 1.0)
    for event in (events[-1], events_other[-1]):
        assert isinstance(event, HomeSet)
        assert event.position_enu_m == pytest.approx((0.0, 10.0, 2.0), abs=0.02)


def test_without_an_origin_home_is_where_the_message_says() -> None:
    event = only(VehicleInbound().events(home_position(0, 0, 0, 3.0, 4.0, -1.0), 1.0))
    assert event == HomeSet(1.0, (4.0, 3.0, 1.0))


@pytest.mark.parametrize(
    "message",
    [
        origin(0, 0),
        origin(INT32_MAX, 0),
        origin(47 * E7, INT32_MAX),
        home_position(0, 0, 0, NAN, 0.0, 0.0),
        home_position(0, 0, 0, 0.0, 1e30, 0.0),
        home_position(0, 0, 0, 0.0, 0.0, math.inf),
    ],
)
def test_places_that_are_none_are_ignored(message: Message) -> None:
    assert VehicleInbound().events(message, 1.0) == []


@pytest.mark.parametrize(
    "home", [home_position(0, 0), home_position(INT32_MAX), home_position(49 * E7)]
)
def test_a_home_that_cannot_be_is_ignored(home: Message) -> None:
    inbound = VehicleInbound()
    inbound.events(origin(), 1.0)
    assert inbound.events(home, 1.0) == []


def test_the_origin_in_degrees_and_metres() -> None:
    event = VehicleInbound().events(origin(473977420, 85455940, 488123), 1.0)[0]
    assert isinstance(event, OriginSet)
    position = event.origin
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((47.397742, 8.545594))
    assert position.altitude_m == 488.123


def test_unknown_landed_states_are_unknown() -> None:
    inbound = VehicleInbound()
    for value, landed in ((1, LandedState.ON_GROUND), (77, LandedState.UNKNOWN)):
        message = mavlink.MAVLink_extended_sys_state_message(0, value)
        assert inbound.events(message, 1.0) == [LandedStateChanged(1.0, landed, order=0)]


def restart(inbound: VehicleInbound, boot_ms: int, now_s: float) -> list[Event]:
    """Give positions of an autopilot that rebooted, until that is detected."""
    for step in range(20):
        events = inbound.events(local_position(boot_ms + 50 * step), now_s + 0.05 * step)
        if len(events) > 1:
            return events
    return []


def test_a_clock_that_goes_back_is_a_restart_and_forgets_the_frame() -> None:
    inbound = VehicleInbound()
    inbound.events(origin(), 1.0)
    inbound.events(local_position(60_000), 60.0)
    restarted, moved = restart(inbound, 500, 61.0)
    assert isinstance(restarted, AutopilotRestarted)
    assert restarted.time_s <= 61.5
    assert isinstance(moved, VehicleMoved)
    assert moved.state.time_s == pytest.approx(restarted.time_s)
    assert inbound.events(home_position(0, 0, 0, 3.0, 4.0, -1.0), 61.0) == [
        HomeSet(61.0, (4.0, 3.0, 1.0))
    ]


def test_a_missed_restart_is_known_by_stamps_that_stay_late() -> None:
    inbound = VehicleInbound()
    inbound.events(local_position(10_000), 10.0)
    events: list[Event] = []
    for tick in range(30):
        events += inbound.events(local_position(20_000 + 50 * tick), 40.0 + 0.05 * tick)
    restarts_s = [e.time_s for e in events if isinstance(e, AutopilotRestarted)]
    assert restarts_s == pytest.approx([41.0], abs=0.06)
    last = events[-1]
    assert isinstance(last, VehicleMoved)
    assert last.state.time_s == pytest.approx(41.45, abs=0.01)


def test_a_burst_of_old_frames_is_no_restart() -> None:
    inbound = VehicleInbound()
    inbound.events(local_position(10_000), 10.0)
    events: list[Event] = []
    for tick in range(200):
        events += inbound.events(local_position(10_050 + 50 * tick), 20.0 + 0.001 * tick)
    assert not any(isinstance(e, AutopilotRestarted) for e in events)


# The autopilot's clock


def synchronised(up_s: float, down_s: float, offset_s: float = 100.0) -> ClockSync:
    """An exchange of times over a line with these delays, at 50 s."""
    sync = ClockSync()
    sync.due(50.0, 1, 1)
    answer = mavlink.MAVLink_timesync_message(round((50.0 + up_s + offset_s) * 1e9), 50 * 10**9)
    sync.receive(answer, 50.0 + up_s + down_s)
    return sync


def age_at_arrival(inbound: VehicleInbound, down_s: float, offset_s: float = 100.0) -> float:
    """Return the age at arrival of a position that was under way for this time."""
    (moved,) = inbound.events(local_position(round(1e3 * (60.0 + offset_s))), 60.0 + down_s)
    assert isinstance(moved, VehicleMoved)
    return 60.0 + down_s - moved.state.time_s


def test_without_an_exchange_the_shortest_delay_is_taken_for_none() -> None:
    assert age_at_arrival(VehicleInbound(), 0.2) == pytest.approx(0.0)


def test_with_an_exchange_of_times_the_delay_of_the_line_is_known() -> None:
    inbound = VehicleInbound(synchronised(0.2, 0.2))
    assert age_at_arrival(inbound, 0.2) == pytest.approx(0.2)
    assert inbound.clock.offset_at_s(0.0) == pytest.approx(-100.0)


@pytest.mark.parametrize("way_s", [0.2, 0.5, 0.8])
def test_however_long_the_ways_are_nothing_late_counts_as_fresh(way_s: float) -> None:
    inbound = VehicleInbound(synchronised(way_s, way_s))
    assert age_at_arrival(inbound, way_s) == pytest.approx(way_s)


@pytest.mark.parametrize(("up_s", "down_s"), [(0.3, 0.1), (0.0, 0.3)])
def test_unequal_ways_are_wrong_by_half_of_their_difference(up_s: float, down_s: float) -> None:
    inbound = VehicleInbound(synchronised(up_s, down_s))
    assert age_at_arrival(inbound, down_s) == pytest.approx((up_s + down_s) / 2.0)


@pytest.mark.parametrize("their_offset_s", [101.0, 99.7, 1.7e9])
def test_an_exchange_about_another_clock_than_the_stamps_is_left_alone(
    their_offset_s: float,
) -> None:
    inbound = VehicleInbound(synchronised(0.2, 0.2, their_offset_s))
    assert age_at_arrival(inbound, 0.2) == pytest.approx(0.0)


# Order

LANDED, FLYING = (mavlink.MAVLink_extended_sys_state_message(0, n) for n in (1, 2))


def test_a_state_that_was_overtaken_is_no_news() -> None:
    inbound = VehicleInbound()
    assert inbound.events(FLYING, 1.0, 10)
    assert inbound.events(LANDED, 1.1, 9) == []
    assert inbound.overtaken == 1
    assert inbound.events(FLYING, 1.2, 10)  # the same again
    assert inbound.events(LANDED, 1.3, 11)


def test_a_position_from_before_the_origin_moved_is_not_one_in_the_new_frame() -> None:
    inbound = VehicleInbound()
    inbound.events(origin(), 10.0, number=1)
    assert inbound.events(local_position(1000), 10.0, number=2)
    inbound.events(origin(), 10.1, number=4)
    assert inbound.events(local_position(1050), 10.1, number=3)
    inbound.events(origin(48 * E7), 10.2, number=6)
    assert inbound.events(local_position(1100), 10.2, number=5) == []
    assert inbound.overtaken == 1
    assert inbound.events(local_position(1150), 10.3, number=7)
    assert inbound.events(local_position(2300), 11.4, number=5)


def test_an_origin_that_creeps_takes_no_position_with_it() -> None:
    inbound = VehicleInbound()
    for step in range(5):
        inbound.events(origin(47 * E7 + 50 * step), 10.0, number=10 * step)  # half a metre each
        is_moved = step in (2, 4)
        taken = inbound.events(local_position(1000 + 50 * step), 10.0, number=10 * step - 1)
        assert bool(taken) is not is_moved


def test_kinds_overtake_each_other_freely() -> None:
    inbound = VehicleInbound()
    assert inbound.events(FLYING, 1.0, 10)
    assert inbound.events(heartbeat(), 1.0, 9)
    assert inbound.events(home_position(), 1.0, 8)
    assert inbound.events(local_position(1000), 1.0, 7)


@pytest.mark.parametrize(
    ("mode", "is_armed", "is_taken"),
    [(OFFBOARD, True, False), (OFFBOARD, False, True), (3 << 16, True, True)],
)
def test_an_overtaken_heartbeat_may_end_control_but_never_give_it(
    mode: int, is_armed: bool, is_taken: bool
) -> None:
    inbound = VehicleInbound()
    inbound.events(heartbeat(custom_mode=3 << 16, is_armed=True), 1.0, 10)
    late = heartbeat(custom_mode=mode, is_armed=is_armed)
    assert bool(inbound.events(late, 1.1, 9)) is is_taken


def test_after_a_restart_the_order_begins_again() -> None:
    inbound = VehicleInbound()
    inbound.events(local_position(60_000), 60.0, 999)
    inbound.events(FLYING, 60.0, 1000)
    assert restart(inbound, 500, 61.0)
    assert inbound.events(LANDED, 62.0, 5)


@pytest.mark.parametrize("make", [local_position, attitude])
def test_a_clock_that_runs_wild_tells_nothing(make: Callable[[int], Message]) -> None:
    inbound, reported_s = VehicleInbound(), []
    for step in range(100):
        now_s = 0.05 * step
        if inbound.events(make(round(2000.0 * now_s)), now_s):
            reported_s.append(now_s)
    assert reported_s[-1] == pytest.approx(1.0, abs=0.11)


@pytest.mark.parametrize("is_mavlink1", [False, True])
@pytest.mark.parametrize(("tc1", "is_question"), [(0, True), (1, False), (1 << 56, False)])
def test_an_autopilots_question_for_the_time_is_distinguished_from_an_answer(
    tc1: int, is_question: bool, is_mavlink1: bool
) -> None:
    message = mavlink.MAVLink_timesync_message(tc1, 5_000_000_000)
    frame = MavCodec(1, 1).encode(message, is_mavlink1=is_mavlink1)
    assert is_time_request(frame) is is_question
