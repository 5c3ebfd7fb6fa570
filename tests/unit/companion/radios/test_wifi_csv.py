from __future__ import annotations

import pytest

from companion.errors import ConfigError
from companion.radios.wifi_csv import (
    AndroidRttDecoder,
    AndroidRttOptions,
    FtmCsvDecoder,
    FtmCsvOptions,
)

FRAMES = "33000,-51,1,2,3,4,34000,-52,5,6,7,8,"
ANDROID = "timestamp,session,ssid,bssid,distance_mm,std_dev_mm,rssi,attempted,successful\n"
ROW = "1718000000123,1,Lost,aa:bb:cc:dd:ee:ff,5430,120,-61,8,7\n"


@pytest.mark.parametrize(
    ("row", "emitter", "range_m"),
    [
        (f"12,33,35,507,2,{FRAMES}", 12, 5.07),
        (f"12,33,35,507,498,2,{FRAMES}", 12, 5.07),
        ("12,33,35,507,0,", 12, 5.07),
        ("FTM Data: Raw RTT = 35 nSec, Est RTT = 33 nSec, Distance = 5.07 meters", None, 5.07),
        ("AA:BB:CC:DD:EE:FF,12.34 m, 82 ns, 90", "aa:bb:cc:dd:ee:ff", 12.34),
        ("5.07|33|-61", None, 5.07),
        ("507|33|-61", None, 5.07),
    ],
    ids=["gtec", "gtec extra", "gtec no frames", "words", "address", "bars m", "bars cm"],
)
def test_the_known_rows_are_distinguished(
    row: str, emitter: str | int | None, range_m: float
) -> None:
    (reading,) = FtmCsvDecoder().feed(row.encode() + b"\r\n", 0.0)

    assert reading.emitter == emitter
    assert reading.range_m == pytest.approx(range_m)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        (f"12,33,35,507,3,{FRAMES}", "torn row"),
        (f"12,33,35,0,2,{FRAMES}", "distance 0: the radio cannot say less"),
        (f"12,33,35,4294967290,2,{FRAMES}", "distance is out of bounds"),
        ("50.7|33|-61", "distance and round trip time do not agree"),
    ],
)
def test_rows_that_cannot_be_used_are_counted(row: str, reason: str) -> None:
    decoder = FtmCsvDecoder()

    assert decoder.feed(row.encode() + b"\n", 0.0) == []
    assert decoder.counts.refused == {reason: 1}


def test_a_header_and_boot_text_are_passed_over() -> None:
    decoder = FtmCsvDecoder()
    text = b"anchorId,rtt_est,rtt_raw,dist,numFrames,\nrst:0x1 (POWERON),boot:0x8\n"

    assert decoder.feed(text, 0.0) == []
    assert not decoder.counts.refused


