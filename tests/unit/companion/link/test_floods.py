"""The endpoint among strangers: who is heard, what it costs, what is remembered."""

from __future__ import annotations

import time

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.phases import Phase
from companion.link.endpoint import CHECK_PERIOD_S
from companion.link.executor import TEXT_BURST
from companion.link.gcs_services import COMMANDS_PER_S, REQUEST_CAPABILITIES
from companion.link.interface import VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.endpoint import Address
from companion.mav.signing import Signing, SigningKey
from tests.unit.companion.link.test_authenticity import OTHER_KEY, codec
from tests.unit.companion.link.test_authenticity import wire as keyed_wire
from tests.unit.companion.link.wire import (
    HOLD,
    OFFBOARD,
    PEER,
    STRANGER,
    Wire,
    heartbeat,
    home_position,
    local_position,
    origin,
)

NAN = float("nan")
FORGED_PER_S = 20_000
TICK_S = 0.05


def sources(count: int) -> list[Address]:
    return [(f"10.1.{n // 250}.{n % 250}", 1000 + n) for n in range(count)]


def flood(wire: Wire, frames: list[bytes], peers: list[Address], seconds: float) -> float:
    """Genuine positions at 20 Hz among forged frames; processor seconds per second of it."""
    per_tick = round(FORGED_PER_S * TICK_S)
    ticks, number = round(seconds / TICK_S), 0
    began_s = time.process_time()
    for tick in range(ticks):
        for _ in range(per_tick):
            number += 1
            wire.bytes(frames[number % len(frames)], peer=peers[number % len(peers)])
        wire.say(wire.position())
        if tick % 10 == 0:
            wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
        wire.wait(TICK_S)
    return (time.process_time() - began_s) / seconds


@pytest.mark.parametrize("peer_count", [1, 1000])
@pytest.mark.parametrize("is_keyed", [False, True])
def test_a_flood_of_forged_frames_changes_nothing_and_costs_little(
    is_keyed: bool, peer_count: int
) -> None:
    wire = (keyed_wire() if is_keyed else Wire()).ready(OFFBOARD)
    lie = heartbeat(custom_mode=3 << 16, is_armed=True)
    forger = codec(OTHER_KEY) if is_keyed else MavCodec(1, 1)
    frames = [forger.encode(lie) for _ in range(50)]
    share = flood(wire, frames, sources(peer_count), 2.0)
    assert wire.endpoint.session.phase is Phase.HOLD
    assert wire.endpoint.outlet.setpoint_rate_hz(wire.now_s) == pytest.approx(20.0, abs=1.0)
    assert wire.endpoint.binding.peer == PEER
    assert share < 0.9  # of one processor, also a slow and busy one
    assert wire.journal.frames < 400
    assert sum("flood" in text for text in wire.journal.texts) == 1


def test_with_a_key_even_a_flood_from_the_autopilots_own_address_does_not_silence_it() -> None:
    wire = keyed_wire().ready(OFFBOARD)
    frames = [codec(OTHER_KEY).encode(heartbeat()) for _ in range(50)]
    flood(wire, frames, [PEER], 2.0)
    assert wire.endpoint.session.phase is Phase.HOLD
    assert wire.endpoint.outlet.setpoint_rate_hz(wire.now_s) == pytest.approx(20.0, abs=1.0)


CONSUMED: list[Message] = [
    heartbeat(custom_mode=3 << 16, is_armed=True),
    local_position(99_000, 90.0, 90.0, -9.0, 0.0, 0.0, 0.0),
    mavlink.MAVLink_attitude_message(99_000, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0),
    home_position(48 * 10**7),
    origin(48 * 10**7),
    mavlink.MAVLink_extended_sys_state_message(0, 1),
    mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    mavlink.MAVLink_command_ack_message(176, 0, 0, 0, 1, 191),
    mavlink.MAVLink_command_long_message(1, 191, 92, 0, 1.0, *[0.0] * 6),
    mavlink.MAVLink_statustext_message(0, b"lies", 0, 0),
    MAVLink_radio_ranging_message(1_000_000, 60.0, 1.0, 0.5, 0.1, NAN, NAN, 7, 255, 0),
]


