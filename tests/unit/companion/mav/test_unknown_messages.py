"""Frames of unknown messages, which a splitter keeps for a router."""

from __future__ import annotations

from companion.mav.codec import CRC_EXTRA_BY_ID, MAGIC_V2, FrameSplitter
from tests.unit.companion.mav.framing_helpers import heartbeat, position, splitter, unknown


def keeping() -> FrameSplitter:
    return FrameSplitter(CRC_EXTRA_BY_ID, keeps_unknown=True)


def test_an_unknown_message_is_kept_whole_and_apart() -> None:
    link = keeping()
    data = heartbeat() + unknown() + position()
    assert link.split(data, is_datagram=True) == [heartbeat(), position()]
    assert link.take_unknown() == [unknown()]
    assert link.take_unknown() == []


def test_unknown_messages_behind_each_other_are_kept_each() -> None:
    link = keeping()
    link.split(unknown() + unknown(heartbeat()), is_datagram=True)
    assert link.take_unknown() == [unknown(), unknown(heartbeat())]


def test_a_stream_keeps_them_too() -> None:
    link = keeping()
    data = unknown() + heartbeat()
    for index in range(len(data)):
        link.split(data[index : index + 1], is_datagram=False)
    assert link.take_unknown() == [unknown()]


def test_a_magic_byte_inside_an_unknown_message_does_not_hold_the_stream_up() -> None:
    link = keeping()
    frame = unknown(position())
    tricky = frame[:14] + bytes((MAGIC_V2,)) + frame[15:]
    assert link.split(tricky, is_datagram=False) == []
    assert link.take_unknown() == [tricky]


def test_bytes_of_an_unknown_message_that_resemble_a_frame_are_no_bad_frame() -> None:
    link = keeping()
    inner = heartbeat()[:-1] + b"?"
    outer = unknown(position())
    outer = bytes((*outer[:1], len(inner), *outer[2:10])) + inner + outer[-2:]
    link.split(position() + outer + heartbeat(), is_datagram=True)
    assert link.take_unknown() == [outer]
    assert link.counters.bad_crc == 0
    link.split(inner, is_datagram=True)
    assert link.counters.bad_crc == 1
    assert link.split(heartbeat(), is_datagram=False) == [heartbeat()]


def test_what_a_good_frame_lies_in_is_no_unknown_message() -> None:
    lying = bytes((0xFD, 40, 0, 0, 0, 1, 1, 0x31, 0xD4, 0)) + position()
    data = lying + bytes(52 - len(lying))
    link = keeping()
    assert link.split(data, is_datagram=True) == [position()]
    assert link.take_unknown() == []


def test_what_ends_in_the_middle_of_something_is_no_unknown_message() -> None:
    link = keeping()
    link.split(unknown() + b"tail", is_datagram=True)
    assert link.take_unknown() == []


def with_payload(payload: bytes, number: int = 54321) -> bytes:
    """A frame of MAVLink 2 of any message, its CRC unknown."""
    header = bytes((MAGIC_V2, len(payload), 0, 0, 0, 1, 1))
    return header + number.to_bytes(3, "little") + payload + bytes(2)


def test_an_unknown_message_that_a_datagram_cuts_off_is_none() -> None:
    link = keeping()
    assert link.split(heartbeat() + unknown()[:-1], is_datagram=True) == [heartbeat()]
    assert link.take_unknown() == []


def test_a_known_message_with_a_wrong_crc_is_no_unknown_one() -> None:
    link = keeping()
    broken = heartbeat()[:-1] + bytes((heartbeat()[-1] ^ 1,))
    assert link.split(broken + position(), is_datagram=True) == [position()]
    assert link.take_unknown() == []


def test_an_unknown_message_behind_a_known_one_with_a_wrong_crc_is_kept() -> None:
    link = keeping()
    broken = heartbeat()[:-1] + bytes((heartbeat()[-1] ^ 1,))
    assert link.split(broken + unknown(), is_datagram=True) == []
    assert link.take_unknown() == [unknown()]


def test_a_long_length_inside_an_unknown_message_holds_nothing_up() -> None:
    link = keeping()
    tricky = with_payload(bytes((MAGIC_V2, 255)) + bytes(8))
    assert link.split(tricky, is_datagram=False) == []
    assert link.take_unknown() == [tricky]
    assert link.split(heartbeat(), is_datagram=False) == [heartbeat()]


def test_what_looks_like_one_inside_an_unknown_message_is_part_of_it() -> None:
    outer = with_payload(with_payload(bytes(4)) + bytes((MAGIC_V2, 0, 0)))
    link = keeping()
    link.split(outer, is_datagram=True)
    assert link.take_unknown() == [outer]


def test_what_ends_inside_a_good_frame_is_no_unknown_message() -> None:
    """Its length leads to a byte of the good frame that happens to begin frames, too."""
    good = position(MAGIC_V2)
    inside = good.index(MAGIC_V2, 1)
    lying = bytes((MAGIC_V2, inside + 1, 0, 0, 0, 1, 1, 0x31, 0xD4, 0, 7)) + good
    end = 10 + (inside + 1) + 2
    assert lying[end - 2] == MAGIC_V2
    lying = bytes((MAGIC_V2, inside - 1)) + lying[2:]
    link = keeping()
    assert link.split(lying, is_datagram=True) == [good]
    assert link.take_unknown() == []


def test_unknown_messages_are_not_kept_unless_wanted() -> None:
    link = splitter()
    link.split(unknown(), is_datagram=True)
    assert link.take_unknown() == []