def test_columns_can_be_given_with_their_units() -> None:
    names = ("emitter", "_", "rtt_ps", "time_ms", "quality_percent")
    decoder = FtmCsvDecoder(FtmCsvOptions(columns=names, delimiter=";"))
    header, reading = b"id;ssid;rtt;ms;q\n", b"7;net;33800;1500;90\n"

    assert decoder.feed(header, 0.0) == []
    (found,) = decoder.feed(reading, 0.0)
    assert found.emitter == 7
    assert found.range_m == pytest.approx(5.0665, abs=1e-4)
    assert found.device_time_s == pytest.approx(1.5)
    assert found.quality == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("emitter", "range"), "`range` is not a quantity with a unit"),
        (("emitter", "time_s"), "neither a range, an angle nor a power"),
        (("range_cm", "range_m"), "says what another one says too"),
    ],
)
def test_columns_that_say_nothing_are_a_configuration_error(
    names: tuple[str, ...], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        FtmCsvDecoder(FtmCsvOptions(columns=names))


ONE = AndroidRttOptions(single_emitter=True)


def test_a_row_of_an_app_is_a_range_with_sigma_quality_and_time() -> None:
    (reading,) = AndroidRttDecoder().feed((ANDROID + ROW).encode(), 0.0)

    assert reading.emitter == "aa:bb:cc:dd:ee:ff"
    assert reading.range_m == pytest.approx(5.430)
    assert reading.range_sigma_m == pytest.approx(0.120)
    assert reading.quality == pytest.approx(7 / 8, abs=1e-6)
    assert reading.device_time_s == pytest.approx(1718000000.123)


def test_nothing_is_known_of_a_row_without_a_success() -> None:
    decoder = AndroidRttDecoder()
    row = "1718000000123,1,Lost,aa:bb:cc:dd:ee:ff,0,0,-127,8,0\n"

    assert decoder.feed((ANDROID + row).encode(), 0.0) == []
    assert decoder.counts.refused == {"no measurement succeeded": 1}


def test_a_deviation_of_zero_is_none_and_a_distance_may_be_negative() -> None:
    row = "1718000000123,1,Lost,aa:bb:cc:dd:ee:ff,-120,0,-40,1,1\n"
    (reading,) = AndroidRttDecoder().feed((ANDROID + row).encode(), 0.0)

    assert reading.range_m == pytest.approx(-0.12)
    assert reading.range_sigma_m is None


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("bssid,distanceMm,status", "aa:bb:cc:dd:ee:ff,912345,2"),
        ("bssid,distanceMm,is80211mcResponder", "aa:bb:cc:dd:ee:ff,912345,false"),
        ("bssid,distanceMm,one_sided", "aa:bb:cc:dd:ee:ff,912345,true"),
    ],
)
def test_one_sided_ranging_is_refused(header: str, row: str) -> None:
    decoder = AndroidRttDecoder()

    assert decoder.feed(f"{header}\n{row}\n".encode(), 0.0) == []
    assert decoder.counts.refused == {"one-sided: the access point has no 802.11mc": 1}


@pytest.mark.parametrize(
    ("stamp", "seconds"),
    [
        ("1718000000", 1718000000.0),
        ("1718000000123", 1718000000.123),
        ("1718000000123456", 1718000000.123456),
        ("1718000000123456789", 1718000000.1234567),
    ],
)
def test_a_stamp_without_a_unit_is_read_where_it_is_a_date(stamp: str, seconds: float) -> None:
    (reading,) = AndroidRttDecoder(ONE).feed(f"timestamp,range_m\n{stamp},4.5\n".encode(), 0.0)

    assert reading.device_time_s == pytest.approx(seconds, abs=1e-6)


def test_a_stamp_since_boot_has_no_unit_and_the_time_of_arrival_counts() -> None:
    (reading,) = AndroidRttDecoder(ONE).feed(b"timestamp,range_m\n123456,4.5\n", 0.0)

    assert reading.device_time_s is None


def test_a_unit_in_the_column_s_name_or_in_the_options_comes_first() -> None:
    text = b"rangingTimestampMillis;mac;distance_m\n123456;AA:BB:CC:DD:EE:FF;4.5\n"
    (named,) = AndroidRttDecoder().feed(text, 0.0)
    assert named.device_time_s == pytest.approx(123.456)
    assert named.emitter == "aa:bb:cc:dd:ee:ff"

    (reading,) = AndroidRttDecoder(
        AndroidRttOptions(time_unit="us", unit="m", single_emitter=True)
    ).feed(b"timestamp,dist\n5000000,4.5\n", 0.0)
    assert reading.device_time_s == pytest.approx(5.0)


def test_a_row_before_any_header_and_a_torn_one_are_refused() -> None:
    decoder = AndroidRttDecoder()

    assert decoder.feed((ROW + ANDROID + ROW[:30] + "\n").encode(), 0.0) == []
    assert decoder.counts.refused == {
        "row without a header that has a distance": 1,
        "row of 4 cells below a header of 9": 1,
    }


