"""The suite itself: a defect that is planted must be found by the rule that forbids it."""

from __future__ import annotations

import pytest

from companion.mav.dialect import mavlink
from sim_link.lab.conformance.cli import all_rules
from sim_link.lab.conformance.mavlink_oracle import FrameSpec, build_raw
from sim_link.lab.conformance.rules import Flavour, Role, RuleVerdict, try_rule
from tests.protocol.conformance_rigs import BY_ID, cases, probe_of, simulator, try_on_vehicle
from tests.protocol.tampered import (
    Deaf,
    DeafRecording,
    Edit,
    Tampered,
    drop,
    every,
    full_payload,
    id_of,
    is_version2,
    lose,
    only,
    rebuilt,
    set_byte,
    unchanged,
)

PX4, ARDUPILOT = Flavour.PX4, Flavour.ARDUPILOT
HEARTBEAT, PARAM_VALUE, PING, ATTITUDE = 0, 22, 4, 30
ACK, COMMAND, MISSION_ITEM, LOCAL, SETPOINT = 77, 76, 73, 32, 84
MISSION_REQUEST, STATUSTEXT, TIMESYNC = 51, 253, 111


def break_crc(frame: bytes) -> list[bytes]:
    return [frame[:-1] + bytes((frame[-1] ^ 0x55,))]


def mend_crc(frame: bytes) -> list[bytes]:
    """A receiver that does not look at the CRC."""
    known = is_version2(frame) and id_of(frame) in mavlink.mavlink_map
    return [rebuilt(frame, frame[10 : 10 + frame[1]], frame[2])] if known else [frame]


def ignore_flags(frame: bytes) -> list[bytes]:
    """A receiver that does not look at incompat_flags."""
    return [rebuilt(frame, frame[10 : 10 + frame[1]])] if is_version2(frame) else [frame]


def ignore_target(message_id: int, offset: int) -> Edit:
    """A receiver that takes everything for its own."""

    def edit(frame: bytes) -> list[bytes]:
        payload = full_payload(frame)
        payload[offset : offset + 2] = b"\x01\x01"
        return [rebuilt(frame, bytes(payload))]

    return only(message_id, edit)


def uncut(frame: bytes) -> list[bytes]:
    return [rebuilt(frame, bytes(full_payload(frame)))]


def in_version1(frame: bytes) -> list[bytes]:
    """A sender that does not leave MAVLink 1."""
    number = id_of(frame)
    if number > 255:
        return []
    kind = mavlink.mavlink_map[number]
    spec = FrameSpec(frame[5], frame[6], frame[4], version=1)
    return [build_raw(number, bytes(full_payload(frame)), int(kind.crc_extra), spec)]


def shifted_north(frame: bytes) -> list[bytes]:
    """LOCAL_POSITION_NED that is 64 m or more off."""
    payload = full_payload(frame)
    payload[4:8] = b"\x00\x00\x80\x43"
    return [rebuilt(frame, bytes(payload))]


def as_broadcast(frame: bytes) -> list[bytes]:
    """A receiver that answers every PING."""
    payload = full_payload(frame)
    payload[12:14] = b"\0\0"
    return [rebuilt(frame, bytes(payload).rstrip(b"\0"))]


