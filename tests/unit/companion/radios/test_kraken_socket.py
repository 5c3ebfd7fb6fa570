"""KrakenSDR's web socket: peaks, frequencies, and when there is nothing new."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import pytest

from companion.radios.decoder import RadioReading
from companion.radios.kraken_socket import KrakenSocketDecoder, KrakenSocketOptions

TOPOLOGY = b'{"sync_cmd":"TOPOLOGY:%s"}\n'


def frame(payload: bytes) -> bytes:
    if len(payload) < 126:
        return bytes((0x82, len(payload))) + payload
    return struct.pack(">BBH", 0x82, 126, len(payload)) + payload


def band(centre_mhz: float, marker: int = 0x80, bins: int = 16) -> bytes:
    head = struct.pack("<IIIfffII", 0, 5, 4, centre_mhz, 40.2, 0.3, marker, bins)
    return frame(head + b"\x82{" * (3 * bins))


def directions(*channels: tuple[float, Sequence[float]], elevations: int = 0) -> bytes:
    body = struct.pack("<II", 3, len(channels))
    for number, (offset_khz, spectrum) in enumerate(channels):
        count = len(spectrum)
        body += struct.pack("<IfIIfIf", number, offset_khz, 3, count, 0.2, 17, 360.0 / count)
        body += struct.pack(f"<{count}f", *spectrum)
        body += struct.pack("<I", int(elevations > 0))
        if elevations:
            body += struct.pack("<Ifi", elevations, 1.0, 12) + bytes(4 * elevations)
    return frame(body)


def peak_at(theta_deg: float, level: float = 1.0) -> list[float]:
    away = [(degree - theta_deg + 180.0) % 360.0 - 180.0 for degree in range(360)]
    return [level * (0.05 + math.exp(-0.5 * (each / 8.0) ** 2)) for each in away]


def read(decoder: KrakenSocketDecoder, *parts: bytes, now_s: float = 0.0) -> list[RadioReading]:
    return decoder.feed(b"".join(parts), now_s)


def test_the_peak_is_a_bearing_clockwise_at_the_channels_frequency() -> None:
    decoder = KrakenSocketDecoder()

    (reading,) = read(decoder, band(434.0), directions((-80.0, peak_at(30.3))))

    assert reading.emitter == "433.9200"
    assert math.degrees(reading.azimuth_rad or 0.0) == pytest.approx(329.7, abs=0.05)
    assert reading.quality == 1.0
    assert reading.device_time_s is None


def test_a_spectrum_without_much_of_a_peak_is_refused_by_its_confidence() -> None:
    decoder = KrakenSocketDecoder()
    flat = [1.0] * 359 + [1.2]

    assert read(decoder, band(434.0), directions((0.0, flat))) == []
    assert list(decoder.counts.refused) == [
        "low confidence (firmware of 2022 or 2023? then set best_confidence to 2)"
    ]


def test_what_is_repeated_is_silence_at_once_and_said_after_a_while() -> None:
    """A closed squelch sends the last spectrum five times a second."""
    decoder = KrakenSocketDecoder()
    frozen = directions((0.0, peak_at(30.0)))
    read(decoder, band(434.0), frozen)

    repeated = [read(decoder, frozen, now_s=0.2 * number) for number in range(1, 41)]

    assert repeated == [[]] * 40
    assert "page does not change: no transmission" in decoder.counts.refused
    assert len(read(decoder, directions((0.0, peak_at(31.0))), now_s=9.0)) == 1


def test_until_the_centre_is_known_and_in_wideband_there_is_no_frequency() -> None:
    decoder = KrakenSocketDecoder()

    assert read(decoder, directions((0.0, peak_at(30.0)))) == []
    assert len(read(decoder, band(434.0), directions((0.0, peak_at(31.0))))) == 1
    assert read(decoder, band(440.0, marker=0xFE), directions((0.0, peak_at(32.0)))) == []
    assert decoder.counts.refused == {"frequency is not known yet": 2}


def test_a_line_array_is_refused_unless_accepted() -> None:
    for accepts in (False, True):
        decoder = KrakenSocketDecoder(KrakenSocketOptions(accept_line_array=accepts))
        found = read(decoder, TOPOLOGY % b"ULA", band(434.0), directions((0.0, peak_at(30.0))))
        assert len(found) == accepts


def test_frames_of_three_dimensions_are_read_as_far_as_the_azimuth() -> None:
    decoder = KrakenSocketDecoder()

    (reading,) = read(decoder, band(434.0), directions((0.0, peak_at(30.0)), elevations=9))
    assert math.degrees(reading.azimuth_rad or 0.0) == pytest.approx(330.0, abs=0.01)


def test_a_token_is_presented_and_a_missing_one_named() -> None:
    assert KrakenSocketDecoder().hello() == b"SUBSCRIBE:FFT,DOA\n"
    given = KrakenSocketDecoder(KrakenSocketOptions(token="abc123"))
    assert given.hello() == b"AUTH:abc123\nSUBSCRIBE:FFT,DOA\n"

    decoder = KrakenSocketDecoder()
    read(decoder, b'{"auth_required":true}\n{"auth_error":"invalid token"}\n')
    assert list(decoder.counts.refused) == [
        "the receiver asks for a token: set the option `token`",
        "the receiver refuses the token",
    ]


def test_a_picture_of_the_band_larger_than_what_is_kept_is_skipped() -> None:
    decoder = KrakenSocketDecoder()
    payload = struct.pack("<IIIfffII", 0, 5, 4, 434.0, 40.2, 0.3, 0x80, 30_000) + bytes(180_000)
    wide = struct.pack(">BBQ", 0x82, 127, len(payload)) + payload
    parts = [wide[at : at + 4096] for at in range(0, len(wide), 4096)]

    found = [read(decoder, part) for part in parts]
    assert found == [[]] * len(parts)
    assert len(read(decoder, directions((0.0, peak_at(30.0))))) == 1
    assert decoder.counts.resync_bytes == 0


@pytest.mark.parametrize("length", range(8))
@pytest.mark.parametrize("first", [0x81, 0x82])
def test_a_frame_too_short_for_what_it_says_to_be_is_none(first: int, length: int) -> None:
    decoder = KrakenSocketDecoder()
    body = b"{\x00\x00\x00" if first == 0x81 else b"\x03\x00\x00\x00"

    assert read(decoder, bytes((first, length)) + body + bytes(8)) == []
    assert len(read(decoder, b"\n", band(434.0), directions((0.0, peak_at(30.0))))) == 1