def state(wire: Wire) -> tuple[object, ...]:
    session = wire.endpoint.session
    vehicle = session.vehicle
    return (
        session.phase,
        vehicle.heartbeat,
        vehicle.home_enu_m,
        vehicle.origin,
        vehicle.landed,
        vehicle.position_enu_m,
        vehicle.track.attitude_at(wire.now_s),
        session.tracker.accepted,
        sum(session.tracker.rejected.values()),
        wire.endpoint.binding.peer,
        wire.endpoint.binding.heard_s,
        len(wire.journal.records),
    )


@pytest.mark.parametrize("message", CONSUMED, ids=lambda m: m.get_type())
def test_no_message_that_we_consume_is_taken_from_another_address(message: Message) -> None:
    wire = Wire().ready(OFFBOARD)
    wire.wait(0.3)
    wire.say(wire.position())
    before = state(wire)
    assert wire.say(message, peer=STRANGER, sender=MavCodec(1, 1)) == []
    wire.endpoint.handle_timer(wire.now_s)
    assert state(wire)[:-1] == before[:-1]


def test_strangers_with_the_autopilots_ids_are_reported_rarely() -> None:
    wire = Wire().ready()
    for _ in range(100):
        wire.say(heartbeat(), peer=STRANGER)
        wire.say(wire.position())
        wire.wait(0.05)
    said = [text for text in wire.journal.texts if "from other senders were ignored" in text]
    assert len(said) == 1
    assert 1 <= int(said[0].split()[0]) <= 20 * CHECK_PERIOD_S


def listening() -> Wire:
    """Nothing is configured: system 1 was bound, because it was the only one."""
    wire = Wire(system_id=None)
    for _ in range(4):
        wire.say(heartbeat())
        wire.wait(1.0)
    return wire.ready()


def test_two_systems_without_a_configured_id_are_named_once_and_not_flown() -> None:
    wire = listening()
    for _ in range(50):
        for system in (2, 3):
            wire.say(heartbeat(), sender=MavCodec(system, 1))
        wire.say(wire.position())
        wire.wait(0.05)
    assert wire.endpoint.session.phase is Phase.WAITING
    said = [text for text in wire.journal.texts if "autopilots" in text]
    assert said == [
        "no control: systems 1 and 2 are autopilots on this link: set vehicle.system_id"
    ]


def test_in_control_another_autopilot_is_ignored_and_announced_once() -> None:
    wire = listening()
    wire.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    for _ in range(50):
        for system in (2, 3):
            wire.say(heartbeat(), sender=MavCodec(system, 1))
        wire.say(wire.position())
        wire.wait(0.05)
    assert wire.endpoint.session.phase is Phase.HOLD
    assert wire.endpoint.binding.system_id == 1
    assert [text for text in wire.journal.texts if "another autopilot" in text] == [
        f"another autopilot is on this link, system {system}; ours is 1 (vehicle.system_id chooses)"
        for system in (2, 3)
    ]


def test_a_stranger_who_is_every_autopilot_makes_few_texts() -> None:
    wire = listening()
    for system in range(2, 250):
        wire.say(heartbeat(), sender=MavCodec(system, 1))
        wire.wait(0.05)
    assert sum("autopilots on this link" in text for text in wire.journal.texts) == 1


def test_whoever_asked_for_a_system_is_announced_no_other() -> None:
    wire = Wire(CompanionConfig(vehicle=VehicleParams(system_id=1))).ready()
    wire.say(heartbeat(), sender=MavCodec(2, 1))
    wire.wait(0.1)
    assert not [text for text in wire.journal.texts if "another autopilot" in text]
    assert wire.endpoint.session.phase is Phase.STANDBY


def test_a_restarted_router_is_followed_after_silence_and_announced() -> None:
    wire = Wire().ready()
    wire.say(wire.position(), peer=PEER)
    wire.wait(3.05)  # the tick after 3 s of silence
    moved = ("127.0.0.1", 40_001)
    wire.say(heartbeat(custom_mode=HOLD), peer=moved)
    assert wire.endpoint.binding.peer == PEER  # ids alone prove nothing
    wire.wait(0.1)
    assert moved in {chunk.peer for chunk in wire.raw}  # so it is asked
    wire.say(wire.position(), peer=moved)
    wire.wait(0.1)
    assert wire.endpoint.binding.peer == ("127.0.0.1", 40_001)
    wire.wait(CHECK_PERIOD_S)
    assert any("from another address: 127.0.0.1:40001" in text for text in wire.journal.texts)


