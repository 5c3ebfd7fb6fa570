"""Signing against recorded frames: streams, clocks, and where we are stricter than the guide."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mav.codec import CRC_EXTRA_BY_ID
from companion.mav.signing import (
    EPOCH_UNIX_S,
    MAX_BEHIND,
    MAX_STREAMS,
    MAX_TIMESTAMP,
    SignatureVerdict,
    Signing,
)
from tests.unit.companion.mav.signing_helpers import (
    KEY,
    MAX_AHEAD,
    NOW,
    OTHER_KEY,
    companion,
    receiver,
    signed,
    unsigned,
)

# Replay


@settings(deadline=None)
@given(steps=st.lists(st.integers(-50, 50), min_size=1, max_size=40))
def test_a_stream_is_believed_only_while_its_timestamps_rise(steps: list[int]) -> None:
    signing, timestamp, newest = receiver(), NOW, 0
    for step in steps:
        timestamp += step
        verdict = signing.verify(signed(timestamp))
        assert verdict is (
            SignatureVerdict.SIGNED if timestamp > newest else SignatureVerdict.REPLAYED
        )
        newest = max(newest, timestamp)
    assert signing.timestamp == max(NOW, newest)


def test_a_recorded_frame_is_refused_the_second_time() -> None:
    signing, frame = receiver(), signed(NOW)
    assert [signing.verify(frame) for _ in range(2)] == [
        SignatureVerdict.SIGNED,
        SignatureVerdict.REPLAYED,
    ]


@pytest.mark.parametrize(
    ("link_id", "system", "component"), [(4, 255, 190), (3, 254, 190), (3, 255, 191)]
)
def test_a_stream_is_system_component_and_link(link_id: int, system: int, component: int) -> None:
    signing = receiver()
    signing.verify(signed(NOW + 9))
    other = signed(NOW, link_id=link_id, system=system, component=component)
    assert signing.verify(other) is SignatureVerdict.SIGNED


@pytest.mark.parametrize(
    ("behind", "verdict"),
    [
        (0, SignatureVerdict.SIGNED),
        (MAX_BEHIND, SignatureVerdict.SIGNED),
        (MAX_BEHIND + 1, SignatureVerdict.TOO_OLD),
    ],
)
def test_a_new_stream_may_be_a_minute_behind_and_no_more(
    behind: int, verdict: SignatureVerdict
) -> None:
    assert receiver().verify(signed(NOW - behind)) is verdict


def test_a_stream_refused_as_too_old_leaves_no_trace() -> None:
    signing = receiver()
    signing.verify(signed(NOW - MAX_BEHIND - 1))
    assert signing.verify(signed(NOW - MAX_BEHIND)) is SignatureVerdict.SIGNED


def test_after_a_restart_the_stored_timestamp_keeps_old_frames_out() -> None:
    frame = signed(NOW)
    before = receiver()
    before.verify(frame)
    later = Signing(KEY, before.timestamp + MAX_BEHIND + 1)
    assert later.verify(frame) is SignatureVerdict.TOO_OLD


def test_no_frame_is_accepted_again_however_many_streams_there_are() -> None:
    signing = receiver()
    frames = [
        signed(NOW, system=1 + n % 255, component=1 + n // 255 % 255)
        for n in range(MAX_STREAMS + 3)
    ]
    first = [signing.verify(frame) for frame in frames]
    assert (
        first == [SignatureVerdict.SIGNED] * MAX_STREAMS + [SignatureVerdict.TOO_MANY_STREAMS] * 3
    )
    assert not any(signing.verify(frame).is_accepted for frame in frames)


def test_there_is_room_for_sixteen_streams() -> None:
    signing = receiver()
    verdicts = [signing.verify(signed(NOW, link_id=n)) for n in range(17)]
    assert verdicts == [SignatureVerdict.SIGNED] * 16 + [SignatureVerdict.TOO_MANY_STREAMS]


def test_every_verdict_is_counted() -> None:
    signing = receiver()
    for frame in (signed(NOW), signed(NOW), signed(NOW, OTHER_KEY), unsigned(), unsigned()):
        signing.verify(frame)
    counted = {verdict: count for verdict, count in signing.verdicts.items() if count}
    assert counted == {
        SignatureVerdict.SIGNED: 1,
        SignatureVerdict.REPLAYED: 1,
        SignatureVerdict.BAD_SIGNATURE: 1,
        SignatureVerdict.UNSIGNED: 2,
    }


# Stricter than the guide


def test_a_frame_recorded_on_another_link_of_its_sender_is_a_replay() -> None:
    recorded = signed(NOW - 100, link_id=1)
    by_the_guide, strict = receiver(), companion()
    for signing in (by_the_guide, strict):
        assert signing.verify(signed(NOW, link_id=0)) is SignatureVerdict.SIGNED
    assert by_the_guide.verify(recorded) is SignatureVerdict.SIGNED
    assert strict.verify(recorded) is SignatureVerdict.REPLAYED
    assert strict.verify(signed(NOW + 1, link_id=1)) is SignatureVerdict.SIGNED


@pytest.mark.parametrize(
    ("ahead", "verdict"),
    [(MAX_AHEAD, SignatureVerdict.SIGNED), (MAX_AHEAD + 1, SignatureVerdict.TOO_FAR_AHEAD)],
)
def test_a_peer_may_be_a_minute_ahead_and_no_more(ahead: int, verdict: SignatureVerdict) -> None:
    assert companion().verify(signed(NOW + ahead)) is verdict
    assert receiver().verify(signed(NOW + ahead)) is SignatureVerdict.SIGNED


def test_a_sender_far_ahead_moves_nothing_and_is_heard_again_once_it_is_right() -> None:
    signing = companion()
    signing.verify(signed(NOW))
    assert signing.verify(signed(MAX_TIMESTAMP)) is SignatureVerdict.TOO_FAR_AHEAD
    assert signing.timestamp == NOW
    assert signing.verify(signed(NOW + 1)) is SignatureVerdict.SIGNED


def test_peers_cannot_push_our_clock_ahead_minute_by_minute() -> None:
    signing = companion()
    assert signing.verify(signed(NOW + MAX_AHEAD)) is SignatureVerdict.SIGNED
    assert signing.verify(signed(NOW + 2 * MAX_AHEAD)) is SignatureVerdict.TOO_FAR_AHEAD


@pytest.mark.parametrize("ahead", [0, MAX_AHEAD // 2, MAX_AHEAD])
@pytest.mark.parametrize("behind", [0, 200_000, MAX_BEHIND])
def test_a_station_ahead_does_not_lock_out_an_autopilot_behind(ahead: int, behind: int) -> None:
    signing = companion()
    assert signing.verify(signed(NOW + ahead)) is SignatureVerdict.SIGNED
    assert signing.verify(signed(NOW - behind, system=1, component=1)) is SignatureVerdict.SIGNED


def test_a_companion_refuses_a_new_stream_more_than_a_minute_behind_its_own_clock() -> None:
    signing = companion()
    signing.verify(signed(NOW + MAX_AHEAD))
    late = signed(NOW - MAX_BEHIND - 1, system=1, component=1)
    assert signing.verify(late) is SignatureVerdict.TOO_OLD


def test_a_station_ever_farther_ahead_does_not_move_our_clock_over_restarts() -> None:
    signing = companion()
    verdicts = []
    for restart in range(5):
        verdicts.append(signing.verify(signed(NOW + (restart + 1) * MAX_AHEAD)))
        signing = companion(signing.timestamp, dict(signing.streams), clock=signing.clock)
    assert verdicts == [SignatureVerdict.SIGNED] + [SignatureVerdict.TOO_FAR_AHEAD] * 4
    assert signing.verify(signed(NOW, system=1, component=1)) is SignatureVerdict.SIGNED


def test_after_a_restart_we_sign_later_than_whatever_we_signed_before() -> None:
    before = companion()
    before.verify(signed(NOW + MAX_AHEAD))
    after = companion(before.timestamp, dict(before.streams), clock=before.clock)
    frame = after.sign(unsigned(), 0, CRC_EXTRA_BY_ID[0])
    assert int.from_bytes(frame[-12:-6], "little") == NOW + MAX_AHEAD + 1


def test_without_a_real_time_clock_the_stored_one_keeps_old_recordings_out() -> None:
    before = companion()
    after = companion(before.timestamp, clock=before.clock)
    after.advance(0.0)
    assert after.verify(signed(NOW - MAX_BEHIND - 1)) is SignatureVerdict.TOO_OLD
    assert after.verify(signed(NOW)) is SignatureVerdict.SIGNED


def test_ahead_is_ahead_of_the_clock_as_it_goes_on() -> None:
    signing = companion(timestamp=0)
    unix_s = EPOCH_UNIX_S + (NOW - 1000) / 1e5
    assert signing.verify(signed(NOW)) is SignatureVerdict.TOO_FAR_AHEAD
    signing.advance(unix_s)
    assert signing.verify(signed(NOW)) is SignatureVerdict.SIGNED
    signing.advance(0.0)
    assert signing.verify(signed(NOW + 1)) is SignatureVerdict.SIGNED


def test_streams_that_were_stored_keep_their_recorded_frames_out_after_a_restart() -> None:
    before = companion()
    recorded = [signed(NOW + n) for n in range(3)]
    for frame in recorded:
        assert before.verify(frame).is_accepted
    after = companion(before.timestamp, dict(before.streams))
    assert [after.verify(frame) for frame in recorded] == [SignatureVerdict.REPLAYED] * 3
    assert after.verify(signed(NOW + 3)) is SignatureVerdict.SIGNED
