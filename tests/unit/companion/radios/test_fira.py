"""FiRa UCI notifications, and the SR150's frames."""

from __future__ import annotations

import math
from struct import pack

import pytest

from companion.radios.decoder import AngleFrame, RadioReading, radio_kind
from companion.radios.fira_pans import PER_RAD, FiraUciDecoder, Sr150Decoder

EMPTY = bytes.fromhex(
    "62 00 00 19 00 02 03 04 05 06 07 08 00 0a 01 01 01 01 00 00 00 00 00 00 00 00 00 00 00"
)
ONE = bytes.fromhex(
    "62 00 00 38 07 00 00 00 2a 00 00 00 00 c8 00 00 00 01 00 00 00 00 00 00 00 00 00 00 01"
    "01 00 00 00 eb 00 73 0c 64 00 06 5f 00 00 00 00 00 00 01 85"
) + bytes(11)
STATUS = bytes.fromhex("60 01 00 01 01")
"""CORE_DEVICE_STATUS_NTF, which is not ranging."""
FRAME = bytes.fromhex(
    "8e 30 00 01 00 00 00 2a 00 00 00 64 00 00 00 22 11 22 11 00 00 02 00 00 fb 80 02 00 00 00 00"
    "5a 50 00 00 1b"
)


def head(count: int, *, kind: int = 1, address: int = 0) -> bytes:
    """The fixed part of a notification's payload."""
    return pack("<IIBIBBB8xB", 7, 42, 0, 200, kind, 0, address, count)


def packets(payload: bytes, piece: int = 255) -> bytes:
    """A payload in packets of this many bytes."""
    parts = [payload[at : at + piece] for at in range(0, len(payload), piece)]
    last = len(parts) - 1
    return b"".join(
        bytes((0x62 if number == last else 0x72, 0, 0, len(part))) + part
        for number, part in enumerate(parts)
    )


def short(mac: int, *rest: int) -> bytes:
    """Status, line of sight, distance, azimuth, merit, elevation, merit of a short address."""
    return pack("<HBBHhBhB", mac, *rest) + bytes(19)


def degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def test_a_notification_without_peers_has_no_readings() -> None:
    decoder = FiraUciDecoder()
    assert decoder.feed(EMPTY, 0.0) == []
    assert decoder.counts.frames == 1


def test_a_notification_tells_range_both_angles_and_line_of_sight() -> None:
    (reading,) = FiraUciDecoder().feed(ONE, 0.0)
    assert reading.emitter == 1
    assert reading.range_m == 2.35
    assert degrees(reading.azimuth_rad) == pytest.approx(24.898, abs=5e-4)
    assert degrees(reading.elevation_rad) == pytest.approx(12.0)
    assert reading.frame is AngleFrame.ARRAY
    assert reading.quality == 0.95
    assert reading.line_of_sight is True


@pytest.mark.parametrize("piece", [24, 31, 100, 255])
def test_a_notification_of_several_packets_is_put_together(piece: int) -> None:
    records = [short(mac, 0, 1, 100 * mac, 0, 0, 0, 0) for mac in range(1, 13)]
    stream = packets(head(12) + b"".join(records), piece)
    decoder = FiraUciDecoder()
    readings = decoder.feed(STATUS + stream + ONE, 0.0)
    assert [reading.range_m for reading in readings] == [*map(float, range(1, 13)), 2.35]
    assert decoder.counts.frames == 2
    assert decoder.counts.resync_bytes == len(STATUS)


def test_a_notification_whose_rest_does_not_come_is_given_up() -> None:
    torn = packets(head(12) + bytes(12 * 31), 100)[:104]
    assert len(FiraUciDecoder().feed(torn + ONE, 0.0)) == 1


def test_extended_addresses_are_of_eight_bytes() -> None:
    record = pack("<QBBHhBhB", 0x0102030405060708, 0, 0, 512, -1280, 90, 0, 0) + bytes(13)
    (reading,) = FiraUciDecoder().feed(packets(head(1, address=1) + record), 0.0)
    assert reading.emitter == 0x0102030405060708
    assert reading.range_m == 5.12
    assert degrees(reading.azimuth_rad) == pytest.approx(-10.0)
    assert reading.elevation_rad is None


def test_an_angle_without_merit_was_not_measured() -> None:
    (reading,) = FiraUciDecoder().feed(packets(head(1) + short(1, 0, 255, 235, 99, 0, 99, 0)), 0.0)
    assert (reading.azimuth_rad, reading.elevation_rad, reading.quality) == (None, None, None)
    assert reading.line_of_sight is None


def test_angles_one_way_have_no_range() -> None:
    record = pack("<HBBBHhBhB", 0x1234, 0, 0, 9, 77, 1280, 80, -640, 60)
    assert FiraUciDecoder().feed(packets(head(1, kind=3) + record), 0.0) == [
        RadioReading(
            emitter=0x1234,
            azimuth_rad=1280 / PER_RAD,
            elevation_rad=-640 / PER_RAD,
            frame=AngleFrame.ARRAY,
            quality=0.6,
            line_of_sight=True,
        )
    ]


@pytest.mark.parametrize("raw", [75, 0x10000 - 75])
def test_a_negative_distance_has_its_own_status(raw: int) -> None:
    record = short(1, 0x1B, 0, raw, 0, 0, 0, 0)
    assert FiraUciDecoder().feed(packets(head(1) + record), 0.0)[0].range_m == -0.75


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (head(1) + short(1, 0x21, 255, 0xFFFF, 0, 0, 0, 0), "status no answer (timeout)"),
        (head(1) + short(1, 0x25, 255, 0xFFFF, 0, 0, 0, 0), "status 0x25"),
        (head(1) + short(1, 0, 0, 0xFFFF, 0, 0, 0, 0), "nothing measured"),
        (head(1, kind=2) + bytes(40), "ranging is downlink TDoA"),
    ],
)
def test_what_was_not_measured_is_refused(payload: bytes, reason: str) -> None:
    decoder = FiraUciDecoder()
    assert decoder.feed(packets(payload), 0.0) == []
    assert decoder.counts.refused == {reason: 1}


def test_an_sr150_frame_tells_range_and_both_angles_of_its_peer() -> None:
    (reading,) = Sr150Decoder().feed(FRAME, 0.0)
    assert reading.emitter == 0x1122
    assert reading.range_m == 5.12
    assert degrees(reading.azimuth_rad) == pytest.approx(-10.0)
    assert degrees(reading.elevation_rad) == pytest.approx(5.0)
    assert reading.quality == 0.8
    assert reading.line_of_sight is True
    defaults = radio_kind("sr150").defaults
    assert (defaults["bearing_sign"], defaults["elevation_sign"]) == (-1, -1)


@pytest.mark.parametrize(("at", "value"), [(22, 7), (31, 101), (35, 0x1C)])
def test_an_sr150_frame_that_is_out_of_bounds_is_none(at: int, value: int) -> None:
    decoder = Sr150Decoder()
    false = FRAME[:at] + bytes([value]) + FRAME[at + 1 :]
    assert len(decoder.feed(false + FRAME, 0.0)) == 1
    assert decoder.counts.resync_bytes == len(FRAME)


def test_an_sr150_peer_that_did_not_answer_is_refused() -> None:
    decoder = Sr150Decoder()
    assert decoder.feed(FRAME[:19] + b"\x21" + FRAME[20:], 0.0) == []
    assert decoder.counts.refused == {"status no answer (timeout)": 1}
