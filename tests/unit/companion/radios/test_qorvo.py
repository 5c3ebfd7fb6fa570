"""Records of Qorvo's CLI, and the JS frames of PDoA kits."""

from __future__ import annotations

import math

import pytest

from companion.radios.decoder import AngleFrame, RadioReading
from companion.radios.qorvo import MAX_RECORD_BYTES, PdoaJsDecoder, QorvoCliDecoder

WITH_ANGLES = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1\n"
    b' [mac_address=0x0001, status="SUCCESS", distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90,'
    b" loc_el_pdoa=32.12, loc_el=12.01, rmt_az=22.84, rmt_el=13.59, RSSI[dBm]=-66.5]}\n"
)
TWO = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=7, block_index=7, n_measurements=2\r\n"
    b' [mac_address=0x0001, status="SUCCESS", distance[cm]=245];\r\n'
    b' [mac_address=0x0002, status="RX_TIMEOUT"]}\r\n'
)
ANGLED = RadioReading(
    emitter=1,
    range_m=0.91,
    azimuth_rad=math.radians(24.90),
    elevation_rad=math.radians(12.01),
    power_dbm=-66.5,
    frame=AngleFrame.ARRAY,
)
RANGED = RadioReading(emitter=1, range_m=2.45, frame=AngleFrame.ARRAY)

TWR = (
    b'JS0076{"TWR": {"a16":"2E5C","R":3,"T":8605,"D":343,"P":1695,"Xcm":165,"Ycm":165,"O":14,'
    b'"V":1,"X":53015,"Y":60972,"Z":10797}}\r\n'
)
SERVICE = b'JS0035{"SN": {"a16":"0001","V":0,"X":-458,"Y":-83,"Z":876}}\r\n'
NEW_TAG = b'JS001D{"NewTag":"1122334455667788"}\r\n'
TAG = RadioReading(emitter="2E5C", range_m=3.43, azimuth_rad=math.pi / 4, frame=AngleFrame.ARRAY)


def test_a_record_over_two_lines_tells_range_and_the_own_angles() -> None:
    assert QorvoCliDecoder().feed(WITH_ANGLES, 0.0) == [ANGLED]


def test_who_did_not_answer_is_refused_by_status() -> None:
    decoder = QorvoCliDecoder()
    assert decoder.feed(TWO, 0.0) == [RANGED]
    assert decoder.counts.refused == {"status RX_TIMEOUT": 1}


def test_a_continuation_may_begin_with_a_carriage_return() -> None:
    assert QorvoCliDecoder().feed(TWO.replace(b"\r\n ", b"\n\r"), 0.0) == [RANGED]


def test_a_record_in_one_line_is_one_as_well() -> None:
    assert QorvoCliDecoder().feed(TWO.replace(b"\r\n", b"") + b"\n", 0.0) == [RANGED]


def test_a_record_that_is_broken_off_keeps_what_was_whole() -> None:
    torn = WITH_ANGLES.replace(b"]}\n", b"];\n") + b' [mac_address=0x0002, status="SUCC\n'
    assert QorvoCliDecoder().feed(torn + TWO, 0.0) == [ANGLED, RANGED]
    status = b'SESSION_STATUS_NTF: {state="IDLE", reason="STOP"}\r\nok\r\n'
    assert QorvoCliDecoder().feed(torn + status + TWO, 0.0) == [ANGLED, RANGED]
    assert QorvoCliDecoder().feed(torn + b"ok\n" + TWO, 0.0) == [ANGLED, RANGED]


def test_a_record_without_end_is_broken_off_at_8_kib() -> None:
    decoder = QorvoCliDecoder()
    endless = b'SESSION_INFO_NTF: {n=1\n [mac_address=0x0001, status="SUCCESS", distance[cm]=245];'
    readings = decoder.feed(endless + b"\n ." * MAX_RECORD_BYTES + b"\n", 0.0)
    assert readings == [RANGED]


TOOL = """# Ranging Data:
        session handle:     2
        n of measurement:   2
        # Measurement 1:
            status:             Ok (0x0)
            mac address:        00:01 hex
            is nlos meas:       Unknown
            distance:           62.0 cm
            AoA azimuth:        -10.5 deg
            AoA az. FOM:        92.0 %
            AoA elevation:      0.0 deg
            AoA elev. FOM:      0.0
            AoA dest azimuth:   33.0 deg
            AoA dest az. FOM:   50.0 %
            slot in error:      0
            rssi:               -0.0 dBm

        # Measurement 2:
            status:             RxTimeout (0x21)
            mac address:        00:02 hex
            distance:           65535.0 cm
            rssi:               -0.0 dBm
"""


