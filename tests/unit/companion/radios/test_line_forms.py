"""Lines of fixed forms: what each says, and what cannot be used."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from companion.errors import ConfigError
from companion.radios.decoder import RadioDecoder, RadioReading, radio_kind
from companion.radios.line_forms import (
    PozyxDecoder,
    PozyxOptions,
    Ryuw122Decoder,
    TagOptions,
)


def decoder_of(name: str) -> RadioDecoder:
    return radio_kind(name).decoder()


def read(decoder: RadioDecoder, *printed: str) -> list[RadioReading]:
    return decoder.feed("".join(f"{line}\r\n" for line in printed).encode(), 0.0)


@pytest.mark.parametrize(
    ("name", "line", "emitter", "range_m"),
    [
        ("ryuw122", "+ANCHOR_RCV=DAVID123,5,HELLO,40 cm,-72", "DAVID123", 0.40),
        ("ryuw122", "+ANCHOR_RCV=TAG0010,4,PONG,040 cm", "TAG0010", 0.40),
        ("ryuw122", "+ANCHOR_RCV=ANCH0001,5,HELLO,1240 cm,-71 dBm", "ANCH0001", 12.40),
        ("ryuw122", "+ANCHOR_RCV= TAG1,6,a,9 cm,317 cm", "TAG1", 3.17),
        ("bu01", "an0:0.53m", 0, 0.53),
        ("bu03", "distance: 1.234567", None, 1.234567),
        ("bu03", "distance:0.871000", None, 0.871),
        ("pozyx", "12345ms, 6789mm, -83dBm", None, 6.789),
        ("pozyx", "12345 ms, 6789 mm, -83 dBm", None, 6.789),
        ("lr11xx", "INFO: RTToF result: Distance: 318m, RSSI: -71 ", None, 318.0),
        ("lr11xx", "RTToF result: Distance: -3m, RSSI: -41 ", None, -3.0),
        (
            "channel_sounding",
            "I: Distance estimates on antenna path 0: ifft: 1.039173, phase_slope: 1.58, rtt: 3.1",
            None,
            1.039173,
        ),
        ("channel_sounding", "Phase-Based Ranging method: 2.300000 meters", None, 2.3),
        (
            "channel_sounding",
            "<inf> app_main: Distance estimates: median: 1.31m, update: 1.24m, time_delta: 12ms",
            None,
            1.24,
        ),
        ("channel_sounding", "Measurement result: 1234 mm | RSSI distance: 5123 mm", None, 1.234),
        ("channel_sounding", "[APP] [2] Measurement main mode result: 1234 mm", 2, 1.234),
    ],
)
def test_a_line_is_a_range(name: str, line: str, emitter: object, range_m: float) -> None:
    (reading,) = read(decoder_of(name), line)

    assert reading.emitter == emitter
    assert reading.range_m == pytest.approx(range_m)


def test_a_silabs_initiator_names_the_reflector_of_each_connection() -> None:
    decoder = decoder_of("channel_sounding")
    found = read(
        decoder,
        "[APP] [1] # 0001 --- Ranging Counter = 0012",
        "[APP] [1] BT Address: C4:7C:8D:00:00:01",
        "[APP] [1] Measurement main mode result: 1234 mm",
        "[APP] [1] Raw main mode distance: 1300 mm",
        "[APP] [1] Measurement main mode likeliness: 0.97",
        "[APP] [1] RSSI distance: 5123 mm",
        "[APP] [2] BT Address: C4:7C:8D:00:00:02",
        "[APP] [1] Measurement sub mode result: 1900 mm",
        "[APP] [2] Measurement main mode result: 2345 mm",
        "[APP] [1] Measurement main mode result: 1235 mm",
    )

    first, second = "C4:7C:8D:00:00:01", "C4:7C:8D:00:00:02"
    assert [(r.emitter, r.range_m) for r in found] == [
        (first, 1.234),
        (second, 2.345),
        (first, 1.235),
    ]
    assert decoder.counts.unrecognised == 0
    assert read(decoder, "1] Measurement main mode result: 1236 mm") == []
    assert "without its connection" in " ".join(decoder.counts.refused)


def test_several_of_one_line_are_all_read() -> None:
    bu01 = read(decoder_of("bu01"), "an1:1.25m an2:3.50m")
    pozyx = read(decoder_of("pozyx"), "17 0x6951: 1234mm, -81dB 0x6e4e: 4321mm, -84dB")

    assert [(r.emitter, r.range_m) for r in bu01] == [(1, 1.25), (2, 3.5)]
    assert [(r.emitter, r.range_m) for r in pozyx] == [("0x6951", 1.234), ("0x6e4e", 4.321)]


@pytest.mark.parametrize(
    ("name", "torn", "whole"),
    [
        ("ryuw122", "+ANCHOR_RCV=DAVID123,5,", "+ANCHOR_RCV=DAVID124,5,HELLO,90 cm,-60"),
        ("ryuw122", "+ANCHOR_RCV=DAVID123,5,HEL", "+ANCHOR_RCV=DAVID124,5,HELLO,90 cm,-60"),
        (
            "doppler",
            "Bearing:  120.4\N{DEGREE SIGN} (ra",
            "Bearing:   45.2\N{DEGREE SIGN} (raw:   44.8\N{DEGREE SIGN}) confidence: 0.91",
        ),
    ],
)
def test_a_torn_line_takes_no_value_of_the_next_one(name: str, torn: str, whole: str) -> None:
    assert read(decoder_of(name), torn + whole) in ([], read(decoder_of(name), whole))


@pytest.mark.parametrize(
    ("name", "line", "reason"),
    [
        ("ryuw122", "+TAG_RCV=4,PING", "a tag measures no distance"),
        ("ryuw122", "+ERR=4", "reports an error"),
        ("ryuw122", "+ANCHOR_RCV=DAVID123,5,HEL", "torn line"),
        ("bu03", "ERR", "reports an error"),
        ("bu03", "distance: nan", "torn line"),
        ("pozyx", "ERROR: ranging", "ranging failed"),
        ("pozyx", "D,00", "ranging failed"),
        ("lr11xx", "RTTOF request timeout", "no answer"),
        (
            "channel_sounding",
            "I: Distance estimates on antenna path 0: ifft: nan, phase_slope: nan, rtt: 3.07",
            "no distance by phases",
        ),
        (
            "doppler",
            "Bearing:  120.4\N{DEGREE SIGN} (raw: 119.0\N{DEGREE SIGN}) confidence: 0.02"
            "  [no signal]",
            "no signal",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_by_its_reason(name: str, line: str, reason: str) -> None:
    decoder = decoder_of(name)

    assert read(decoder, line) == []
    (counted,) = decoder.counts.refused
    assert reason in counted


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("ryuw122", "+OK"),
        ("ryuw122", "AT+ANCHOR_SEND=DAVID123,4,PING"),
        ("ryuw122", "+ADDRESS=ANCHOR01"),
        ("bu01", "+switchdis=OK"),
        ("bu03", "OK"),
        ("pozyx", "D,01"),
        ("channel_sounding", "Round-Trip Timing method: 3.1 meters (derived from 30 samples)"),
        ("doppler", "S12345678901234567"),
    ],
)
def test_what_belongs_to_the_format_and_measures_nothing_is_not_unrecognised(
    name: str, line: str
) -> None:
    decoder = decoder_of(name)

    assert read(decoder, line) == []
    assert decoder.counts.frames == 1
    assert not decoder.counts.unrecognised
    assert not decoder.counts.refused


def test_modules_that_are_asked_are_asked_for_the_configured_one() -> None:
    reyax, pozyx = Ryuw122Decoder(TagOptions("DAVID123")), PozyxDecoder(PozyxOptions("0x6951"))

    assert reyax.request() == b"AT+ANCHOR_SEND=DAVID123,4,PING\r\n"
    assert pozyx.request() == b"F,c7,5169,11\rF,b5,5169,1\r"
    assert Ryuw122Decoder().request() == PozyxDecoder().request() == b""


def test_a_pozyx_answers_in_hexadecimal() -> None:
    decoder = PozyxDecoder(PozyxOptions("0x6951"))
    data = (12_345).to_bytes(4, "little") + (6_789).to_bytes(4, "little") + b"\xad\xff"

    (reading,) = read(decoder, "D,01" + data.hex())
    assert reading == RadioReading("0x6951", device_time_s=12.345, range_m=6.789, power_dbm=-83.0)
    assert read(decoder, "D,01" + bytes(10).hex()) == []
    assert decoder.counts.refused == {"no range yet": 1}


@pytest.mark.parametrize(
    ("line", "azimuth_deg", "quality"),
    [
        ("C3469960084001663117493011", 346.9, 960 / 999),
        ("C0007123084001663117493011", 0.7, 123 / 999),
        (
            '{"ts":"2026-08-17T22:04:43.120Z","bearing":123.4,"raw":121.0,"confidence":0.85,'
            '"snr_db":12.1,"bearing_uncertainty_deg":2.31,"signal_strength":0.7,'
            '"signal_present":true,"resultant_length":0.97,"tone_peak":0.61,"lock_quality":0.9,'
            '"phase_error_variance":0.001}',
            123.4,
            0.85,
        ),
        (
            "Bearing:   45.2\N{DEGREE SIGN} (raw:   44.8\N{DEGREE SIGN}) confidence: 0.91",
            45.2,
            0.91,
        ),
        (
            "2026-08-17T22:04:43.120Z,271.5,270.0,0.66,9.1,3.10,0.5,true,0.93,0.5,0.9,0.001",
            271.5,
            0.66,
        ),
        ("%045/7", 45.0, 0.7778),
        ("%143/9", 143.0, 1.0),
    ],
)
def test_a_doppler_finder_says_degrees_clockwise(
    line: str, azimuth_deg: float, quality: float
) -> None:
    (reading,) = read(decoder_of("doppler"), line)

    assert reading.azimuth_rad == pytest.approx(math.radians(azimuth_deg))
    assert reading.quality == pytest.approx(quality, abs=1e-4)


def test_a_sentences_time_is_its_unix_time() -> None:
    (reading,) = read(decoder_of("doppler"), "C3469960084001663117493011")

    assert reading.device_time_s == pytest.approx(1_663_117_493.011)


def test_a_module_names_itself_when_it_is_probed() -> None:
    for name, line in (("ryuw122", "+VER=RYUW122_V1.0.21"), ("pozyx", "D,43")):
        decoder = decoder_of(name)
        poll = radio_kind(name).poll
        assert poll is not None
        assert poll.probe
        read(decoder, line)
        assert decoder.counts.is_introduced


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Ryuw122Decoder(TagOptions("LONGERTHAN8")), "ryuw122: tag: its AT.ADDRESS"),
        (lambda: Ryuw122Decoder(TagOptions("a,b")), "ryuw122: tag: its AT.ADDRESS"),
        (lambda: PozyxDecoder(PozyxOptions("0x69")), "pozyx: tag: the network id"),
    ],
)
def test_a_tag_that_is_no_address_is_refused_in_words(
    make: Callable[[], RadioDecoder], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        make()
