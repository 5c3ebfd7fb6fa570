from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec, sender_of
from companion.mav.dialect import Message, mavlink
from companion.mav.payloads import TargetedTimesync, boot_ms_of, targets_of_frame
from companion.mav.signing import LinkSigning, Signing, SigningKey


def blank(kind: type[Message]) -> Message:
    """A message of zeros."""
    payload = bytes(kind.unpacker.size)
    raw = kind.unpacker.unpack(payload)
    values = []
    for order in kind.orders:
        at = sum(kind.lengths[:order])
        length = kind.lengths[order]
        is_array = length > 1 and not isinstance(raw[at], bytes)
        values.append(list(raw[at : at + length]) if is_array else raw[at])
    return kind(*values)  # type: ignore[arg-type]


ADDRESSED = [
    kind
    for kind in mavlink.mavlink_map.values()
    if {"target_system", "target_component"} <= set(kind.fieldnames)
]


@pytest.mark.parametrize("target", [(0, 0), (7, 0), (0, 9), (7, 9), (255, 255)])
def test_the_bytes_tell_the_same_targets_as_the_fields(target: tuple[int, int]) -> None:
    for kind in ADDRESSED:
        message = blank(kind)
        message.target_system, message.target_component = target  # type: ignore[attr-defined]
        assert targets_of_frame(MavCodec(3, 4).encode(message)) == target, kind.msgname


def test_a_message_without_targets_is_for_everyone() -> None:
    frame = MavCodec(3, 4).encode(mavlink.MAVLink_heartbeat_message(2, 12, 9, 9, 9, 9))
    assert targets_of_frame(frame) == (0, 0)


def test_the_targets_of_timesync_are_extensions() -> None:
    assert targets_of_frame(MavCodec(3, 4).encode(TargetedTimesync(1, 2, 7, 9))) == (7, 9)


def test_an_unknown_message_is_for_everyone() -> None:
    frame = bytearray(MavCodec(3, 4).encode(mavlink.MAVLink_ping_message(1, 2, 7, 9)))
    frame[7:10] = (54321).to_bytes(3, "little")
    assert targets_of_frame(bytes(frame)) == (0, 0)


def test_source_and_target_are_found_in_either_version_signed_or_not() -> None:
    ping = mavlink.MAVLink_ping_message(1, 2, 7, 9)
    signing = LinkSigning(Signing(SigningKey(bytes(range(32)))), 0)
    frames = [
        MavCodec(3, 4).encode(ping),
        MavCodec(3, 4).encode(ping, is_mavlink1=True),
        MavCodec(3, 4, signing).encode(ping),
    ]
    assert [sender_of(frame) for frame in frames] == [(3, 4)] * 3
    assert [targets_of_frame(frame) for frame in frames] == [(7, 9)] * 3


@pytest.mark.parametrize("boot_ms", [0, 1, 255, 2**32 - 1])
def test_the_time_since_boot_is_read_from_system_time(boot_ms: int) -> None:
    frame = MavCodec(3, 4).encode(mavlink.MAVLink_system_time_message(1234567, boot_ms))
    assert boot_ms_of(frame) == boot_ms


def test_other_messages_tell_no_time_since_boot() -> None:
    frame = MavCodec(3, 4).encode(mavlink.MAVLink_ping_message(1, 2, 7, 9))
    assert boot_ms_of(frame) is None
