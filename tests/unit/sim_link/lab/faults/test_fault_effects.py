"""Effect of each content fault on frames of vehicle and radio, read back from the bytes."""

from __future__ import annotations

import math
from typing import Any

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, mavlink
from companion.mav.signing import LinkSigning, Signing, SigningKey
from sim_link.lab.faults.fault_models import (
    Fault,
    RangingDropout,
    RangingFreeze,
    RangingNan,
    RangingOutliers,
    RangingOutOfOrder,
    RangingSecondEmitter,
    RangingStale,
    RangingWrongUnit,
    Schedule,
    StreamMute,
    TelemetryNonsense,
)
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.observer import Lane

KEY = SigningKey(bytes(range(32)))


def answer(i: int) -> Message:
    """A radio's answer: 100 + i metres, 0.5 rad."""
    return MAVLink_radio_ranging_message(
        1_000_000 + i, 100.0 + i, 0.5, 0.5, 0.03, 0.0, 0.0, 7, 90, 0
    )


def position(i: int) -> Message:
    return mavlink.MAVLink_local_position_ned_message(i, 30.0, 40.0, -10.0, 0.0, 0.0, 0.0)


def arrivals(
    *faults: Fault,
    messages: list[Message] | None = None,
    lane: Lane = Lane.TO_COMPANION,
    key: SigningKey | None = None,
) -> list[tuple[float, Any]]:
    """Return what arrives, decoded, of messages that are sent every 0.1 s."""
    link = FaultyLink(Schedule(faults=faults), 1, key=key)
    codec, reader = MavCodec(1, 7), MavCodec(9, 9)
    if key is not None:
        codec.signing = LinkSigning(Signing(key, 1), 0)
        reader.signing = LinkSigning(Signing(key), 0)
    found = []
    for i, message in enumerate(messages or [answer(i) for i in range(200)]):
        for due_s, data in link.carry(codec.encode(message), lane, 0.1 * i):
            found += [(due_s, each) for each in reader.decode(data)]
    return found


def test_a_muted_stream_does_not_come_and_the_others_do() -> None:
    mixed = [answer(0), position(1), answer(2)]
    found = arrivals(StreamMute(message="LOCAL_POSITION_NED"), messages=mixed)
    assert [each.get_type() for _, each in found] == ["RADIO_RANGING"] * 2


@pytest.mark.parametrize("lane", [Lane.TO_COMPANION, Lane.RANGING])
def test_a_dropout_takes_the_answer_or_a_part_of_it(lane: Lane) -> None:
    assert arrivals(RangingDropout(), lane=lane) == []
    for missing, kept in (("range", "bearing"), ("bearing", "range")):
        found = arrivals(RangingDropout(missing=missing), lane=lane)  # type: ignore[arg-type]
        assert all(math.isnan(getattr(each, missing)) for _, each in found)
        assert all(math.isfinite(getattr(each, kept)) for _, each in found)


def test_a_frozen_radio_repeats_itself_with_fresh_stamps() -> None:
    found = arrivals(RangingFreeze(start_s=1.0, duration_s=2.0))
    ranges = [each.range for _, each in found]
    assert ranges[:10] == [100.0 + i for i in range(10)]
    assert set(ranges[10:30]) == {110.0}
    assert ranges[30] == 130.0
    assert len({each.time_usec for _, each in found}) == 200


def test_a_wrong_unit_is_a_factor() -> None:
    found = arrivals(RangingWrongUnit(of="range", factor=100.0))
    assert [each.range for _, each in found] == [100.0 * (100.0 + i) for i in range(200)]
    found = arrivals(RangingWrongUnit(of="bearing", factor=180.0 / math.pi))
    assert found[0][1].bearing == pytest.approx(math.degrees(0.5))


def test_outliers_are_too_long_and_come_from_anywhere() -> None:
    found = arrivals(RangingOutliers(share=0.4, excess_m=40.0))
    excess = [each.range - 100.0 - i for i, (_, each) in enumerate(found)]
    hit = [each for each in excess if each > 0.01]
    assert len(hit) / len(excess) == pytest.approx(0.4, abs=0.1)
    assert sum(hit) / len(hit) == pytest.approx(40.0, rel=0.3)
    assert len({round(each.bearing, 3) for _, each in found}) > 50


