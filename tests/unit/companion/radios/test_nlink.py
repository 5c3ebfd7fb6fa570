"""NLink frames of the maker's own tests (github.com/nooploop-dev/nlink_parser), and made ones."""

from __future__ import annotations

import math
from struct import pack

import pytest

from companion.radios.decoder import RadioReading, radio_kind
from companion.radios.nlink import NlinkDecoder, NlinkOptions

AOA = bytes.fromhex(
    """
    55 07 42 00 02 00 be 73 02 00 00 00 00 00 00 00 f1 06 ef 12 04 01 00 ff 02 00 22 0b a3 9f
    9e 00 01 01 02 03 00 ad 00 a4 9f 00 00 01 02 ec 03 00 cb 03 a5 a0 00 00 01 03 88 05 00 99
    ec a3 a0 00 00 33
    """
)
NODE_FRAME_3 = bytes.fromhex(
    """
    55 05 32 00 02 01 f8 11 07 00 6f d0 6e 00 00 00 01 02 5a 13 04 01 00 22 0b 00 b5 9f 01 01
    a3 17 00 b6 a0 01 02 88 1c 00 aa 9f 01 03 e6 14 00 b8 a0 9a
    """
)
NODE_FRAME_5 = bytes.fromhex(
    """
    55 08 41 00 02 01 00 00 00 f8 11 07 00 6f d0 6e 00 00 00 01 02 5a 13 04 01 00 00 00 00 22
    0b 00 b5 9f 01 01 00 00 00 a3 17 00 b6 a0 01 02 00 00 00 88 1c 00 aa 9f 01 03 00 00 00 e6
    14 00 b8 a0 ac
    """
)
NODE_FRAME_4 = bytes.fromhex(
    """
    55 06 40 00 01 03 8e 9d 01 00 8e 9d 01 00 ff ff 03 01 68 11 02 02 00 00 58 04 00 8d 09 00
    01 d4 06 00 02 f6 07 00 03 ad 06 00 05 00 00 46 04 00 b8 0a 00 01 93 05 00 02 68 09 00 03
    43 05 00 60
    """
)
NODE_FRAME_1 = bytes.fromhex(
    """
    55 03 44 00 03 00 e8 80 00 00 00 86 00 00 01 51 01 e8 01 f2 02 02 92 09 48 13 02 02 00 5f
    0b 00 86 09 00 9b ff ff c9 37 8a 34 06 ee 37 3f aa 02 02 93 09 00 45 09 00 c4 fc ff 8d 09
    00 66 09 00 c4 fc ff 8e
    """
)
NODE_FRAME_2 = bytes.fromhex(
    """
    55 04 ac 00 02 01 ba 66 1d 00 06 09 ff de 0a 00 df ff ff e8 03 00 fa ff ff 1a 00 00 00 00
    00 c0 12 00 00 00 00 00 00 00 27 ac e2 3c 56 ed 1c 3c d2 70 3b bd 32 57 66 3e 3b cb 1b 41
    93 70 61 bd 25 b2 6b 41 a1 22 6c 41 da da 6b 41 6d 23 e9 23 70 dd db f7 30 3f 5f d6 31 3f
    ba 81 1e 3e 47 69 e2 bd 91 9b 40 40 c5 23 00 00 40 40 5c d5 1c 00 00 00 1d 00 6d 13 04 01
    00 6b 0c 00 b1 9f a6 66 1d 00 16 45 01 01 ac 15 00 b4 a1 a6 66 1d 00 d3 01 01 02 48 1a 00
    ca 9f a6 66 1d 00 38 ba 01 03 2b 12 00 c6 a0 a6 66 1d 00 64 40 25
    """
)
IOT = bytes.fromhex(
    """
    6a 00 1d 00 00 4f 00 30 fa db 0b 00 00 01 00 5b 00 2f 12 01 00 a5 f0 3c 03 8f a5 00 8c
    """
)


def read(stream: bytes, options: NlinkOptions | None = None) -> list[RadioReading]:
    return NlinkDecoder(options).feed(stream, 0.0)


def summed(text: str) -> bytes:
    """A frame with its checksum, from its other bytes."""
    frame = bytes.fromhex(text)
    return frame + bytes([sum(frame) & 0xFF])


def test_the_aoa_frame_tells_ranges_and_angles_by_the_local_clock() -> None:
    readings = read(AOA)
    assert [reading.emitter for reading in readings] == [0, 1, 2, 3]
    assert [reading.range_m for reading in readings] == pytest.approx([0.767, 0.770, 1.004, 1.416])
    degrees = [math.degrees(reading.azimuth_rad or 0.0) for reading in readings]
    assert degrees == pytest.approx([28.50, 1.73, 9.71, -49.67])
    assert {reading.device_time_s for reading in readings} == {160.702}
    assert {reading.elevation_rad for reading in readings} == {None}
    assert {reading.line_of_sight for reading in readings} == {None}


@pytest.mark.parametrize("frame", [NODE_FRAME_3, NODE_FRAME_5])
def test_node_frames_3_and_5_tell_ranges(frame: bytes) -> None:
    readings = read(frame)
    assert [reading.emitter for reading in readings] == [0, 1, 2, 3]
    assert [reading.range_m for reading in readings] == pytest.approx([2.850, 6.051, 7.304, 5.350])
    assert {reading.device_time_s for reading in readings} == {463.352}
    assert {reading.azimuth_rad for reading in readings} == {None}


