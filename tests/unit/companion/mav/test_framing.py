from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mav.codec import (
    CRC_EXTRA_BY_ID,
    MAGIC_V2,
    FrameSplitter,
    MavCodec,
    frame_crc,
    frame_end,
    header_of,
    message_id,
    sender_of,
    without_signature,
)
from companion.mav.dialect import Message, mavlink
from tests.unit.companion.mav.framing_helpers import (
    GOOD,
    heartbeat,
    heartbeat_v1,
    in_datagram,
    position,
    ranging,
    splitter,
    unknown,
    with_header,
)

LONGEST_FRAME = 280


@pytest.mark.parametrize("frame", GOOD)
def test_a_whole_frame_is_found(frame: bytes) -> None:
    assert in_datagram(frame) == [frame]


class WithoutSearch(FrameSplitter):
    """A splitter that has only its quick way."""

    def _split(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        raise AssertionError(f"searched {data.hex()}, a datagram: {is_datagram}")


def invented(payload: bytes, number: int, crc_extra: int) -> bytes:
    """A frame of MAVLink 2 of a message that no dialect has."""
    head = bytes((MAGIC_V2, len(payload), 0, 0, 0, 1, 1)) + number.to_bytes(3, "little") + payload
    return head + frame_crc(head, crc_extra).to_bytes(2, "little")


@pytest.mark.parametrize("payload", [b"", b"\x01", bytes(range(1, 256))])
def test_a_datagram_of_one_good_frame_is_found_without_a_search(payload: bytes) -> None:
    number, crc_extra = 0x123456, 77
    frame, link = invented(payload, number, crc_extra), WithoutSearch({number: crc_extra})
    signed_frame = bytearray(frame)
    signed_frame[2] = 0x01
    signed_frame[-2:] = frame_crc(bytes(signed_frame), crc_extra).to_bytes(2, "little")
    compatible = bytearray(frame)
    compatible[3] = 0xFF
    compatible[-2:] = frame_crc(bytes(compatible), crc_extra).to_bytes(2, "little")
    whole = [frame, bytes(signed_frame) + bytes(13), bytes(compatible)]
    for count, each in enumerate(whole, 1):
        assert link.split(each, is_datagram=True) == [each]
        assert link.counters.good == count


def test_a_datagram_leaves_nothing_of_what_was_unfinished_before_it() -> None:
    frames, data = splitter(), heartbeat()
    assert frames.split(data[:-4], is_datagram=False) == []
    assert frames.split(data, is_datagram=True) == [data]
    assert (frames.counters.good, frames.counters.junk_bytes) == (1, len(data) - 4)


def test_one_datagram_may_hold_many_frames_of_both_versions() -> None:
    assert in_datagram(b"".join(GOOD)) == list(GOOD)


@pytest.mark.parametrize("cut", range(1, len(heartbeat())))
def test_a_truncated_frame_does_not_swallow_the_good_one_behind_it(cut: int) -> None:
    good = position()
    assert in_datagram(heartbeat()[:cut] + good) == [good]


@pytest.mark.parametrize("cut", range(1, len(position())))
def test_the_end_of_a_datagram_ends_its_candidates(cut: int) -> None:
    link = splitter()
    assert link.split(position()[:cut], is_datagram=True) == []
    assert link.split(heartbeat(), is_datagram=True) == [heartbeat()]


@pytest.mark.parametrize("junk", [b"\xfd", b"\xfe", b"\xfd\xff", b"\x00" * 50, b"\xfd" * 300, b"A"])
def test_junk_between_frames_is_stepped_over_and_counted(junk: bytes) -> None:
    link = splitter()
    data = heartbeat() + junk + position()
    assert link.split(data, is_datagram=True) == [heartbeat(), position()]
    assert link.counters.junk_bytes == len(junk)
    assert link.counters.good == 2


def test_a_frame_inside_the_payload_that_a_lying_length_claims_is_found() -> None:
    lying = bytes((0xFD, 255, 0, 0, 0, 1, 1, 0, 0, 0))
    data = lying + position() + bytes(300)
    assert in_datagram(data) == [position()]


@pytest.mark.parametrize("frame", GOOD)
def test_any_flipped_bit_is_refused(frame: bytes) -> None:
    for bit in range(8 * len(frame)):
        flipped = bytearray(frame)
        flipped[bit // 8] ^= 1 << bit % 8
        assert in_datagram(bytes(flipped)) == []


def test_every_bad_crc_is_counted() -> None:
    link = splitter()
    for count in (1, 2):
        assert link.split(heartbeat()[:-1] + b"\x00", is_datagram=True) == []
        assert link.counters.bad_crc == count


def test_an_unknown_message_is_counted_and_the_next_one_understood() -> None:
    unknown = bytearray(heartbeat())
    unknown[7:10] = (54321).to_bytes(3, "little")
    link = splitter()
    for count in (1, 2):
        assert link.split(bytes(unknown) + position(), is_datagram=True) == [position()]
        assert link.counters.unknown == count


@pytest.mark.parametrize("flag", [0x02, 0x80, 0x7E])
def test_an_unknown_incompatibility_flag_drops_the_whole_frame(flag: int) -> None:
    link = splitter()
    data = with_header(heartbeat(), 2, flag) + position()
    for count in (1, 2):
        assert link.split(data, is_datagram=True) == [position()]
        assert link.counters.incompatible == count
    assert link.counters.junk_bytes == 0


@pytest.mark.parametrize("flag", [0x01, 0x02, 0x80])
@pytest.mark.parametrize("frame", [heartbeat(), position(), ranging()])
def test_a_datagram_that_ends_anywhere_in_a_flagged_frame_is_junk(frame: bytes, flag: int) -> None:
    flagged = with_header(frame, 2, flag)
    for end in range(1, len(flagged)):
        link = splitter()
        assert link.split(flagged[:end], is_datagram=True) == []
        assert link.counters.junk_bytes == end


def test_an_unknown_compatibility_flag_is_no_reason_to_drop() -> None:
    frame = with_header(heartbeat(), 3, 0xFF)
    assert in_datagram(frame) == [frame]


@pytest.mark.parametrize("sequence", [1, 2, 255])
def test_a_sequence_number_of_mavlink_1_is_no_flag(sequence: int) -> None:
    frame = with_header(heartbeat_v1(), 2, sequence)
    assert in_datagram(frame + heartbeat()) == [frame, heartbeat()]


def test_a_payload_with_uncut_zeros_is_accepted() -> None:
    short = MavCodec(1, 1).encode(
        mavlink.MAVLink_local_position_ned_message(5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    )
    uncut = bytes((short[0], 28)) + short[2:-2] + bytes(28 - short[1])
    uncut += frame_crc(uncut, CRC_EXTRA_BY_ID[32]).to_bytes(2, "little")
    assert in_datagram(uncut) == [uncut]
    (message,) = MavCodec(1, 1).decode(uncut)
    assert message.to_dict()["time_boot_ms"] == 5


def test_a_stream_may_be_cut_at_every_byte() -> None:
    stream = b"".join(GOOD)
    for cut in range(len(stream) + 1):
        link = splitter()
        found = link.split(stream[:cut], is_datagram=False)
        found += link.split(stream[cut:], is_datagram=False)
        assert found == list(GOOD)


def test_a_stream_may_come_byte_by_byte() -> None:
    link = splitter()
    found = [f for byte in b"".join(GOOD) for f in link.split(bytes((byte,)), is_datagram=False)]
    assert found == list(GOOD)


def test_a_stream_that_always_ends_inside_a_frame_keeps_one_frame_at_most() -> None:
    link = splitter()
    beginning = bytes((0xFD, 255, 1, 0))
    for _ in range(5000):
        link.split(beginning, is_datagram=False)
        assert len(link._pending) <= LONGEST_FRAME


@given(st.lists(st.binary(max_size=600), max_size=8))
def test_no_bytes_raise_and_a_good_datagram_is_always_understood(junk: list[bytes]) -> None:
    codec = MavCodec(1, 191)
    for data in junk:
        codec.decode(data)
    (message,) = codec.decode(heartbeat(77))
    assert message.to_dict()["custom_mode"] == 77


@given(st.binary(max_size=600))
def test_a_good_frame_behind_any_junk_of_the_same_datagram_is_understood(junk: bytes) -> None:
    marks = [m.to_dict().get("custom_mode") for m in MavCodec(1, 191).decode(junk + heartbeat(77))]
    assert marks[-1:] == [77]


_NEARLY = st.lists(
    st.one_of(
        st.binary(max_size=20),
        st.sampled_from(GOOD),
        st.sampled_from(GOOD).flatmap(lambda frame: st.integers(0, 40).map(lambda n: frame[:n])),
        st.sampled_from([b"\xfd", b"\xfe", bytes((0xFD, 255, 1)), bytes((0xFE, 255))]),
    ),
    max_size=30,
)


@given(_NEARLY)
def test_a_stream_of_anything_stays_bounded_and_recovers_within_one_frame(
    pieces: list[bytes],
) -> None:
    link = splitter()
    for piece in pieces:
        link.split(piece, is_datagram=False)
        assert len(link._pending) <= LONGEST_FRAME
    repeats = LONGEST_FRAME // len(heartbeat()) + 2
    found = link.split(heartbeat(77) * repeats, is_datagram=False)
    assert found[-1:] == [heartbeat(77)]


@given(_NEARLY)
def test_how_a_stream_is_cut_does_not_matter(pieces: list[bytes]) -> None:
    whole, cut = splitter(), splitter()
    at_once = whole.split(b"".join(pieces), is_datagram=False)
    piecewise = [frame for piece in pieces for frame in cut.split(piece, is_datagram=False)]
    assert at_once == piecewise
    assert whole.counters.good == cut.counters.good


@given(st.binary(min_size=1, max_size=255), st.sampled_from(sorted(CRC_EXTRA_BY_ID)))
def test_a_payload_of_any_length_and_content_never_raises(payload: bytes, number: int) -> None:
    header = bytes((0xFD, len(payload), 0, 0, 0, 1, 1)) + number.to_bytes(3, "little")
    crc = frame_crc(header + payload, CRC_EXTRA_BY_ID[number])
    codec = MavCodec(1, 191)
    messages: list[Message] = codec.decode(header + payload + crc.to_bytes(2, "little"))
    assert len(messages) + codec.undecodable == 1


def signed(message: Message) -> bytes:
    signer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signer.signing.secret_key = bytes(range(32))
    signer.signing.sign_outgoing = True
    signer.signing.timestamp = 1
    return bytes(message.pack(signer))


def test_a_signed_frame_is_found_whole() -> None:
    frame = signed(mavlink.MAVLink_heartbeat_message(2, 12, 0, 1, 4, 3))
    assert in_datagram(frame + position()) == [frame, position()]


def test_leaving_a_signature_out_gives_the_unsigned_frame() -> None:
    frame = signed(mavlink.MAVLink_heartbeat_message(2, 12, 0, 1, 4, 3))
    assert without_signature(frame, CRC_EXTRA_BY_ID[0]) == heartbeat(1)


@pytest.mark.parametrize("frame", GOOD)
def test_an_unsigned_frame_is_left_alone(frame: bytes) -> None:
    assert without_signature(frame, CRC_EXTRA_BY_ID[message_id(frame)]) == frame
    assert without_signature(frame, None) == frame


def test_a_sequence_number_of_mavlink_1_is_not_taken_for_the_flag_of_a_signature() -> None:
    """Both are the third byte."""
    frame = with_header(heartbeat_v1(), 2, 1)
    assert without_signature(frame, CRC_EXTRA_BY_ID[0]) == frame


def test_leaving_a_signature_out_leaves_the_other_flags() -> None:
    frame = with_header(heartbeat(), 3, 0x08)
    tagged = bytearray(frame)
    tagged[2] = 0x01
    unsigned = without_signature(bytes(tagged) + bytes(13), CRC_EXTRA_BY_ID[0])
    assert unsigned == frame


def test_of_an_unknown_message_the_signature_is_blanked() -> None:
    frame = signed(mavlink.MAVLink_heartbeat_message(2, 12, 0, 1, 4, 3))
    blanked = without_signature(frame, None)
    assert blanked == frame[:-13] + bytes(13)
    assert frame_end(blanked, 0) == len(blanked)


def test_only_counters_that_there_are_can_be_counted() -> None:
    with pytest.raises(AttributeError):
        splitter().counters.god += 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("number", [0, 1, 255, 256, 65_535, 65_536, 0x123456, 2**24 - 1])
def test_a_message_id_of_mavlink_2_has_three_bytes(number: int) -> None:
    assert message_id(unknown(number=number)) == number


@pytest.mark.parametrize("frame", GOOD)
@pytest.mark.parametrize("junk", [b"", b"abc", bytes((0xFD,)), bytes((0xFE, 0xFD))])
def test_where_a_frame_ends_is_in_its_header(frame: bytes, junk: bytes) -> None:
    for length in range(1, len(frame) + 1):
        end = frame_end(junk + frame[:length], len(junk))
        if end <= len(junk) + length:
            assert end == len(junk) + len(frame)


@pytest.mark.parametrize(("frame", "at"), [(heartbeat(), 4), (heartbeat_v1(), 2)])
def test_the_sequence_number_is_read_from_either_header(frame: bytes, at: int) -> None:
    assert header_of(with_header(frame, at, 201))[0] == 201


def test_system_and_component_of_a_header_are_not_the_same() -> None:
    sent = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    for is_mavlink1 in (False, True):
        assert header_of(MavCodec(7, 191).encode(sent, is_mavlink1=is_mavlink1)) == (0, (7, 191), 0)


@pytest.mark.parametrize("frame", [heartbeat(), heartbeat_v1(), unknown(number=0x01_02_03)])
def test_a_header_has_sender_and_message_id_of_either_version(frame: bytes) -> None:
    assert header_of(frame)[1:] == (sender_of(frame), message_id(frame))


def test_the_sender_is_read_from_either_header() -> None:
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
    assert sender_of(MavCodec(7, 191).encode(heartbeat)) == (7, 191)
    assert sender_of(bytes((0xFE, 9, 0, 42, 154, 0, *([0] * 11)))) == (42, 154)
