from __future__ import annotations

import math

import pytest

from companion.radios.kraken import KrakenLinesDecoder, KrakenOptions, KrakenXmlDecoder

POWERS = ", 0.00" * 360
TAIL = "0.0, 0.0, 0, 0, GPS, R, R, R, R"
KRAKTAK = (
    "1718000000000,135,42,-30,144390000,UCA,12.5,CTIKraken,37.7601,-122.4974,0,0,GPS,0,0,0,0"
    + ",1.0" * 360
    + "\n"
)


def line(
    time_ms: int = 1718000000500,
    bearing: float = 218,
    confidence: float = 61.3,
    frequency_hz: int = 433920000,
    array: str = "UCA",
    powers: str = POWERS,
) -> bytes:
    head = f"{time_ms}, {bearing}, {confidence}, -21.4, {frequency_hz}, {array}, 403.2, S1, "
    return f"{head}{TAIL}{powers} \n".encode()


def xml(time_ms: int = 1718000000500, theta: float = 142, overdrive: str = "0") -> bytes:
    return (
        f"<DATA><STATION_ID>S1</STATION_ID><TIME>{time_ms}</TIME><GPS_TIME>0</GPS_TIME>"
        "<FREQUENCY>433.92</FREQUENCY><LOCATION><LATITUDE>0.0</LATITUDE>"
        "<LONGITUDE>0.0</LONGITUDE><HEADING>0</HEADING><SPEED>0</SPEED></LOCATION>"
        f"<DOA>{theta}</DOA><PWR>78.6</PWR><CONF>6130</CONF><LATENCY>403</LATENCY>"
        f"<PROCESSING_TIME>51</PROCESSING_TIME><ADC_OVERDRIVE>{overdrive}</ADC_OVERDRIVE>"
        "<NUM_CORRELATED_SOURCES>1</NUM_CORRELATED_SOURCES><SNR_DB>12.0</SNR_DB></DATA>"
    ).encode()


def test_a_line_of_kraktak_is_a_bearing_clockwise_from_the_arrays_front() -> None:
    (reading,) = KrakenLinesDecoder().feed(KRAKTAK.encode(), 0.0)

    assert reading.emitter == "144.3900"
    assert reading.azimuth_rad is not None
    assert math.degrees(reading.azimuth_rad) == pytest.approx(135.0)
    assert reading.quality == pytest.approx(42 / 99)
    assert reading.device_time_s == pytest.approx(1718000000.0 - 12.5e-3 / 2, abs=1e-6)
    assert reading.range_m is None


def suite(time_ms: int, bearing: int = 218, confidence: str = "0.61") -> bytes:
    head = f"{time_ms}, {bearing}, {confidence}, -21.4, 433920000, UCA, 0, S1, 0.000000, 0.000000, "
    return f"{head}0.0, 12.0, Compass, R, R, R, R{POWERS} \n".encode()


def test_the_suite_of_2026_is_recognised_and_a_closed_squelch_is_silence() -> None:
    decoder = KrakenLinesDecoder()
    (reading,) = decoder.feed(suite(1718000000500), 0.0)

    assert reading.quality == pytest.approx(0.61)
    assert reading.device_time_s is None
    frozen = [decoder.feed(suite(1718000000500 + 200 * n), 0.2 * n) for n in range(1, 250)]
    assert not any(frozen)
    assert set(decoder.counts.refused) == {"page does not change: no transmission"}
    assert len(decoder.feed(suite(1718000060000, bearing=219), 60.0)) == 1


def test_the_scale_of_2022_is_asked_for() -> None:
    old = KrakenLinesDecoder()
    assert old.feed(line(confidence=1.2), 0.0) == []
    assert "set best_confidence to 2" in next(iter(old.counts.refused))
    (reading,) = KrakenLinesDecoder(KrakenOptions(best_confidence=2.0)).feed(
        line(confidence=1.2), 0.0
    )
    assert reading.quality == pytest.approx(0.6)


def test_a_document_without_a_latency_is_read() -> None:
    (reading,) = KrakenXmlDecoder().feed(xml().replace(b"<LATENCY>403</LATENCY>", b""), 0.0)

    assert reading.device_time_s == pytest.approx(1718000000.5)


def test_a_line_of_the_page_is_dated_to_the_middle_of_its_integration() -> None:
    (reading,) = KrakenLinesDecoder().feed(line(), 0.0)

    assert reading.emitter == "433.9200"
    assert math.degrees(reading.azimuth_rad or 0.0) == pytest.approx(218.0)
    assert reading.device_time_s == pytest.approx(1718000000.5 - 0.2016, abs=1e-6)


def test_the_document_says_the_same_direction_the_other_way_round() -> None:
    (reading,) = KrakenXmlDecoder().feed(xml(), 0.0)
    (same,) = KrakenLinesDecoder().feed(line(), 0.0)

    assert math.degrees(reading.azimuth_rad or 0.0) == pytest.approx(142.0)
    assert math.tau - (reading.azimuth_rad or 0.0) == pytest.approx(same.azimuth_rad)
    assert reading.quality == pytest.approx(same.quality)
    assert reading.emitter == same.emitter
    assert reading.device_time_s == pytest.approx(same.device_time_s, abs=1e-3)


@pytest.mark.parametrize(
    ("data", "decoder"),
    [(line(), KrakenLinesDecoder()), (xml(), KrakenXmlDecoder())],
    ids=["csv", "xml"],
)
def test_a_page_that_stays_as_it_was_says_nothing_new(
    data: bytes, decoder: KrakenLinesDecoder | KrakenXmlDecoder
) -> None:
    assert len(decoder.feed(data, 0.0)) == 1
    assert decoder.feed(data * 9, 0.2) == []
    assert not decoder.counts.refused
    assert decoder.feed(data * 9, 58 * 60.0) == []
    assert decoder.counts.refused == {"page does not change: no transmission": 9}


