"""The endpoint with a key: messages that change its state, its output and its texts."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.phases import Phase
from companion.link.endpoint import CHECK_PERIOD_S
from companion.link.intake import REPORT_PERIOD_S
from companion.link.interface import LinkParams, LinkRole
from companion.mav.codec import MAGIC_V1, MAGIC_V2, MavCodec, frame_crc, without_signature
from companion.mav.dialect import MAVLink_radio_ranging_message, mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import (
    EPOCH_UNIX_S,
    ONE_LINK_EACH,
    LinkSigning,
    Signing,
    SigningKey,
    is_signed,
    timestamp_at,
)
from tests.unit.companion.link.wire import OFFBOARD, STRANGER, Wire, heartbeat

KEY = SigningKey(bytes(range(1, 33)))
OTHER_KEY = SigningKey(bytes(range(2, 34)))
UNIX_S = EPOCH_UNIX_S + 370_000_000.0
NAN = float("nan")


def codec(key: SigningKey = KEY, unix_s: float = UNIX_S, link_id: int = 0) -> MavCodec:
    """An autopilot that signs from a time on."""
    return MavCodec(1, 1, LinkSigning(Signing(key, timestamp_at(unix_s)), link_id))


def wire(config: CompanionConfig | None = None, links: int = 0) -> Wire:
    """A companion with the key, and its autopilot."""
    signing = Signing(KEY, rules=ONE_LINK_EACH)
    made = Wire(config, links, signing=signing, started_unix_s=UNIX_S)
    made.autopilot = codec()
    made.reader = MavCodec(9, 9, LinkSigning(Signing(KEY), 9))
    return made


def in_offboard() -> Wire:
    made = wire().ready(OFFBOARD)
    assert made.endpoint.session.phase is Phase.HOLD
    return made


def test_with_the_key_on_both_sides_it_flies_and_all_it_sends_is_signed() -> None:
    made = in_offboard()
    made.wait(2.0)
    assert len(made.sent) == len(made.raw) > 30
    assert all(is_signed(chunk.data) for chunk in made.raw)


def test_timestamps_follow_the_clock() -> None:
    made = wire().ready()
    made.wait(100.0)
    newest = int.from_bytes(made.raw[-1].data[-12:-6], "little")
    assert newest == pytest.approx(timestamp_at(UNIX_S + made.now_s), abs=1e5)


def test_nothing_unsigned_or_forged_binds_an_autopilot() -> None:
    made = wire()
    made.wait(0.05)
    frames = made.journal.frames
    for forger in (MavCodec(1, 1), codec(OTHER_KEY), codec(unix_s=UNIX_S + 3600.0)):
        made.say(heartbeat(), sender=forger)
    made.bytes(without_signature(made.autopilot.encode(heartbeat()), 50))
    assert not made.endpoint.binding.is_bound
    assert made.journal.frames == frames


@pytest.mark.parametrize("attack", ["unsigned", "MAVLink 1", "forged", "stripped", "replayed"])
def test_a_mode_from_a_sender_without_the_key_changes_nothing(attack: str) -> None:
    made = in_offboard()
    recorded = made.autopilot.encode(heartbeat(custom_mode=3 << 16, is_armed=True))
    made.say(heartbeat(custom_mode=OFFBOARD, is_armed=True, status=4))
    data = {
        "unsigned": MavCodec(1, 1).encode(heartbeat()),
        "MAVLink 1": MavCodec(1, 1).encode(heartbeat(), is_mavlink1=True),
        "forged": codec(OTHER_KEY, UNIX_S + 9.0).encode(heartbeat()),
        "stripped": without_signature(made.autopilot.encode(heartbeat()), 50),
        "replayed": recorded,
    }[attack]
    heard_s, made.now_s = made.endpoint.binding.heard_s, made.now_s + 0.01
    made.bytes(data)
    assert made.endpoint.session.phase is Phase.HOLD
    assert made.endpoint.binding.heard_s == heard_s


def test_what_was_recorded_on_another_link_of_the_autopilot_is_no_news() -> None:
    made = in_offboard()
    recorded = codec(unix_s=UNIX_S - 5.0, link_id=1).encode(heartbeat(is_armed=True))
    made.bytes(recorded)
    assert made.endpoint.session.phase is Phase.HOLD


def test_an_unsigned_radio_status_is_noted_and_says_nothing_about_the_autopilot() -> None:
    made = in_offboard()
    heard_s, frames = made.endpoint.binding.heard_s, made.journal.frames
    made.now_s += 0.01
    status = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    made.say(status, sender=MavCodec(1, 1))
    assert made.endpoint.binding.heard_s == heard_s
    assert made.journal.frames == frames + 1


def test_refusals_are_reported_within_a_second_and_then_rarely() -> None:
    made = wire()
    for _ in range(1000):
        made.say(heartbeat(), sender=MavCodec(1, 1))
        made.wait(0.05)
    said = [text for text in made.journal.texts if "refused" in text]
    assert "1 x unsigned (does the autopilot sign, with this key?)" in said[0]
    assert len(said) == pytest.approx(50.0 / REPORT_PERIOD_S, abs=1.0)


def test_a_key_holder_with_a_clock_far_ahead_is_an_alarm() -> None:
    made = in_offboard()
    made.say(heartbeat(), sender=codec(unix_s=UNIX_S + 61.0))
    made.wait(CHECK_PERIOD_S)
    assert any(
        "too far ahead (the sender has the key; set its clock" in t for t in made.journal.texts
    )
    assert made.endpoint.session.phase is Phase.HOLD


def test_the_wall_clock_may_still_be_set_before_an_autopilot_is_heard() -> None:
    made = wire()
    made.autopilot = codec(unix_s=UNIX_S + 1e7)
    made.say(heartbeat())
    assert not made.endpoint.binding.is_bound
    made.endpoint.authenticity.set_clock(UNIX_S + 1e7, made.now_s)
    made.wait(0.05)
    made.say(heartbeat())
    assert made.endpoint.binding.is_bound


def ranging() -> MAVLink_radio_ranging_message:
    return MAVLink_radio_ranging_message(1_000_000, 60.0, 1.0, 0.5, 0.1, NAN, NAN, 7, 255, 0)


@pytest.mark.parametrize("is_allowed", [False, True])
def test_a_radio_that_cannot_sign_is_heard_only_if_configured(is_allowed: bool) -> None:
    config = CompanionConfig(link=LinkParams(unsigned_ranging=is_allowed))
    made = wire(config, links=1).ready()
    made.say(ranging(), sender=MavCodec(77, 5), link=1)
    made.wait(0.5)
    assert made.endpoint.session.tracker.accepted == is_allowed
    made.say(heartbeat(), sender=MavCodec(1, 1))
    made.wait(0.5)
    assert any("unsigned" in text for text in made.journal.texts)


def frame_of(number: int, *, is_mavlink1: bool = False) -> bytes:
    """Return an unsigned frame of a message with a payload of one zero, from a ground station."""
    kind = mavlink.mavlink_map[number]
    if is_mavlink1:
        payload = bytes(kind.unpacker.size)
        frame = bytes((MAGIC_V1, len(payload), 0, 255, 190, number)) + payload
    else:
        frame = bytes((MAGIC_V2, 1, 0, 0, 0, 255, 190)) + number.to_bytes(3, "little") + bytes(1)
    return frame + frame_crc(frame, kind.crc_extra).to_bytes(2, "little")


@pytest.mark.parametrize("role", LinkRole)
@pytest.mark.parametrize("is_allowed", [False, True])
def test_unsigned_ranging_lets_in_ranging_alone_and_on_ranging_links_alone(
    role: LinkRole, is_allowed: bool
) -> None:
    config = CompanionConfig(link=LinkParams(unsigned_ranging=is_allowed))
    signing = Signing(KEY, rules=ONE_LINK_EACH)
    made = Wire(config, 1, gcs_links=1, signing=signing, started_unix_s=UNIX_S)
    link = list(LinkRole).index(role)
    taken = set()
    for number in mavlink.mavlink_map:
        made.now_s += 1.0
        made.endpoint.handle_timer(made.now_s)  # which renews the budget
        intake = made.endpoint._intakes[link]
        frames = [frame_of(number)]
        frames += [frame_of(number, is_mavlink1=True)] if number < 256 else []
        for frame in frames:
            if list(intake.take(Chunk(link, frame, STRANGER))):
                taken.add(number)
        assert intake.codec.counters.good > 0
    ranging_ids = {MAVLink_radio_ranging_message.id, 149, 513}  # with LANDING_TARGET, a beacon's
    is_open = is_allowed and role is LinkRole.RANGING
    assert taken == {mavlink.MAVLINK_MSG_ID_RADIO_STATUS} | (ranging_ids if is_open else set())
    assert sum(signing.verdicts.values()) > len(mavlink.mavlink_map)


@pytest.mark.parametrize(("links", "gcs_links"), [(1, 0), (0, 1)])
def test_an_unsigned_station_changes_no_parameter_and_gives_no_command(
    links: int, gcs_links: int
) -> None:
    config = CompanionConfig(link=LinkParams(unsigned_ranging=True))
    signing = Signing(KEY, rules=ONE_LINK_EACH)
    made = Wire(config, links, gcs_links=gcs_links, signing=signing, started_unix_s=UNIX_S)
    made.autopilot = codec()
    made.ready()
    speed = mavlink.MAVLink_param_set_message(1, 191, b"CMP_SPEED", 2.0, 9)
    grant = mavlink.MAVLink_command_long_message(1, 191, 92, 0, *(1.0, 0, 0, 0, 0, 0, 0))
    for message in (speed, grant):
        made.say(message, sender=MavCodec(255, 190), link=1)
    made.wait(CHECK_PERIOD_S)
    assert made.endpoint.session.context.guard.limits.envelope.speed_mps == 5.0
    assert made.of(mavlink.MAVLink_command_ack_message) == []
    assert any("refused 2 x unsigned" in text for text in made.journal.texts)
    if gcs_links:  # and the same with the key is heard
        station = MavCodec(255, 190, LinkSigning(Signing(KEY, timestamp_at(UNIX_S + 1.0)), 3))
        made.say(speed, sender=station, link=1)
        assert made.endpoint.session.context.guard.limits.envelope.speed_mps == 2.0


def test_the_verdicts_are_in_the_log() -> None:
    made = in_offboard()
    made.say(heartbeat(), sender=MavCodec(1, 1))
    made.wait(11.0)
    record = [fields for kind, fields in made.journal.records if kind == "link"][-1]
    assert record["signing"] == {"signed": 5, "unsigned": 1}
