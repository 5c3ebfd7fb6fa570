"""Signing against the MAVLink developer guide, an attacker, and pymavlink at the other end."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.errors import LocalProtocolError
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec, without_signature
from companion.mav.dialect import mavlink
from companion.mav.signing import (
    MAX_HEARD,
    MAX_TIMESTAMP,
    LinkSigning,
    SignatureVerdict,
    Signing,
    is_signed,
    timestamp_at,
)
from tests.unit.companion.mav.signing_helpers import (
    KEY,
    NOW,
    OTHER_KEY,
    heartbeat,
    pymavlink_end,
    receiver,
    signed,
    unsigned,
)

# What is accepted


def test_a_frame_signed_with_the_key_is_accepted() -> None:
    assert receiver().verify(signed(NOW)) is SignatureVerdict.SIGNED


def test_a_frame_signed_with_another_key_is_refused() -> None:
    assert receiver().verify(signed(NOW, OTHER_KEY)) is SignatureVerdict.BAD_SIGNATURE


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


# Forged timestamps


def test_a_forged_future_timestamp_does_not_lock_out_the_real_sender() -> None:
    """pymavlink 2.4.50 stores the forged timestamp before it looks at the signature."""
    signing = receiver()
    assert signing.verify(signed(NOW)) is SignatureVerdict.SIGNED
    assert signing.verify(signed(NOW + 10**9, OTHER_KEY)) is SignatureVerdict.BAD_SIGNATURE
    assert signing.verify(signed(NOW + 1)) is SignatureVerdict.SIGNED
    assert signing.timestamp == NOW + 1


def test_pymavlink_still_has_the_fault_that_we_verify_for() -> None:
    mav = pymavlink_end()
    mav.decode(bytearray(signed(NOW)))
    with pytest.raises(mavlink.MAVError):
        mav.decode(bytearray(signed(NOW + 10**9, OTHER_KEY)))
    with pytest.raises(mavlink.MAVError):
        mav.decode(bytearray(signed(NOW + 1)))


@pytest.mark.slow
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
    assert signing.verify(signed(MAX_TIMESTAMP)) is SignatureVerdict.TIMESTAMP_OVERFLOW
    assert signing.verify(signed(MAX_HEARD + 1)) is SignatureVerdict.TIMESTAMP_OVERFLOW
    assert signing.verify(signed(MAX_HEARD)) is SignatureVerdict.SIGNED
    assert is_signed(signing.sign(unsigned(), 0, CRC_EXTRA_BY_ID[0]))


# Downgrade


def test_an_unsigned_frame_is_refused_once_there_is_a_key() -> None:
    assert receiver().verify(unsigned()) is SignatureVerdict.UNSIGNED


def test_a_signature_stripped_on_the_way_is_a_refused_frame() -> None:
    stripped = without_signature(signed(NOW), CRC_EXTRA_BY_ID[0])
    assert receiver().verify(stripped) is SignatureVerdict.UNSIGNED


def test_mavlink_1_cannot_be_signed_and_is_refused() -> None:
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    frame = bytes(heartbeat().pack(mav, force_mavlink1=True))
    assert receiver().verify(frame) is SignatureVerdict.UNSIGNED
    assert receiver().verify(frame, is_trusted_link=True) is SignatureVerdict.UNSIGNED_ALLOWED


def test_the_status_of_a_radio_needs_no_signature() -> None:
    status = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert receiver().verify(MavCodec(51, 68).encode(status)) is SignatureVerdict.UNSIGNED_ALLOWED


def test_a_trusted_link_takes_unsigned_frames_but_never_badly_signed_ones() -> None:
    signing = receiver()
    assert signing.verify(unsigned(), is_trusted_link=True) is SignatureVerdict.UNSIGNED_ALLOWED
    forged = signed(NOW, OTHER_KEY)
    assert signing.verify(forged, is_trusted_link=True) is SignatureVerdict.BAD_SIGNATURE


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