def test_with_a_key_the_address_is_followed_at_once() -> None:
    wire = keyed_wire().ready()
    wire.say(wire.position())
    wire.wait(0.55)
    wire.say(wire.position(), peer=STRANGER)
    assert wire.endpoint.binding.peer == STRANGER


def test_a_flood_of_commands_is_not_answered_with_a_flood() -> None:
    wire = Wire().ready()
    message = mavlink.MAVLink_command_long_message(1, 191, 400, 0, *[0.0] * 7)
    station = MavCodec(255, 190)
    for _ in range(20):
        for _ in range(50):
            wire.say(message, sender=station)
        wire.wait(0.05)
    acks = wire.of(mavlink.MAVLink_command_ack_message)
    assert COMMANDS_PER_S <= len(acks) <= 2 * COMMANDS_PER_S + 1


def test_a_flood_of_texts_is_noted_in_part_and_harmless() -> None:
    wire = Wire().ready()
    text = mavlink.MAVLink_statustext_message(6, b"a\nb\x1b[31m\x00" + b"x" * 20, 0, 0)
    for _ in range(20):
        for _ in range(100):
            wire.say(text)
        wire.wait(0.05)
    records = [f for kind, f in wire.journal.records if kind == "autopilot_text"]
    assert TEXT_BURST <= len(records) <= 2 * TEXT_BURST
    assert records[-1]["dropped"]
    assert all(str(f["text"]).isprintable() for f in records)


def test_the_tab_behind_texts_of_px4_is_left_out() -> None:
    wire = Wire().ready()
    wire.say(mavlink.MAVLink_statustext_message(2, b"Failsafe activated\t", 0, 0))
    (record,) = [f for kind, f in wire.journal.records if kind == "autopilot_text"]
    assert record["text"] == "Failsafe activated"


ALL_COMMANDS = sorted(mavlink.enums["MAV_CMD"])


def test_of_all_commands_only_the_grant_and_questions_about_us_are_known() -> None:
    wire = Wire().ready()
    station, results = MavCodec(255, 190), {}
    for number in ALL_COMMANDS:
        wire.wait(0.05)
        message = mavlink.MAVLink_command_long_message(1, 191, number, 0, *[1.0] * 7)
        (ack,) = [
            m
            for m in wire.say(message, sender=station)
            if isinstance(m, mavlink.MAVLink_command_ack_message)
        ]
        results[ack.command] = ack.result
    known = {number for number, result in results.items() if result != 3}
    assert len(results) == len(ALL_COMMANDS) > 150
    questions = {mavlink.MAV_CMD_REQUEST_MESSAGE, REQUEST_CAPABILITIES}
    assert known == {mavlink.MAV_CMD_NAV_GUIDED_ENABLE} | questions


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 60.0, 9),
        mavlink.MAVLink_param_request_list_message(1, 1),
        mavlink.MAVLink_setup_signing_message(1, 191, list(range(32)), 0),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 191, [0] * 251),
        mavlink.MAVLink_serial_control_message(10, 0, 0, 0, 1, [120] * 70),
        mavlink.MAVLink_set_mode_message(1, 1, 6 << 16),
        mavlink.MAVLink_mission_count_message(1, 191, 3),
    ],
    ids=lambda m: m.get_type(),
)
def test_other_requests_are_neither_obeyed_nor_answered(message: Message) -> None:
    wire = Wire().ready()
    before = state(wire)[:-2]
    assert wire.say(message, sender=MavCodec(255, 190)) == []
    assert state(wire)[:-2] == before


def test_signing_is_not_switched_on_by_a_message() -> None:
    wire = Wire().ready()
    key = SigningKey(bytes(range(1, 33)))
    wire.say(mavlink.MAVLink_setup_signing_message(1, 191, list(key.secret), 0))
    wire.wait(0.1)
    assert not Signing(key).verify(wire.raw[-1].data).is_accepted
