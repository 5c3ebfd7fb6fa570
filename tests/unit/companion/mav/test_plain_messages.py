"""Plain messages packed and unpacked by our own layout, against pymavlink for every message."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from companion.errors import LocalProtocolError
from companion.mav.codec import MavCodec, frame_crc, pack_plain, unpack_plain
from companion.mav.dialect import Message, mavlink

ALL = sorted(mavlink.mavlink_map)
CODE_OF = {"b": 7, "B": 8, "h": 15, "H": 16, "i": 31, "I": 32, "q": 63, "Q": 64}
"""Bits of each integer that carry its size."""


def invented(number: int, rng: np.random.Generator) -> Message | None:
    """A plain message with values from its fields' whole range; None if it is not plain."""
    kind = mavlink.mavlink_map[number]
    if any(kind.array_lengths):
        return None
    values: list[Any] = []
    for code in kind.unpacker.format.removeprefix("<"):
        if code in "fd":
            values.append(float(np.float32(rng.normal(0.0, 1e3))))
        elif code.isupper():
            values.append(int(rng.integers(0, 2 ** CODE_OF[code], dtype=np.uint64, endpoint=False)))
        else:
            bits = CODE_OF[code]
            values.append(int(rng.integers(-(2**bits), 2**bits - 1)))
    if rng.random() < 0.5:  # trailing zeros are not sent
        values[len(values) // 2 :] = [0] * len(values[len(values) // 2 :])
    named = dict(zip(kind.ordered_fieldnames, values, strict=True))
    return kind(*(named[name] for name in kind.fieldnames))


def by_pymavlink(message: Message, sequence: int) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=9)
    mav.seq = sequence
    return bytes(message.pack(mav))


@pytest.mark.parametrize("seed", range(3))
def test_every_plain_message_is_packed_and_read_as_pymavlink_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reader = mavlink.MAVLink(None)
    plain = 0
    for number in ALL:
        message = invented(number, rng)
        if message is None:
            continue
        sequence = int(rng.integers(256))
        frame = pack_plain(message, sequence, 7, 9)
        expected = by_pymavlink(message, sequence)
        if frame is None:
            continue
        plain += 1
        assert frame == expected, message
        ours, theirs = unpack_plain(frame), reader.decode(bytearray(frame))
        assert ours is not None
        assert vars(ours).keys() == vars(theirs).keys()
        assert ours == theirs
        assert vars(ours.get_header()) == vars(theirs.get_header())
        assert (ours.get_msgbuf(), ours.get_payload()) == (
            theirs.get_msgbuf(),
            theirs.get_payload(),
        )
    assert plain > 100


def test_messages_with_texts_and_arrays_are_left_to_pymavlink() -> None:
    text = mavlink.MAVLink_statustext_message(6, b"hello")
    assert pack_plain(text, 0, 1, 1) is None
    assert unpack_plain(by_pymavlink(text, 0)) is None
    codec = MavCodec(1, 1)
    (read,) = codec.decode(codec.encode(text))
    assert isinstance(read, mavlink.MAVLink_statustext_message)
    assert read.text == "hello"


def heartbeat() -> bytes:
    message = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    frame = pack_plain(message, 5, 1, 1)
    assert frame is not None
    return frame


def test_of_a_payload_of_zeros_one_byte_is_sent_and_none_is_needed() -> None:
    message = mavlink.MAVLink_local_position_ned_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    frame = pack_plain(message, 5, 7, 9)
    assert frame == by_pymavlink(message, 5)
    assert frame[1] == 1
    empty = bytes((frame[0], 0)) + frame[2:10]
    empty += struct.pack("<H", frame_crc(empty, message.crc_extra))
    read = unpack_plain(empty)
    assert read is not None
    assert read.to_dict() == message.to_dict()


def test_compatibility_flags_change_nothing() -> None:
    frame = heartbeat()
    flagged = frame[:3] + b"\xff" + frame[4:-2]
    crc_extra = mavlink.MAVLink_heartbeat_message.crc_extra
    message = unpack_plain(flagged + struct.pack("<H", frame_crc(flagged, crc_extra)))
    assert message is not None
    assert message.get_header().compat_flags == 0xFF


class Farther(mavlink.MAVLink_heartbeat_message):
    """A message whose id needs all three bytes."""

    id = 0x123456

    def __init__(self) -> None:
        super().__init__(2, 12, 0, 7, 4, 3)
        self.get_header().msgId = self.id


def test_a_message_id_has_three_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(mavlink.mavlink_map, Farther.id, Farther)
    frame = pack_plain(Farther(), 0, 1, 1)
    assert frame is not None
    assert frame[7:10] == bytes((0x56, 0x34, 0x12))
    read = unpack_plain(frame)
    assert read is not None
    assert (read.get_msgId(), read.to_dict()) == (Farther.id, Farther().to_dict())


def test_plain_messages_are_packed_and_read_without_pymavlink(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("by pymavlink's general path")

    monkeypatch.setattr(mavlink.MAVLink_message, "pack", refuse)
    monkeypatch.setattr(mavlink.MAVLink_heartbeat_message, "pack", refuse)
    monkeypatch.setattr(mavlink.MAVLink, "decode", refuse)
    codec = MavCodec(1, 1)
    sent = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    (read,) = codec.decode(codec.encode(sent))
    assert read.to_dict() == sent.to_dict()


def test_damaged_frames_are_not_read() -> None:
    frame = heartbeat()
    assert unpack_plain(frame) is not None
    for index in range(len(frame)):
        assert unpack_plain(frame[:index]) is None
        damaged = bytearray(frame)
        damaged[index] ^= 0x10
        assert unpack_plain(bytes(damaged)) is None


def test_signed_and_old_frames_are_left_to_pymavlink() -> None:
    frame = heartbeat()
    assert unpack_plain(bytes((frame[0], frame[1], 1)) + frame[3:]) is None
    assert unpack_plain(b"\xfe" + frame[1:]) is None


def test_a_frame_of_a_newer_dialect_may_be_longer() -> None:
    frame = heartbeat()
    longer = bytes((frame[0], frame[1] + 2)) + frame[2:-2] + b"\x01\x02"
    crc_extra = mavlink.MAVLink_heartbeat_message.crc_extra
    message = unpack_plain(longer + struct.pack("<H", frame_crc(longer, crc_extra)))
    assert isinstance(message, mavlink.MAVLink_heartbeat_message)
    assert message.autopilot == 12


def test_a_field_that_does_not_fit_is_our_mistake() -> None:
    message = mavlink.MAVLink_heartbeat_message(2, 999, 0, 0, 4, 3)
    with pytest.raises(LocalProtocolError, match="HEARTBEAT cannot be packed"):
        MavCodec(1, 1).encode(message)