def test_bursts_of_ranges_that_are_too_short() -> None:
    burst = RangingOutliers(share=0.05, excess_m=-25.0, is_bearing_hit=False, burst=8)
    found = arrivals(burst)
    short = [each.range < 99.99 + i for i, (_, each) in enumerate(found)]
    runs = [len(run) for run in "".join("x" if each else " " for each in short).split()]
    assert len(runs) >= 2
    assert all(run % 8 == 0 for run in runs[:-1])
    assert min(each.range for _, each in found) >= 0.1
    assert len({each.bearing for _, each in found}) == 1


def test_stale_answers_come_late_and_keep_their_stamps() -> None:
    found = arrivals(RangingStale(age_s=0.7))
    assert [due for due, _ in found] == pytest.approx([0.7 + 0.1 * i for i in range(200)])
    assert [each.time_usec for _, each in found] == [1_000_000 + i for i in range(200)]


def test_answers_out_of_order_overtake_each_other() -> None:
    dues = [due for due, _ in arrivals(RangingOutOfOrder(window_s=0.8))]
    assert dues != sorted(dues)
    assert all(0.0 <= due - 0.1 * i <= 0.8 for i, due in enumerate(dues))


def test_a_second_emitter_answers_from_its_own_place() -> None:
    messages = [position(0), *[answer(i) for i in range(20)]]
    fault = RangingSecondEmitter(east_m=0.0, north_m=60.0, emitter_id=9)
    found = [each for _, each in arrivals(fault, messages=messages)][1:]
    assert [each.emitter_id for each in found] == [7, 9] * 20
    other = found[1]
    assert other.range == pytest.approx(math.hypot(40.0, 30.0, 10.0), abs=2.0)
    assert other.bearing == pytest.approx(math.atan2(-40.0, 30.0), abs=0.15)


def test_a_second_emitter_may_pose_as_ours() -> None:
    messages = [position(0), *[answer(i) for i in range(3)]]
    found = arrivals(RangingSecondEmitter(), messages=messages)
    assert {each.emitter_id for _, each in found[1:]} == {7}


def test_answers_that_are_no_numbers() -> None:
    found = arrivals(RangingNan(share=0.5))
    ranges = [each.range for _, each in found]
    assert any(math.isnan(r) for r in ranges)
    assert any(math.isinf(r) for r in ranges)
    assert any(r <= 0.0 for r in ranges)
    assert sum(100.0 <= r < 300.0 for r in ranges) == pytest.approx(100, abs=25)


def test_nonsense_hits_one_field_of_some_reports_and_never_the_clock() -> None:
    messages = [position(i) for i in range(200)]
    found = [each for _, each in arrivals(TelemetryNonsense(share=0.5), messages=messages)]
    assert [each.time_boot_ms for each in found] == list(range(200))
    good = (30.0, 40.0, -10.0, 0.0, 0.0, 0.0)
    wrong = [
        sum(
            value != right
            for value, right in zip((m.x, m.y, m.z, m.vx, m.vy, m.vz), good, strict=True)
        )
        for m in found
    ]
    assert set(wrong) == {0, 1}
    assert sum(wrong) == pytest.approx(100, abs=25)


def test_the_radio_of_a_signed_link_measures_wrongly_and_signs_it() -> None:
    found = arrivals(RangingWrongUnit(factor=2.0), key=KEY)
    assert [each.range for _, each in found] == [2.0 * (100.0 + i) for i in range(200)]


def test_without_the_key_a_signed_frame_stays_as_it_is() -> None:
    link = FaultyLink(Schedule(faults=(RangingWrongUnit(),)), 1)
    codec = MavCodec(1, 7, LinkSigning(Signing(KEY, 1), 0))
    frame = codec.encode(answer(0))
    assert link.carry(frame, Lane.TO_COMPANION, 0.0) == [(0.0, frame)]