def test_qorvos_tool_prints_a_measurement_over_many_lines() -> None:
    decoder = QorvoCliDecoder()
    azimuth_rad = math.radians(-10.5)
    first = RadioReading(1, range_m=0.62, azimuth_rad=azimuth_rad, frame=AngleFrame.ARRAY)

    assert decoder.feed(TOOL.encode(), 0.0) == [first]
    assert decoder.counts.refused == {"status is no success": 1}
    older = TOOL.replace("00:01 hex", "01.00").replace("-0.0 dBm", "-60.5 dB")
    (reading,) = QorvoCliDecoder().feed(older.encode(), 0.0)
    assert (reading.emitter, reading.power_dbm) == (1, -60.5)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("            mac address:        00:01 hex\n", ""),
        ("62.0 cm", "62.0 mm"),
        ("62.0 cm", "65535.0 cm"),
        ("        # Measurement 1:\n", ""),
        ("            status:             Ok (0x0)\n", ""),
    ],
)
def test_a_measurement_of_the_tool_that_is_not_whole_is_no_reading(old: str, new: str) -> None:
    assert QorvoCliDecoder().feed(TOOL.replace(old, new).encode(), 0.0) == []


def test_a_negative_distance_is_reported_as_it_is() -> None:
    (reading,) = QorvoCliDecoder().feed(TWO.replace(b"=245", b"=-75"), 0.0)
    assert reading.range_m == -0.75


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b'"SUCCESS"', b'"NO_IDEA"', "status is no success"),
        (b"0x0001", b"0x0_01", "torn measurement"),
        (b'status="SUCCESS", ', b"", "torn measurement"),
        (b"[cm]=91", b"[cm]=9I", "torn measurement"),
        (b"loc_az=24.90", b"loc_az=249.0", "angle is out of bounds"),
        (b"distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90,", b"", None),
        (b"nce[cm]=91, loc_az_pdoa=65.35, loc_az=24.90, loc_el", b"", "nothing measured"),
    ],
)
def test_a_measurement_that_is_torn_is_refused(old: bytes, new: bytes, reason: str | None) -> None:
    decoder = QorvoCliDecoder()
    stream = WITH_ANGLES.replace(old, new)
    if reason == "nothing measured":
        stream = stream.replace(b" loc_el=12.01,", b"")
    assert len(decoder.feed(stream, 0.0)) == (reason is None)
    assert set(decoder.counts.refused) == ({reason} if reason else set())


def test_a_lost_line_loses_the_record_that_was_begun() -> None:
    decoder = QorvoCliDecoder()
    decoder.feed(WITH_ANGLES[:120], 0.0)
    decoder.reset()
    assert decoder.feed(b' [mac_address=0x0009, status="SUCCESS", distance[cm]=1]}\n', 0.0) == []


def test_a_frame_tells_range_and_place_of_its_tag() -> None:
    decoder = PdoaJsDecoder()
    assert decoder.feed(TWR + SERVICE + NEW_TAG, 0.0) == [TAG]
    assert decoder.counts.frames == 3
    assert not decoder.counts.refused


@pytest.mark.parametrize(
    "stream",
    [
        TWR.replace(b"JS0076", b"JS  76"),
        TWR.replace(b"JS0076", b"JS0012"),
        TWR.replace(b"JS0076", b"JSFFFF"),
        b"boot" + TWR,
        TWR[:60] + TWR,
        SERVICE.rstrip() + TWR,
    ],
)
def test_a_frame_is_found_though_its_length_or_its_line_is_not_its_own(stream: bytes) -> None:
    assert PdoaJsDecoder().feed(stream, 0.0) == [TAG]


def test_a_tag_without_a_place_has_no_bearing() -> None:
    stream = TWR.replace(b'cm":165', b'cm":0')
    (reading,) = PdoaJsDecoder().feed(stream, 0.0)
    assert (reading.range_m, reading.azimuth_rad) == (3.43, None)


def test_the_short_form_tells_a_place_in_hexadecimal() -> None:
    (reading,) = PdoaJsDecoder().feed(b"AR2E5C03FFFFFED400000190\r\n", 0.0)
    assert (reading.emitter, reading.range_m) == ("2E5C", 5.0)
    assert reading.azimuth_rad == pytest.approx(math.atan2(-3.0, 4.0))


@pytest.mark.parametrize(
    "stream", [TWR[:100] + b"\n", TWR.replace(b'"D":343', b'"D":"3"'), TWR.replace(b"2E5C", b"?")]
)
def test_a_torn_frame_is_refused(stream: bytes) -> None:
    decoder = PdoaJsDecoder()
    assert decoder.feed(stream, 0.0) == []
    assert decoder.counts.refused == {"torn frame": 1}


def test_a_distance_in_another_unit_is_refused_as_that() -> None:
    decoder = QorvoCliDecoder()
    assert decoder.feed(TWO.replace(b"distance[cm]=245", b"distance[m]=2.45"), 0.0) == []
    assert decoder.counts.refused["distance is not in cm"] == 1