DEFECTS: dict[str, tuple[str, Flavour, Edit, Edit]] = {
    "no heartbeat": ("heartbeat.once_a_second", PX4, unchanged, every(2, drop(HEARTBEAT))),
    "wrong autopilot": (
        "heartbeat.reports_type_and_autopilot",
        PX4,
        unchanged,
        set_byte(HEARTBEAT, 5, 4),
    ),
    "wrong base_mode": (
        "heartbeat.custom_mode_flag_is_set",
        ARDUPILOT,
        unchanged,
        set_byte(HEARTBEAT, 6, 0),
    ),
    "never armed": (
        "heartbeat.armed_flag_follows_arming",
        PX4,
        unchanged,
        set_byte(HEARTBEAT, 6, 29),
    ),
    "zeros are not cut": ("frames.trailing_zeros_are_cut", PX4, unchanged, uncut),
    "MAVLink 1 only": ("frames.one_version_per_channel", PX4, unchanged, in_version1),
    "broken frames": (
        "frames.every_sent_frame_has_a_right_crc",
        PX4,
        unchanged,
        every(9, break_crc),
    ),
    "CRC not checked": ("frames.bad_crc_is_dropped", PX4, mend_crc, unchanged),
    "CRC_EXTRA not checked": ("frames.wrong_crc_extra_is_dropped", ARDUPILOT, mend_crc, unchanged),
    "flags not checked": ("frames.unknown_incompat_bit_is_dropped", PX4, ignore_flags, unchanged),
    "frames are lost": (
        "frames.sequence_counts_every_message",
        PX4,
        unchanged,
        every(20, lose),
    ),
    "silent about commands": ("commands.unknown_command_is_unsupported", PX4, unchanged, drop(ACK)),
    "two answers": (
        "commands.each_command_gets_one_acknowledgement",
        ARDUPILOT,
        unchanged,
        only(ACK, lambda frame: [frame, frame]),
    ),
    "everything accepted": (
        "commands.unknown_command_is_unsupported",
        ARDUPILOT,
        unchanged,
        set_byte(ACK, 2, 0),
    ),
    "obeys what is for others": (
        "routing.command_for_another_system_is_ignored",
        ARDUPILOT,
        ignore_target(COMMAND, 30),
        unchanged,
    ),
    "answers PING responses": (
        "clocks.ping_response_is_never_answered",
        PX4,
        only(PING, as_broadcast),
        unchanged,
    ),
    "no TIMESYNC": ("clocks.timesync_request_is_answered", ARDUPILOT, unchanged, drop(TIMESYNC)),
    "half the rate": (
        "streams.asked_rate_is_kept",
        PX4,
        unchanged,
        only(ATTITUDE, every(2, lose)),
    ),
    "shifted position": (
        "telemetry.local_and_global_position_agree",
        PX4,
        unchanged,
        only(LOCAL, shifted_north),
    ),
    "a parameter is missing": (
        "parameters.list_is_complete",
        PX4,
        unchanged,
        only(PARAM_VALUE, every(17, lose)),
    ),
    "changed plan": (
        "missions.uploaded_mission_can_be_downloaded",
        PX4,
        unchanged,
        set_byte(MISSION_ITEM, 16, 7),
    ),
    "impatient upload": (
        "missions.items_are_requested_in_order",
        PX4,
        unchanged,
        set_byte(MISSION_REQUEST, 0, 2),
    ),
    "flies another's setpoints": (
        "offboard.setpoint_for_another_system_is_ignored",
        PX4,
        ignore_target(SETPOINT, 50),
        unchanged,
    ),
    "no reason given": ("arming.arming_before_ready_is_refused", PX4, unchanged, drop(STATUSTEXT)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFECTS)
def test_planted_defect_is_found(name: str) -> None:
    rule_id, flavour, inbound, outbound = DEFECTS[name]
    outcome = try_on_vehicle(BY_ID[rule_id], Tampered(simulator(flavour), inbound, outbound))
    assert outcome.verdict in (RuleVerdict.FAIL, RuleVerdict.NOTED)
    assert outcome.detail


@pytest.mark.slow
def test_tampering_with_nothing_is_no_defect() -> None:
    for rule_id in {entry[0] for entry in DEFECTS.values() if entry[1] is PX4}:
        outcome = try_on_vehicle(BY_ID[rule_id], Tampered(simulator(PX4)))
        assert outcome.verdict is RuleVerdict.PASS, f"{rule_id}: {outcome.detail}"


@pytest.mark.parametrize("magic", [0xFD, 0xFE])
@pytest.mark.parametrize("name", ["bad_crc", "wrong_crc_extra", "unknown_incompat_bit"])
def test_a_dropped_frame_with_a_magic_byte_in_it_is_no_defect_on_a_byte_stream(
    name: str, magic: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = mavlink.MAVLink_timesync_message(0, 7_000_000_000 + magic)
    monkeypatch.setattr(
        "sim_link.lab.conformance.vehicle_rules.frame_rules.FrameProbe.question", lambda _: asked
    )
    rule = BY_ID[f"frames.{name}_is_dropped"]
    outcome = try_rule(rule, probe_of(simulator(PX4), rule.book.prober, is_datagram=False))
    assert outcome.verdict is RuleVerdict.PASS, outcome.detail


LISTENS_ONLY = {
    "frames.one_version_per_channel",
    "frames.trailing_zeros_are_cut",
    "frames.sequence_counts_every_message",
    "frames.every_sent_frame_has_a_right_crc",
    "frames.sends_valid_source_ids",
    "heartbeat.once_a_second",
    "heartbeat.comes_from_component_one",
    "heartbeat.reports_type_and_autopilot",
    "heartbeat.is_no_ground_station",
    "heartbeat.custom_mode_flag_is_set",
    "heartbeat.not_ready_is_uninit",
    "streams.default_streams_flow",
    "streams.nothing_flows_until_asked",
}
"""Rules about what a vehicle says by itself; a deaf one may keep them."""


@pytest.mark.slow
@pytest.mark.parametrize("flavour", list(Flavour), ids=lambda flavour: flavour.value)
def test_a_deaf_vehicle_breaks_every_rule_about_what_it_hears(
    flavour: Flavour, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("vehicle_probe",):
        monkeypatch.setattr(f"sim_link.lab.conformance.{module}.READY_S", 5.0)
    monkeypatch.setattr("sim_link.lab.conformance.protocol_clients.LIST_S", 5.0)
    recording = DeafRecording(simulator(flavour))
    kept = {
        rule.rule_id
        for rule, bound in cases(Role.VEHICLE)
        if bound is flavour and try_on_vehicle(rule, Deaf(recording)).verdict is RuleVerdict.PASS
    }
    assert kept <= LISTENS_ONLY


def test_every_rule_says_what_it_asks_and_where_that_is_written() -> None:
    for rule in all_rules():
        assert rule.statement.endswith("."), rule.rule_id
        assert len(rule.source) > 5, rule.rule_id
        assert rule.flavours, rule.rule_id
    assert len(BY_ID) == len(all_rules())


def test_no_rule_hides_a_step_of_its_probe() -> None:
    for rule in all_rules():
        name = rule.rule_id.partition(".")[2]
        assert not any(hasattr(base, name) for base in rule.book.prober.__bases__), rule.rule_id
