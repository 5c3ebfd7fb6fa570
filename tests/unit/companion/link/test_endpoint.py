"""CompanionEndpoint on its own: identity, addressing, commands, rates, hostile bytes."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from companion.config.schema import CompanionConfig
from companion.domain import PositionSetpoint
from companion.errors import LocalProtocolError
from companion.guidance.commands import SendSetpoint
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.phases import Phase
from companion.link.interface import LinkParams, VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from tests.unit.companion.link.wire import (
    OFFBOARD,
    PEER,
    STRANGER,
    Wire,
    heartbeat,
    home_position,
    local_position,
    origin,
)
from tests.unit.companion.mav.framing_helpers import unknown

LocalTarget = mavlink.MAVLink_set_position_target_local_ned_message
GlobalTarget = mavlink.MAVLink_set_position_target_global_int_message
Ack = mavlink.MAVLink_command_ack_message
GRANT = mavlink.MAV_CMD_NAV_GUIDED_ENABLE
NAN = math.nan


def command(number: int, p1: float = 0.0, system: int = 1, component: int = 191) -> Message:
    return mavlink.MAVLink_command_long_message(
        system, component, number, 0, p1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )


def ranging(range_m: float = 60.0, stamp_us: int = 1_000_000) -> Message:
    return MAVLink_radio_ranging_message(stamp_us, range_m, 1.0, 0.5, 0.1, NAN, NAN, 7, 255, 0)


def fly(wire: Wire, duration_s: float) -> None:
    """Let time pass in which the autopilot reports its position and offboard mode."""
    for tick in range(round(duration_s / 0.05)):
        wire.wait(0.05)
        wire.say(wire.position())
        if tick % 10 == 0:
            wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))


def test_it_speaks_with_the_vehicles_system_id_as_component_191() -> None:
    wire = Wire(system_id=42)
    wire.say(heartbeat(), sender=MavCodec(42, 1))
    wire.wait(2.0)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in wire.sent} == {(42, 191)}
    targets = {m.target_system for m in wire.of(mavlink.MAVLink_command_long_message)}
    assert targets == {42}
    assert {chunk.peer for chunk in wire.raw} == {PEER}


def test_sequence_numbers_have_no_gap() -> None:
    wire = Wire().ready()
    fly(wire, 20.0)
    numbers = [chunk.data[4] for chunk in wire.raw]
    assert len(numbers) > 300
    assert all(b == (a + 1) % 256 for a, b in pairwise(numbers))


def test_a_tick_that_comes_late_is_not_made_up_for() -> None:
    wire = Wire().ready()
    wire.now_s += 3.0
    wire.say(wire.position())
    wire.endpoint.handle_timer(wire.now_s)
    assert wire.endpoint.next_timer_s() == pytest.approx(wire.now_s + 0.05)
    wire.now_s += 0.05 + 0.02
    wire.endpoint.handle_timer(wire.now_s)
    assert wire.endpoint.next_timer_s() == pytest.approx(wire.now_s + 0.03)


def test_standby_setpoints_have_the_rate_the_view_shows() -> None:
    wire = Wire().ready()
    for _ in range(80):
        wire.wait(0.05)
        wire.say(wire.position())
    assert wire.endpoint.outlet.setpoint_rate_hz(wire.now_s) == pytest.approx(20.0, abs=0.5)
    assert wire.endpoint.outlet.setpoints_sent == len(wire.of(LocalTarget))


def fly_over_a_lossy_line(wire: Wire, loss: float, duration_s: float) -> int:
    """Positions at 50 Hz, a share of them lost; returns the number of setpoints sent."""
    wire.say(heartbeat(is_armed=True, status=4))
    before, lost = wire.endpoint.outlet.setpoints_sent, 0.0
    for _ in range(round(duration_s / 0.02)):
        wire.wait(0.02)
        lost += loss
        if lost >= 1.0:
            lost -= 1.0
            wire.autopilot.encode(wire.position())
        else:
            wire.say(wire.position())
    return wire.endpoint.outlet.setpoints_sent - before


def test_setpoints_come_more_often_where_frames_get_lost_and_slow_down_after_calm() -> None:
    wire = Wire().ready()
    assert fly_over_a_lossy_line(wire, 0.1, 5.0) == pytest.approx(100, abs=3)
    fly_over_a_lossy_line(wire, 0.3, 3.0)
    assert fly_over_a_lossy_line(wire, 0.3, 5.0) == pytest.approx(250, abs=5)
    fly_over_a_lossy_line(wire, 0.0, 9.0)
    assert fly_over_a_lossy_line(wire, 0.0, 5.0) == pytest.approx(100, abs=3)


@pytest.mark.parametrize(("peer", "setpoints"), [(PEER, 40), (STRANGER, 100)])
def test_a_message_that_the_dialect_lacks_is_no_lost_frame(
    peer: tuple[str, int], setpoints: int
) -> None:
    wire = Wire().ready()
    wire.say(heartbeat(is_armed=True, status=4))
    counts = []
    for _ in range(200):
        wire.wait(0.02)
        wire.say(wire.position())
        wire.bytes(unknown(wire.autopilot.encode(wire.position())), peer=peer)
        counts.append(wire.endpoint.outlet.setpoints_sent)
    assert counts[-1] - counts[99] == pytest.approx(setpoints, abs=3)


def test_the_pace_is_configured() -> None:
    config = CompanionConfig(link=LinkParams(rate_hz=25.0))
    wire = Wire(config).ready()
    assert fly_over_a_lossy_line(wire, 0.1, 8.0) == pytest.approx(200, abs=3)


def test_its_own_frames_come_back_without_effect() -> None:
    wire = Wire().ready()
    frames = wire.journal.frames
    echo = MavCodec(1, 191)
    assert wire.say(command(GRANT, 1.0), sender=echo) == []
    assert wire.say(ranging(), sender=echo) == []
    assert wire.journal.frames == frames


def test_a_grant_is_accepted_and_announced_to_its_sender() -> None:
    wire = Wire().ready(OFFBOARD)
    wire.say(heartbeat(is_armed=True, status=4))
    assert wire.endpoint.session.phase is Phase.YIELD
    said, ack = wire.say(command(GRANT, 1.0), sender=MavCodec(255, 190))
    assert isinstance(said, mavlink.MAVLink_statustext_message)
    assert isinstance(ack, Ack)
    assert (ack.command, ack.result) == (GRANT, 0)
    assert (ack.target_system, ack.target_component) == (255, 190)
    assert wire.endpoint.session.phase.value == "standby"


@pytest.mark.parametrize("p1", [0.0, 2.0, NAN])
def test_a_grant_that_is_none_is_denied(p1: float) -> None:
    wire = Wire().ready(OFFBOARD)
    wire.say(heartbeat(is_armed=True, status=4))
    said, ack = wire.say(command(GRANT, p1), sender=MavCodec(255, 190))
    assert isinstance(said, mavlink.MAVLink_statustext_message)
    assert said.text == "GRANT refused: parameter 1 must be 1"
    assert isinstance(ack, Ack)
    assert ack.result == mavlink.MAV_RESULT_DENIED
    assert wire.endpoint.session.phase is Phase.YIELD


def test_a_grant_that_would_do_nothing_is_rejected_with_the_reason() -> None:
    wire = Wire().ready(OFFBOARD)
    said, ack = wire.say(command(GRANT, 1.0), sender=MavCodec(255, 190))
    assert isinstance(said, mavlink.MAVLink_statustext_message)
    assert said.text == "GRANT refused: already in control"
    assert isinstance(ack, Ack)
    assert ack.result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED


def test_a_grant_is_rejected_while_the_fence_is_refused() -> None:
    made = Wire().ready()
    torn = AutopilotFenceRead(0.0, problem="item 3: torn", is_unusable=True)
    made.endpoint.session.handle(torn)
    (ack,) = [m for m in made.say(command(GRANT, 1.0)) if isinstance(m, Ack)]
    assert ack.result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert made.endpoint.session.fencing.refusal == "the autopilot's fence: item 3: torn"


def test_a_fence_refused_in_standby_ends_the_stream_and_is_no_fence_to_fly_in() -> None:
    made = Wire().ready()
    assert made.endpoint.session.phase.value == "standby"
    torn = AutopilotFenceRead(0.0, problem="item 3: torn", is_unusable=True)
    made.endpoint.session.handle(torn)
    made.say(made.position())
    sent = [m for m in made.wait(0.5) if isinstance(m, LocalTarget)]
    assert sent == []
    assert made.endpoint.session.phase.value == "waiting"
    made.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    assert made.endpoint.session.phase.value == "waiting"


@pytest.mark.parametrize("number", [22, 176, 246, 400, 511, 65535])
def test_every_other_command_is_unsupported(number: int) -> None:
    wire = Wire().ready()
    (ack,) = wire.say(command(number, 1.0), sender=MavCodec(255, 190))
    assert isinstance(ack, Ack)
    assert (ack.command, ack.result) == (number, 3)


def test_a_message_that_does_not_exist_is_denied() -> None:
    wire = Wire().ready()
    (ack,) = wire.say(command(512, 33.0), sender=MavCodec(255, 190))
    assert isinstance(ack, Ack)
    assert (ack.command, ack.result) == (512, mavlink.MAV_RESULT_DENIED)


def test_a_command_int_is_answered_too() -> None:
    wire = Wire().ready()
    message = mavlink.MAVLink_command_int_message(1, 191, 0, 192, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    (ack,) = wire.say(message, sender=MavCodec(255, 190))
    assert isinstance(ack, Ack)
    assert (ack.command, ack.result) == (192, 3)


@pytest.mark.parametrize(("system", "component"), [(1, 1), (2, 191), (0, 0), (1, 0)])
def test_commands_for_others_are_not_answered(system: int, component: int) -> None:
    wire = Wire().ready()
    assert wire.say(command(GRANT, 1.0, system, component), sender=MavCodec(255, 190)) == []


def test_a_command_from_another_address_is_not_obeyed() -> None:
    wire = Wire().ready(OFFBOARD)
    wire.say(heartbeat(is_armed=True, status=4))
    assert wire.say(command(GRANT, 1.0), sender=MavCodec(255, 190), peer=STRANGER) == []
    assert wire.endpoint.session.phase is Phase.YIELD


def test_an_answer_to_someone_else_is_not_ours() -> None:
    wire = Wire().ready(OFFBOARD)
    fly(wire, 0.5)
    wire.endpoint.request_stop(wire.now_s)
    wire.wait(0.1)
    for target in ((255, 190), (1, 1)):
        wire.say(mavlink.MAVLink_command_ack_message(176, 0, 0, 0, *target))
    assert not wire.endpoint.is_finished
    wire.say(mavlink.MAVLink_command_ack_message(176, 0, 0, 0, 1, 191))
    assert wire.endpoint.is_finished


def test_a_mode_request_is_not_repeated_after_an_override() -> None:
    wire = Wire().ready(OFFBOARD)
    fly(wire, 0.5)
    wire.endpoint.request_stop(wire.now_s)
    sent = wire.wait(0.1)
    assert any(
        isinstance(m, mavlink.MAVLink_command_long_message) and m.command == 176 for m in sent
    )
    wire.say(heartbeat(custom_mode=3 << 16, is_armed=True, status=4))
    later = wire.wait(3.0)
    assert not any(
        isinstance(m, mavlink.MAVLink_command_long_message) and m.command == 176 for m in later
    )
    assert not any(isinstance(m, LocalTarget) for m in later)


def test_ranging_is_taken_from_any_sender_on_an_extra_link() -> None:
    wire = Wire(links=1).ready()
    assert wire.say(ranging(), sender=MavCodec(77, 5), peer=STRANGER, link=1) == []
    wire.wait(0.5)
    assert wire.endpoint.session.tracker.accepted == 1
    assert {chunk.link for chunk in wire.raw} == {0}


def test_an_autopilot_on_an_extra_link_is_not_bound() -> None:
    wire = Wire(links=1)
    wire.say(heartbeat(), link=1)
    assert not wire.endpoint.binding.is_bound


def test_global_setpoints_by_configuration() -> None:
    wire = Wire(CompanionConfig(vehicle=VehicleParams(setpoint="global_int"))).ready()
    wire.say(wire.position())
    wire.wait(0.2)
    assert wire.of(GlobalTarget)
    assert not wire.of(LocalTarget)
    target = wire.of(GlobalTarget)[-1]
    assert (target.lat_int, target.lon_int, target.alt) == (470000000, 80000000, 508.0)


def test_a_setpoint_that_is_not_finite_is_not_sent() -> None:
    wire = Wire().ready()
    before = len(wire.raw)
    bad = SendSetpoint(PositionSetpoint((NAN, 0.0, 10.0)))
    with pytest.raises(LocalProtocolError):
        wire.endpoint.executor.execute(bad, wire.now_s)
    wire._collect()
    assert len(wire.raw) == before


# Hostile bytes


def state_of(wire: Wire) -> tuple[object, ...]:
    session = wire.endpoint.session
    return (session.phase, session.vehicle.heartbeat, session.vehicle.home_enu_m,
            session.vehicle.position_enu_m, session.tracker.accepted)  # fmt: skip


def test_ten_thousand_broken_datagrams_between_good_ones_do_nothing() -> None:
    rng = random.Random(7)
    wire = Wire().ready()
    good = MavCodec(1, 1).encode(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    before = state_of(wire)
    for number in range(10_000):
        kind = number % 3
        if kind == 0:
            data = rng.randbytes(rng.randrange(300))
        elif kind == 1:
            data = good[: rng.randrange(len(good))]
        else:
            flipped = bytearray(good)
            flipped[rng.randrange(len(good) - 2)] ^= 1 << rng.randrange(8)
            data = bytes(flipped)
        assert wire.bytes(data) == []
        if number % 100 == 99:
            wire.wait(0.05)
        if number % 1000 == 999:
            assert state_of(wire) == before
    wire.say(wire.position())
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    assert wire.endpoint.session.phase is Phase.HOLD
    assert wire.endpoint.bad_frames > 0


_float32 = st.floats(width=32)
_u8, _u16 = st.integers(0, 255), st.integers(0, 65535)
_u32, _u64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)
_i32 = st.integers(-(2**31), 2**31 - 1)
_modes = st.one_of(st.sampled_from([OFFBOARD, 4 << 16 | 3 << 24]), _u32)
_kinds = st.one_of(
    st.builds(
        mavlink.MAVLink_heartbeat_message,
        _u8, st.one_of(st.just(12), _u8), _u8, _modes, _u8, _u8,
    ),
    st.builds(mavlink.MAVLink_local_position_ned_message, _u32, *[_float32] * 6),
    st.builds(mavlink.MAVLink_attitude_message, _u32, *[_float32] * 6),
    st.builds(mavlink.MAVLink_extended_sys_state_message, _u8, _u8),
    st.builds(mavlink.MAVLink_gps_global_origin_message, _i32, _i32, _i32),
    st.builds(
        mavlink.MAVLink_home_position_message,
        _i32, _i32, _i32, _float32, _float32, _float32,
        st.lists(_float32, min_size=4, max_size=4), _float32, _float32, _float32,
    ),
    st.builds(MAVLink_radio_ranging_message, _u64, *[_float32] * 6, _u16, _u8, _u8),
    st.builds(
        mavlink.MAVLink_landing_target_message,
        _u64, _u8, _u8, *[_float32] * 5, type=st.sampled_from([0, 1]),
    ),
    st.builds(mavlink.MAVLink_ranging_beacon_message, _u64, *[_u8] * 3, _u32, _i32, _i32,
              _i32, _u8, _u32, _u32, _u32, _u32, _u8, _u8),
    st.builds(mavlink.MAVLink_command_ack_message, _u16, _u8, _u8, _i32, _u8, _u8),
    st.builds(mavlink.MAVLink_command_long_message, _u8, _u8, _u16, _u8, *[_float32] * 7),
    st.builds(mavlink.MAVLink_statustext_message, _u8, st.binary(max_size=50), _u16, _u8),
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(_kinds, st.floats(0.0, 0.3)), max_size=25))
def test_whatever_the_fields_say_no_setpoint_leaves_fence_or_numbers(
    said: list[tuple[Message, float]],
) -> None:
    wire = Wire(links=1).ready(OFFBOARD)
    fly(wire, 0.2)
    for message, waited_s in said:
        try:
            data = wire.autopilot.encode(message)
        except LocalProtocolError:
            continue
        wire.bytes(data)
        wire.wait(waited_s)
    fly(wire, 0.3)
    assert wire.endpoint.bad_frames == 0
    for target in wire.of(LocalTarget):
        assert max(abs(target.x), abs(target.y)) <= 147.0 + 1e-4
        assert math.isfinite(target.z)


def test_after_hostile_fields_the_next_good_message_counts() -> None:
    wire = Wire().ready()
    for message in (
        local_position(10, *[NAN] * 6),
        local_position(20, *[3e38] * 6),
        origin(2**31 - 1, 2**31 - 1),
        home_position(0, 0),
        home_position(-(2**31), -(2**31)),
    ):
        wire.say(message)
    assert wire.endpoint.session.vehicle.position_enu_m == (0.0, 0.0, 20.0)
    assert wire.endpoint.session.vehicle.home_enu_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    wire.now_s += 0.5
    wire.say(local_position(500, 3.0, 4.0, -5.0, 0.0, 0.0, 0.0))
    assert wire.endpoint.session.vehicle.position_enu_m == (4.0, 3.0, 5.0)


def test_another_vehicles_radio_on_the_shared_port_is_not_listened_to() -> None:
    wire = Wire().ready()
    wire.say(ranging(stamp_us=1_000_000), sender=MavCodec(2, 158))
    wire.say(ranging(stamp_us=1_100_000), sender=MavCodec(1, 158))
    wire.wait(1.0)
    tracker = wire.endpoint.session.tracker
    assert tracker.accepted + sum(tracker.rejected.values()) == 1


def test_before_an_autopilot_is_bound_no_ranging_counts() -> None:
    wire = Wire()
    wire.say(ranging(), sender=MavCodec(1, 158))
    assert wire.endpoint.session.tracker.accepted == 0


def test_the_health_of_the_links_goes_to_the_log() -> None:
    wire = Wire().ready()
    wire.wait(25.0)
    records = [fields for kind, fields in wire.journal.records if kind == "link"]
    assert len(records) >= 3
    assert {"links", "strangers", "accepted", "refused", "restarts"} <= set(records[-1])


def test_global_setpoints_wait_for_the_origin_and_say_so() -> None:
    config = CompanionConfig(vehicle=VehicleParams(setpoint="global_int"))
    wire = Wire(config)
    for _ in range(15):
        wire.say(heartbeat())
        wire.say(home_position())
        wire.say(local_position(round(1000.0 * wire.now_s) + 1))
        wire.wait(1.0)
    assert wire.endpoint.session.phase is Phase.WAITING
    assert any("the origin" in text for text in wire.journal.texts)
