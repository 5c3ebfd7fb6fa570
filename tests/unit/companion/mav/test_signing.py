"""Signing against the MAVLink developer guide, an attacker, and pymavlink at the other end."""

from __future__ import annotations

import hashlib
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil

from companion.errors import ConfigError, LocalProtocolError
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.framing import frame_crc, message_id, without_signature
from companion.mav.signing import (
    EPOCH_UNIX_S,
    MAX_BEHIND,
    MAX_HEARD,
    MAX_STREAMS,
    MAX_TIMESTAMP,
    ONE_LINK_EACH,
    LinkSigning,
    Signing,
    SigningKey,
    Stream,
    Verdict,
    is_secret,
    is_signed,
    setup_from,
    timestamp_at,
)

SECRET = bytes(range(1, 33))
KEY = SigningKey(SECRET)
OTHER_KEY = SigningKey(bytes(range(2, 34)))
NOW = 37_000_000_000_000
MAX_AHEAD = 6_000_000
"""A minute."""


def heartbeat(mark: int = 1) -> Message:
    return mavlink.MAVLink_heartbeat_message(2, 12, 0, mark, 4, 3)


def unsigned(mark: int = 1, system: int = 255, component: int = 190) -> bytes:
    return MavCodec(system, component).encode(heartbeat(mark))


def signed(
    timestamp: int,
    key: SigningKey = KEY,
    *,
    link_id: int = 3,
    system: int = 255,
    component: int = 190,
    message: Message | None = None,
) -> bytes:
    """A frame that `key` signs with exactly this timestamp, by the letter of the guide."""
    frame = bytearray(MavCodec(system, component).encode(message or heartbeat()))
    frame[2] |= 1
    crc = frame_crc(bytes(frame), CRC_EXTRA_BY_ID[message_id(bytes(frame))])
    frame[-2:] = crc.to_bytes(2, "little")
    frame += bytes((link_id,)) + timestamp.to_bytes(6, "little")
    return bytes(frame) + hashlib.sha256(key.secret + bytes(frame)).digest()[:6]


def receiver(timestamp: int = NOW) -> Signing:
    return Signing(KEY, timestamp)


def pymavlink_end(
    secret: bytes = SECRET, timestamp: int = NOW, *, link_id: int = 0
) -> mavlink.MAVLink:
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    mavfile: Any = SimpleNamespace(mav=mav)
    mavutil.mavfile.setup_signing(mavfile, secret, True, None, timestamp, link_id)  # type: ignore[no-untyped-call]
    return mav


# What is accepted


def test_a_frame_signed_with_the_key_is_accepted() -> None:
    assert receiver().verify(signed(NOW)) is Verdict.SIGNED


def test_a_frame_signed_with_another_key_is_refused() -> None:
    assert receiver().verify(signed(NOW, OTHER_KEY)) is Verdict.BAD_SIGNATURE