def test_the_header_can_be_reported_for_a_file_that_is_followed_from_its_end() -> None:
    (reading,) = AndroidRttDecoder(AndroidRttOptions(header=ANDROID.strip())).feed(
        ROW.encode(), 0.0
    )

    assert reading.range_m == pytest.approx(5.430)
    with pytest.raises(ConfigError, match="no column of it is a distance"):
        AndroidRttDecoder(AndroidRttOptions(header="time,bssid"))


def test_a_header_may_come_again_with_other_columns() -> None:
    text = ANDROID + ROW + 'bssid,"range_m"\n"aa:bb:cc:dd:ee:01","7.5"\n'
    first, second = AndroidRttDecoder().feed(text.encode(), 0.0)

    assert (first.range_m, second.range_m) == (5.43, 7.5)


def printed(**changed: object) -> str:
    """A result as `RangingResult.toString` has it."""
    values = {
        "status": 0,
        "mac": "aa:bb:cc:00:00:01",
        "peerHandle": "<null>",
        "distanceMm": 5430,
        "distanceStdDevMm": 120,
        "rssi": -61,
        "numAttemptedMeasurements": 8,
        "numSuccessfulMeasurements": 7,
        "lci": "[1, 0, 8]",
        "lcr": "null",
        "timestamp": 81_234,
        **changed,
    }
    return "RangingResult: [" + ", ".join(f"{key}={value}" for key, value in values.items()) + "]"


def test_a_result_torn_in_its_distance_is_no_shorter_one() -> None:
    torn = printed().partition("30, distanceStdDevMm")[0]

    assert AndroidRttDecoder().feed(f"{torn}\n".encode(), 0.0) == []


def test_results_in_a_log_are_millimetres_of_each_access_point() -> None:
    other = printed(mac="aa:bb:cc:00:00:02", distanceMm=-310, distanceStdDevMm=0)
    decoder = AndroidRttDecoder()

    first, second = decoder.feed(f"06-01 D/Rtt: [{printed()}, {other}]\n".encode(), 0.0)

    assert (first.emitter, first.range_m, first.range_sigma_m) == ("aa:bb:cc:00:00:01", 5.43, 0.12)
    assert first.quality == pytest.approx(7 / 8)
    assert (second.emitter, second.range_m) == ("aa:bb:cc:00:00:02", -0.31)
    assert second.range_sigma_m is None


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"status": 1}, "status is a failure"),
        ({"status": 2}, "one-sided: the access point has no 802.11mc"),
        ({"is80211mcMeasurement": "false"}, "one-sided: the access point has no 802.11mc"),
        ({"numSuccessfulMeasurements": 0}, "no measurement succeeded"),
        ({"distanceMm": "x"}, "range_mm is not a number"),
    ],
)
def test_a_result_in_a_log_that_is_none_is_refused(changed: dict[str, object], reason: str) -> None:
    decoder = AndroidRttDecoder()

    assert decoder.feed(f"{printed(**changed)}\n".encode(), 0.0) == []
    assert decoder.counts.refused == {reason: 1}


@pytest.mark.parametrize(
    ("row", "delimiter"),
    [
        ("10:11:12.345 , aa:bb:cc:dd:ee:ff, 5.25", ","),
        ("2026-01-02 10:11:12.345 ; aa:bb:cc:dd:ee:ff; 5.25", ";"),
        ("1767348672.123456 aa:bb:cc:dd:ee:ff 5.25", " "),
    ],
)
def test_a_time_that_is_a_column_is_no_stamp(row: str, delimiter: str) -> None:
    options = FtmCsvOptions(columns=("_", "emitter", "range_m"), delimiter=delimiter)
    (reading,) = FtmCsvDecoder(options).feed(row.encode() + b"\n", 0.0)
    assert (reading.emitter, reading.range_m) == ("aa:bb:cc:dd:ee:ff", 5.25)