def test_node_frame_2_tells_ranges_beside_the_nodes_own_place() -> None:
    readings = read(NODE_FRAME_2)
    assert [reading.emitter for reading in readings] == [0, 1, 2, 3]
    assert [reading.range_m for reading in readings] == pytest.approx([3.179, 5.548, 6.728, 4.651])
    assert {reading.device_time_s for reading in readings} == {9.157}


def test_an_iot_frame_tells_range_and_both_angles() -> None:
    (reading,) = read(IOT)
    assert reading.emitter == 0x2F005B00
    assert reading.device_time_s == 777.210
    assert reading.range_m == pytest.approx(0.274)
    assert math.degrees(reading.azimuth_rad or 0.0) == pytest.approx(-39.31)
    assert math.degrees(reading.elevation_rad or 0.0) == pytest.approx(8.28)
    assert reading.line_of_sight is None


def test_data_of_users_between_iot_peers_are_stepped_over() -> None:
    element = IOT[14:28]
    parts = (IOT[4:13], b"\x02", element[:-1], b"\xa3abc", element)
    body = b"".join(parts)
    frame = summed((b"\x6a\x00" + pack("<H", len(body) + 5) + body).hex())
    assert [reading.range_m for reading in read(frame)] == pytest.approx([0.274, 0.274])


def test_a_tag_frame_tells_the_distances_that_it_has() -> None:
    head = bytes.fromhex("55 01 07 02") + bytes(18)
    distances = bytes.fromhex("e803 00  000000  5a0201  e8ffff  580280  000000  000000  010000")
    frame = summed((head + distances + bytes(62) + pack("<I", 5250) + bytes(15)).hex())
    assert len(frame) == 128
    readings = read(frame)
    assert [(reading.emitter, reading.range_m) for reading in readings] == [
        (0, 1.0),
        (2, pytest.approx(66.138)),
        (7, pytest.approx(0.001)),
    ]
    assert {reading.device_time_s for reading in readings} == {5.250}


def test_a_distance_that_is_none_or_unknown_is_refused() -> None:
    decoder = NlinkDecoder()
    zero = AOA[:23] + bytes(3) + AOA[26:-1]
    unknown = AOA[:23] + (-8_388_000).to_bytes(3, "little", signed=True) + AOA[26:-1]
    for body in (zero, unknown):
        assert [r.emitter for r in decoder.feed(summed(body.hex()), 0.0)] == [1, 2, 3]
    assert decoder.counts.refused == {"no distance": 2}


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (NODE_FRAME_1, "NodeFrame1: no ranges"),
        (NODE_FRAME_4, "NodeFrame4: other nodes' ranges"),
        (summed("55 02 0c 00 02 01 00000000 00"), "NodeFrame0: no ranges"),
        (summed("55 09 0f 00 02 00000000 00000000 00"), "NodeFrame6: no ranges"),
        (b"\x55\x00" + bytes(893) + b"\xee", "AnchorFrame0: other nodes' ranges"),
    ],
)
def test_frames_without_own_ranges_are_stepped_over_and_counted(frame: bytes, reason: str) -> None:
    decoder = NlinkDecoder()
    assert len(decoder.feed(frame + AOA, 0.0)) == 4
    assert decoder.counts.refused == {reason: 1}
    assert decoder.counts.frames == 2
    assert decoder.counts.resync_bytes == 0


def test_a_laser_on_the_same_line_is_stepped_over() -> None:
    decoder = NlinkDecoder()
    laser = bytes.fromhex("57 00 ff 00 9e 8f 00 00 ad 08 00 00 03 00 ff 3a")
    assert len(decoder.feed(AOA + laser + AOA, 0.0)) == 8
    assert decoder.counts.resync_bytes == len(laser)


def test_a_bad_sum_costs_its_frame_and_not_the_next() -> None:
    decoder = NlinkDecoder()
    torn = AOA[:40]
    assert len(decoder.feed(torn + AOA + AOA[:-1] + b"\x34" + AOA, 0.0)) == 8
    assert decoder.counts.bad_checksum == 2
    assert decoder.counts.readings == 8


def test_a_length_that_its_number_of_elements_denies_is_no_frame() -> None:
    decoder = NlinkDecoder()
    false = bytes.fromhex("55 07 00 08") + bytes(16) + b"\x04"
    assert len(decoder.feed(false + AOA, 0.0)) == 4  # nothing of 2048 bytes is waited for
    assert decoder.counts.resync_bytes == len(false)


def test_line_of_sight_is_judged_only_by_a_threshold_that_is_set() -> None:
    options = NlinkOptions(nlos_gap_db=10.0)
    assert [r.line_of_sight for r in read(AOA, options)] == [True, True, True, True]
    # 11, 11, 5.5 and 12 dB
    assert [r.line_of_sight for r in read(NODE_FRAME_3, options)] == [False, False, True, False]
    assert [r.line_of_sight for r in read(NODE_FRAME_2, NlinkOptions(nlos_gap_db=20.0))][:2] == [
        None,
        None,
    ]


def test_what_is_from_behind_keeps_its_range_and_loses_its_angle() -> None:
    readings = read(AOA, NlinkOptions(behind_fp_dbm=-81.75))
    assert [reading.azimuth_rad is None for reading in readings] == [False, True, True, False]
    assert all(reading.range_m for reading in readings)


def test_a_lost_line_loses_the_frame_that_was_begun() -> None:
    decoder = NlinkDecoder()
    decoder.feed(AOA[:30], 0.0)
    decoder.reset()
    assert len(decoder.feed(AOA, 0.0)) == 4
    assert decoder.counts.resync_bytes == 0


def test_the_clock_wraps_as_milliseconds_in_32_bits_do() -> None:
    assert radio_kind("nlink").clock_wrap_s == pytest.approx(4_294_967.296)