@settings(deadline=None)
@given(bit=st.integers(0, 8 * len(signed(NOW)) - 1))
def test_any_flipped_bit_of_a_signed_frame_is_refused(bit: int) -> None:
    frame = bytearray(signed(NOW))
    frame[bit // 8] ^= 1 << bit % 8
    assert not receiver().verify(bytes(frame)).is_accepted


def test_our_own_frames_are_what_the_guide_says() -> None:
    frame = Signing(KEY, NOW - 1).sign(unsigned(), 3, CRC_EXTRA_BY_ID[0])
    assert frame == signed(NOW)


def test_signing_sets_its_own_flag_and_leaves_the_others() -> None:
    frame = bytearray(unsigned())
    frame[3] = 0x08
    ours = Signing(KEY, NOW).sign(bytes(frame), 3, CRC_EXTRA_BY_ID[0])
    assert (ours[2], ours[3]) == (0x01, 0x08)


# Replay


@settings(deadline=None)
@given(steps=st.lists(st.integers(-50, 50), min_size=1, max_size=40))
def test_a_stream_is_believed_only_while_its_timestamps_rise(steps: list[int]) -> None:
    signing, timestamp, newest = receiver(), NOW, 0
    for step in steps:
        timestamp += step
        verdict = signing.verify(signed(timestamp))
        assert verdict is (Verdict.SIGNED if timestamp > newest else Verdict.REPLAYED)
        newest = max(newest, timestamp)
    assert signing.timestamp == max(NOW, newest)


def test_a_recorded_frame_is_refused_the_second_time() -> None:
    signing, frame = receiver(), signed(NOW)
    assert [signing.verify(frame) for _ in range(2)] == [Verdict.SIGNED, Verdict.REPLAYED]


@pytest.mark.parametrize(
    ("link_id", "system", "component"), [(4, 255, 190), (3, 254, 190), (3, 255, 191)]
)
def test_a_stream_is_system_component_and_link(link_id: int, system: int, component: int) -> None:
    signing = receiver()
    signing.verify(signed(NOW + 9))
    other = signed(NOW, link_id=link_id, system=system, component=component)
    assert signing.verify(other) is Verdict.SIGNED


@pytest.mark.parametrize(
    ("behind", "verdict"),
    [(0, Verdict.SIGNED), (MAX_BEHIND, Verdict.SIGNED), (MAX_BEHIND + 1, Verdict.TOO_OLD)],
)
def test_a_new_stream_may_be_a_minute_behind_and_no_more(behind: int, verdict: Verdict) -> None:
    assert receiver().verify(signed(NOW - behind)) is verdict


def test_a_stream_refused_as_too_old_leaves_no_trace() -> None:
    signing = receiver()
    signing.verify(signed(NOW - MAX_BEHIND - 1))
    assert signing.verify(signed(NOW - MAX_BEHIND)) is Verdict.SIGNED


def test_after_a_restart_the_stored_timestamp_keeps_old_frames_out() -> None:
    frame = signed(NOW)
    before = receiver()
    before.verify(frame)
    later = Signing(KEY, before.timestamp + MAX_BEHIND + 1)
    assert later.verify(frame) is Verdict.TOO_OLD


def test_no_frame_is_accepted_again_however_many_streams_there_are() -> None:
    signing = receiver()
    frames = [
        signed(NOW, system=1 + n % 255, component=1 + n // 255 % 255)
        for n in range(MAX_STREAMS + 3)
    ]
    first = [signing.verify(frame) for frame in frames]
    assert first == [Verdict.SIGNED] * MAX_STREAMS + [Verdict.TOO_MANY_STREAMS] * 3
    assert not any(signing.verify(frame).is_accepted for frame in frames)


def test_there_is_room_for_sixteen_streams() -> None:
    signing = receiver()
    verdicts = [signing.verify(signed(NOW, link_id=n)) for n in range(17)]
    assert verdicts == [Verdict.SIGNED] * 16 + [Verdict.TOO_MANY_STREAMS]


def test_every_verdict_is_counted() -> None:
    signing = receiver()
    for frame in (signed(NOW), signed(NOW), signed(NOW, OTHER_KEY), unsigned(), unsigned()):
        signing.verify(frame)
    counted = {verdict: count for verdict, count in signing.verdicts.items() if count}
    assert counted == {
        Verdict.SIGNED: 1,
        Verdict.REPLAYED: 1,
        Verdict.BAD_SIGNATURE: 1,
        Verdict.UNSIGNED: 2,
    }


# Stricter than the guide


def companion(timestamp: int = NOW, streams: dict[Stream, int] | None = None) -> Signing:
    return Signing(KEY, timestamp, streams, ONE_LINK_EACH)


def test_a_frame_recorded_on_another_link_of_its_sender_is_a_replay() -> None:
    recorded = signed(NOW - 100, link_id=1)
    by_the_guide, strict = receiver(), companion()
    for signing in (by_the_guide, strict):
        assert signing.verify(signed(NOW, link_id=0)) is Verdict.SIGNED
    assert by_the_guide.verify(recorded) is Verdict.SIGNED
    assert strict.verify(recorded) is Verdict.REPLAYED
    assert strict.verify(signed(NOW + 1, link_id=1)) is Verdict.SIGNED


@pytest.mark.parametrize(
    ("ahead", "verdict"),
    [(MAX_AHEAD, Verdict.SIGNED), (MAX_AHEAD + 1, Verdict.TOO_FAR_AHEAD)],
)
def test_a_peer_may_be_a_minute_ahead_and_no_more(ahead: int, verdict: Verdict) -> None:
    assert companion().verify(signed(NOW + ahead)) is verdict
    assert receiver().verify(signed(NOW + ahead)) is Verdict.SIGNED


def test_a_sender_far_ahead_moves_nothing_and_is_heard_again_once_it_is_right() -> None:
    signing = companion()
    signing.verify(signed(NOW))
    assert signing.verify(signed(MAX_TIMESTAMP)) is Verdict.TOO_FAR_AHEAD
    assert signing.timestamp == NOW
    assert signing.verify(signed(NOW + 1)) is Verdict.SIGNED


def test_peers_cannot_push_our_clock_ahead_minute_by_minute() -> None:
    signing = companion()
    assert signing.verify(signed(NOW + MAX_AHEAD)) is Verdict.SIGNED
    assert signing.verify(signed(NOW + 2 * MAX_AHEAD)) is Verdict.TOO_FAR_AHEAD


def test_ahead_is_ahead_of_the_clock_as_it_goes_on() -> None:
    signing = companion(timestamp=0)
    unix_s = EPOCH_UNIX_S + (NOW - 1000) / 1e5
    assert signing.verify(signed(NOW)) is Verdict.TOO_FAR_AHEAD
    signing.advance(unix_s)
    assert signing.verify(signed(NOW)) is Verdict.SIGNED
    signing.advance(0.0)
    assert signing.verify(signed(NOW + 1)) is Verdict.SIGNED


def test_streams_that_were_stored_keep_their_recorded_frames_out_after_a_restart() -> None:
    before = companion()
    recorded = [signed(NOW + n) for n in range(3)]
    for frame in recorded:
        assert before.verify(frame).is_accepted
    after = companion(before.timestamp, dict(before.streams))
    assert [after.verify(frame) for frame in recorded] == [Verdict.REPLAYED] * 3
    assert after.verify(signed(NOW + 3)) is Verdict.SIGNED


# Forged timestamps


def test_a_forged_future_timestamp_does_not_lock_out_the_real_sender() -> None:
    """pymavlink 2.4.50 stores the forged timestamp before it looks at the signature."""
    signing = receiver()
    assert signing.verify(signed(NOW)) is Verdict.SIGNED
    assert signing.verify(signed(NOW + 10**9, OTHER_KEY)) is Verdict.BAD_SIGNATURE
    assert signing.verify(signed(NOW + 1)) is Verdict.SIGNED
    assert signing.timestamp == NOW + 1


def test_pymavlink_still_has_the_fault_that_we_verify_for() -> None:
    mav = pymavlink_end()
    mav.decode(bytearray(signed(NOW)))
    with pytest.raises(mavlink.MAVError):
        mav.decode(bytearray(signed(NOW + 10**9, OTHER_KEY)))
    with pytest.raises(mavlink.MAVError):
        mav.decode(bytearray(signed(NOW + 1)))


@settings(deadline=None)
@given(
    frames=st.lists(
        st.tuples(st.integers(0, MAX_TIMESTAMP), st.booleans(), st.integers(0, 3)), max_size=30
    )
)
def test_only_rightly_signed_frames_move_any_clock(frames: list[tuple[int, bool, int]]) -> None:
    """A receiver that also hears forgeries thinks the same as one that never did."""
    attacked, spared = receiver(), receiver()
    for timestamp, is_real, link_id in frames:
        frame = signed(timestamp, KEY if is_real else OTHER_KEY, link_id=link_id)
        verdict = attacked.verify(frame)
        if is_real:
            assert verdict is spared.verify(frame)
        assert attacked.timestamp == spared.timestamp


def test_a_peer_cannot_use_up_the_timestamps_that_are_left() -> None:
    signing = receiver()
    assert MAX_HEARD == 2**48 - 1 - 2**40
    assert signing.verify(signed(MAX_TIMESTAMP)) is Verdict.TIMESTAMP_OVERFLOW
    assert signing.verify(signed(MAX_HEARD + 1)) is Verdict.TIMESTAMP_OVERFLOW
    assert signing.verify(signed(MAX_HEARD)) is Verdict.SIGNED
    assert is_signed(signing.sign(unsigned(), 0, CRC_EXTRA_BY_ID[0]))


# Downgrade


def test_an_unsigned_frame_is_refused_once_there_is_a_key() -> None:
    assert receiver().verify(unsigned()) is Verdict.UNSIGNED


def test_a_signature_stripped_on_the_way_is_a_refused_frame() -> None:
    stripped = without_signature(signed(NOW), CRC_EXTRA_BY_ID[0])
    assert receiver().verify(stripped) is Verdict.UNSIGNED


def test_mavlink_1_cannot_be_signed_and_is_refused() -> None:
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    frame = bytes(heartbeat().pack(mav, force_mavlink1=True))
    assert receiver().verify(frame) is Verdict.UNSIGNED
    assert receiver().verify(frame, is_trusted_link=True) is Verdict.UNSIGNED_ALLOWED


def test_the_status_of_a_radio_needs_no_signature() -> None:
    status = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert receiver().verify(MavCodec(51, 68).encode(status)) is Verdict.UNSIGNED_ALLOWED


def test_a_trusted_link_takes_unsigned_frames_but_never_badly_signed_ones() -> None:
    signing = receiver()
    assert signing.verify(unsigned(), is_trusted_link=True) is Verdict.UNSIGNED_ALLOWED
    forged = signed(NOW, OTHER_KEY)
    assert signing.verify(forged, is_trusted_link=True) is Verdict.BAD_SIGNATURE


# Sending


@settings(deadline=None)
@given(clock=st.lists(st.floats(1.7e9, 1.9e9), min_size=1, max_size=20))
def test_sent_timestamps_rise_strictly_whatever_the_clock_does(clock: list[float]) -> None:
    signing, last = Signing(KEY), -1
    for unix_s in clock:
        signing.advance(unix_s)
        frame = signing.sign(unsigned(), 0, CRC_EXTRA_BY_ID[0])
        timestamp = int.from_bytes(frame[-12:-6], "little")
        assert timestamp > max(last, timestamp_at(unix_s))
        last = timestamp


def test_sending_starts_from_the_stored_timestamp_when_the_clock_is_behind() -> None:
    signing = Signing(KEY, NOW)
    signing.advance(0.0)
    assert int.from_bytes(signing.sign(unsigned(), 0, 50)[-12:-6], "little") == NOW + 1


def test_time_begins_in_2015_and_ends_127_days_early() -> None:
    assert Signing(KEY).timestamp == 0
    assert Signing(KEY, -5).timestamp == 0
    assert Signing(KEY, MAX_TIMESTAMP).timestamp == MAX_HEARD


def test_timestamps_count_ten_microseconds_since_2015() -> None:
    assert timestamp_at(1_420_070_400.0) == 0
    assert timestamp_at(1_420_070_401.0) == 100_000
    assert timestamp_at(1_420_070_399.0) == 0
    assert timestamp_at(1e30) == MAX_HEARD
    assert timestamp_at(float("nan")) == 0


def test_only_an_unsigned_mavlink_2_frame_is_signed() -> None:
    with pytest.raises(LocalProtocolError):
        receiver().sign(signed(NOW), 0, CRC_EXTRA_BY_ID[0])


# The codec


def test_a_codec_with_a_key_signs_and_refuses_before_decoding() -> None:
    ours = MavCodec(1, 1, LinkSigning(Signing(KEY, NOW), 0))
    theirs = MavCodec(255, 190, LinkSigning(Signing(KEY, NOW), 1))
    (message,) = theirs.decode(ours.encode(heartbeat(77)))
    assert message.to_dict()["custom_mode"] == 77
    assert theirs.decode(unsigned()) == []
    assert (theirs.unproved, theirs.undecodable) == (1, 0)


def test_a_codec_without_a_key_reads_signed_frames_as_any_others() -> None:
    assert len(MavCodec(1, 1).decode(signed(NOW))) == 1


def test_a_codec_with_a_key_sends_no_mavlink_1() -> None:
    codec = MavCodec(1, 1, LinkSigning(Signing(KEY), 0))
    with pytest.raises(LocalProtocolError):
        codec.encode(heartbeat(), is_mavlink1=True)


# pymavlink at the other end


def test_pymavlink_verifies_what_we_sign() -> None:
    ours = MavCodec(1, 1, LinkSigning(Signing(KEY, NOW), 5))
    mav = pymavlink_end(link_id=1)
    for mark in range(20):
        message = mav.decode(bytearray(ours.encode(heartbeat(mark))))
        assert message.get_signed()
    assert mav.signing.goodsig_count == 20


def test_we_verify_what_pymavlink_signs() -> None:
    mav = pymavlink_end(link_id=2)
    ours = MavCodec(1, 1, LinkSigning(receiver(), 0))
    for mark in range(20):
        mav.seq = mark
        assert len(ours.decode(bytes(heartbeat(mark).pack(mav)))) == 1


def test_pymavlink_with_another_key_is_not_believed_either_way() -> None:
    mav = pymavlink_end(OTHER_KEY.secret)
    ours = MavCodec(1, 1, LinkSigning(receiver(), 0))
    assert ours.decode(bytes(heartbeat().pack(mav))) == []
    with pytest.raises(mavlink.MAVError):
        mav.decode(bytearray(ours.encode(heartbeat())))


# Keys and their setting up


def setup_message(system: int = 1, component: int = 1, secret: bytes = SECRET) -> Message:
    message = mavlink.MAVLink_setup_signing_message(system, component, list(secret), NOW)
    (decoded,) = MavCodec(1, 1).decode(MavCodec(255, 190).encode(message))
    return decoded


def test_a_key_is_taken_over_a_trusted_link() -> None:
    setup = setup_from(setup_message(), 1, 1, is_trusted_link=True)
    assert setup is not None
    assert (setup.key, setup.initial_timestamp) == (KEY, NOW)


def test_a_key_of_zeros_ends_signing() -> None:
    setup = setup_from(setup_message(secret=bytes(32)), 1, 1, is_trusted_link=True)
    assert setup is not None
    assert (setup.key, setup.initial_timestamp) == (None, 0)


@pytest.mark.parametrize(("system", "component"), [(0, 0), (1, 0), (0, 1), (2, 1), (1, 191)])
def test_a_key_that_was_broadcast_or_is_for_another_is_ignored(system: int, component: int) -> None:
    assert setup_from(setup_message(system, component), 1, 1, is_trusted_link=True) is None


def test_a_key_over_an_open_link_is_ignored() -> None:
    assert setup_from(setup_message(), 1, 1, is_trusted_link=False) is None


def test_only_setup_signing_is_secret() -> None:
    assert is_secret(MavCodec(255, 190).encode(setup_message()))
    assert not is_secret(unsigned())


def test_a_key_does_not_show_itself() -> None:
    assert SECRET.hex() not in repr(KEY) + str(KEY)
    assert repr(SECRET) not in repr(KEY)


@pytest.mark.parametrize("secret", [b"", bytes(31), bytes(33), bytes(32)])
def test_a_key_of_a_wrong_length_or_of_zeros_is_refused(secret: bytes) -> None:
    with pytest.raises(ConfigError):
        SigningKey(secret)