@pytest.mark.parametrize(
    "torn",
    [
        line()[:40] + b"\n",
        line()[:900] + b"\n",
        line(powers=", 0.00" * 359),
        line()[:900] + line(),
        line().replace(b"GPS", b"0.00"),
        line().replace(b"218", b"2.1.8"),
        line(time_ms=17180),
        line()[:-2000] + b"1718000000" + line(),
    ],
)
def test_a_line_that_was_written_while_it_was_read_is_refused(torn: bytes) -> None:
    decoder = KrakenLinesDecoder()

    assert decoder.feed(torn, 0.0) == []
    assert sum(decoder.counts.refused.values()) == 1


def test_a_line_without_the_powers_is_enough() -> None:
    assert len(KrakenLinesDecoder().feed(line(powers=""), 0.0)) == 1


def test_a_direction_of_low_confidence_is_refused_below_the_configured_one() -> None:
    assert KrakenLinesDecoder().feed(line(confidence=9.9), 0.0) == []
    assert (
        len(KrakenLinesDecoder(KrakenOptions(min_confidence=5.0)).feed(line(confidence=9.9), 0.0))
        == 1
    )


@pytest.mark.parametrize("flag", ["1", "True"])
def test_an_overdriven_receiver_is_not_believed(flag: str) -> None:
    decoder = KrakenXmlDecoder()

    assert decoder.feed(xml(overdrive=flag), 0.0) == []
    assert decoder.counts.refused["receiver is overdriven"] == 1
    assert len(KrakenXmlDecoder().feed(xml(overdrive="False"), 0.0)) == 1


def test_a_line_array_is_refused_unless_the_user_knows_its_side() -> None:
    decoder = KrakenLinesDecoder()

    assert decoder.feed(line(array="ULA"), 0.0) == []
    assert decoder.counts.refused["line array: front or back is not known"] == 1
    known = KrakenLinesDecoder(KrakenOptions(accept_line_array=True))
    assert len(known.feed(line(array="ULA"), 0.0)) == 1


def readings_at(decoder: KrakenLinesDecoder, *lines: tuple[int, int]) -> list[bool]:
    """Return True for each accepted line, of a time after the first, ms, and a frequency, MHz."""
    return [
        bool(decoder.feed(line(1718000000000 + ms, frequency_hz=mhz * 1_000_000), 0.0))
        for ms, mhz in lines
    ]


def test_a_frequency_that_was_just_tuned_to_is_skipped_for_two_seconds() -> None:
    believed = readings_at(
        KrakenLinesDecoder(),
        (0, 433),
        (500, 433),
        (1000, 868),
        (2000, 868),
        (2999, 868),
        (3000, 868),
    )

    assert believed == [True, True, False, False, False, True]


def test_tuning_back_is_skipped_as_well_once_the_frequency_was_away() -> None:
    decoder = KrakenLinesDecoder()
    readings_at(decoder, (0, 433), (1000, 868), (20_000, 868))

    assert readings_at(decoder, (30_000, 433), (31_000, 433), (32_000, 433)) == [False, False, True]


def test_channels_beside_each_other_may_fall_silent_and_come_back() -> None:
    decoder = KrakenLinesDecoder()
    assert readings_at(decoder, (0, 433), (0, 868), (500, 433), (500, 868)) == [True] * 4
    readings_at(decoder, *((t, 868) for t in range(1000, 60_000, 500)))

    assert readings_at(decoder, (60_000, 433)) == [True]


def test_channels_that_are_tuned_together_are_skipped_together() -> None:
    decoder = KrakenLinesDecoder()
    readings_at(decoder, (0, 433), (0, 434))

    assert readings_at(decoder, (500, 868), (500, 869)) == [False, False]
    assert readings_at(decoder, (2500, 868), (2500, 869)) == [True, True]


def test_a_silence_of_the_only_transmitter_is_no_tuning() -> None:
    assert readings_at(KrakenLinesDecoder(), (0, 433), (58 * 60_000, 433)) == [True, True]


def test_a_clock_that_is_set_back_is_followed() -> None:
    assert readings_at(KrakenLinesDecoder(), (60_000, 433), (0, 433), (500, 433)) == [
        True,
        True,
        True,
    ]


def test_after_a_lost_line_another_receiver_may_answer() -> None:
    decoder = KrakenLinesDecoder()
    readings_at(decoder, (0, 433), (500, 433))
    decoder.reset()

    assert readings_at(decoder, (500, 868), (1000, 868)) == [True, True]


def test_every_cut_of_a_document_gives_the_same() -> None:
    stream = b"<html>" + xml() + b"\n" + xml(1718000001000) + b"<DA" + xml(1718000001500)[:90]
    stream += b"x" * 9000 + xml(1718000002000)
    whole = KrakenXmlDecoder().feed(stream, 0.0)
    assert len(whole) == 3
    for cut in range(0, len(stream), 7):
        decoder = KrakenXmlDecoder()
        assert decoder.feed(stream[:cut], 0.0) + decoder.feed(stream[cut:], 0.0) == whole


def test_a_document_without_an_end_is_not_kept() -> None:
    decoder = KrakenXmlDecoder()
    for _ in range(100):
        decoder.feed(b"<DATA>" + b"<TIME>1</TIME>" * 700, 0.0)

    assert len(decoder._rest) < 9000
    assert decoder.counts.resync_bytes > 900_000


def test_only_the_newest_frequencies_are_remembered() -> None:
    decoder = KrakenLinesDecoder()
    readings_at(decoder, *((ms, 100 + ms) for ms in range(500)))

    assert len(decoder._channels._seen) == 64
