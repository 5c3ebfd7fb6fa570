from __future__ import annotations

import pytest

from companion.radios.wifi_ftm import Esp32FtmDecoder, Esp32FtmOptions, IwFtmDecoder, IwFtmOptions

IDF = """\
ets Jul 29 2019 12:21:46\xf0\x1b[0;32mI (301) boot: ESP-IDF v5.2\x1b[0m
Requesting FTM session with Frm Count - 32, Burst Period - 200mSec (0: No Preference)
W wifi:Starting FTM session with 7c:df:a1:e8:05:ed in 0.084 Sec
W (393564) wifi:FTM session ends with 26 valid readings out of 31, Avg raw RTT: 49.218 nSec, \
Avg RSSI: -1
\x1b[0;32mI (393564) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters\x1b[0m
"""
IW = """\
wdev 0x1 (phy #0): Peer measurements (cookie 1):
  Peer aa:bb:cc:dd:ee:01: status=0 (SUCCESS) @3250511642082 tsf=0
    FTM
      BURST_INDEX: 0
      NUM_BURSTS_EXP: 0
      BURST_DURATION: 0
      FTMS_PER_BURST: 0
      RSSI_AVG: 4294967246
      RSSI_SPREAD: 0
      RTT_AVG: 48877
      RTT_VARIANCE: 3814209
      RTT_SPREAD: 3906
wdev 0x1 (phy #0): peer measurement complete
"""
IW_MAIL = """\
wdev 0x1 (phy #0): Peer measurements (cookie 2):
  Peer 50:e4:e0:e0:d8:30: status=0 (SUCCESS) @833087291004 tsf=0
    FTM
      RSSI_AVG: 4294967249
      RTT_AVG: 88982
      RTT_VARIANCE: 1763414
      RTT_SPREAD: 3523
      LCI:
        0000  01 00 08 00 10 00 00 00

wdev 0x1 (phy #0): peer measurement complete
"""
IW_FAILED = """\
wdev 0x1 (phy #0): Peer measurements (cookie 3):
  Peer 70:3a:cb:be:85:cc: status=3 (FAILURE) @305699895518 tsf=0
    FTM failed: NO_RESPONSE (1) retry after 2s
wdev 0x1 (phy #0): peer measurement complete
"""


def test_a_result_of_the_idf_has_its_session_s_peer_time_and_quality() -> None:
    for text in (IDF, IDF.replace("\n", "\r\n")):
        (reading,) = Esp32FtmDecoder().feed(text.encode("latin-1"), 0.0)

        assert reading.range_m == 5.07
        assert reading.device_time_s == pytest.approx(393.564)
        assert reading.emitter == "7c:df:a1:e8:05:ed"
        assert reading.quality == pytest.approx(26 / 31)


def test_a_result_without_a_session_names_no_emitter() -> None:
    result = IDF.splitlines()[-1].encode() + b"\n"
    (reading,) = Esp32FtmDecoder().feed(result, 0.0)

    assert reading.emitter is None
    assert reading.quality is None


def test_the_configured_emitter_stands_where_the_log_is_not_to_name_it() -> None:
    (reading,) = Esp32FtmDecoder(Esp32FtmOptions(emitter_from_log=False)).feed(IDF.encode(), 0.0)

    assert reading.emitter is None


def test_a_session_s_quality_is_not_that_of_the_next() -> None:
    result = IDF.splitlines()[-1] + "\n"
    first, second = Esp32FtmDecoder().feed((IDF + result).encode(), 0.0)

    assert first.quality is not None
    assert second.quality is None


@pytest.mark.parametrize(
    ("line", "range_m"),
    [
        ("FTM Estimate: Distance: 27.60 m, Return Time: 184 ns", 27.60),
        ("FTM Estimate: Distance: 0.13 m, Return Time: 0 ns", 0.13),
    ],
)
def test_arduino_says_a_distance_without_a_time(line: str, range_m: float) -> None:
    (reading,) = Esp32FtmDecoder().feed(line.encode() + b"\r\n", 0.0)

    assert reading.range_m == range_m
    assert reading.device_time_s is None


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("FTM procedure with Peer(7c:df:a1:e8:05:ed) failed! (Status - 4)", "status 4 (failed)"),
        ("FTM procedure timed out!", "timed out"),
        ("E wifi:No valid FTM Measurements found!", "no valid measurements"),
        ("W wifi:Start time delay too high! 4227 Sec", "start is too late"),
        ("FTM Error: FAIL", "the radio says that it failed"),
        (
            "I (9) ftm_station: Estimated RTT - 0 nSec, Estimated Distance - 0.00 meters",
            "distance 0: the radio cannot say less",
        ),
        (
            "I (9) ftm_station: Estimated RTT - 4294967290 nSec, "
            "Estimated Distance - 42949670.95 meters",
            "distance is out of bounds",
        ),
    ],
)
def test_what_the_esp32_says_of_failures_is_counted_by_reason(line: str, reason: str) -> None:
    decoder = Esp32FtmDecoder()

    assert decoder.feed(line.encode() + b"\n", 0.0) == []
    assert decoder.counts.refused == {reason: 1}


def test_the_table_of_frames_and_boot_text_belong_to_nothing() -> None:
    decoder = Esp32FtmDecoder()
    noise = "FTM Report:\n| Diag |   RTT   |       T1 |  RSSI  |\n| 12 | INVALID | 0 | -60 |\n"

    assert decoder.feed(noise.encode() + b"\xff\x00rst:0x1 (POWERON)\n", 0.0) == []
    assert not decoder.counts.refused
    assert decoder.counts.resync_bytes > 80


def test_a_lost_line_forgets_whose_session_it_was() -> None:
    decoder = Esp32FtmDecoder()
    decoder.feed(IDF.encode(), 0.0)
    decoder.reset()
    (reading,) = decoder.feed(IDF.splitlines()[-1].encode() + b"\n", 0.0)

    assert reading.emitter is None


@pytest.mark.parametrize(
    ("text", "peer", "range_m", "sigma_m", "time_s"),
    [
        (IW, "aa:bb:cc:dd:ee:01", 7.326, 0.293, 3250.511642082),
        (IW_MAIL, "50:e4:e0:e0:d8:30", 13.338, 0.199, 833.087291004),
    ],
    ids=["wifi-ftm", "mail"],
)
def test_a_run_of_iw_is_a_range(
    text: str, peer: str, range_m: float, sigma_m: float, time_s: float
) -> None:
    (reading,) = IwFtmDecoder(IwFtmOptions(min_sigma_m=0.0)).feed(text.encode(), 0.0)

    assert reading.emitter == peer
    assert reading.range_m == pytest.approx(range_m, abs=5e-4)
    assert reading.range_sigma_m == pytest.approx(sigma_m, abs=5e-4)
    assert reading.device_time_s == pytest.approx(time_s)


def test_the_spread_inside_a_burst_is_not_believed_to_be_all() -> None:
    (reading,) = IwFtmDecoder().feed(IW.encode(), 0.0)

    assert reading.range_sigma_m == 0.5


def test_a_round_trip_may_be_negative() -> None:
    (reading,) = IwFtmDecoder().feed(IW.replace(" 48877", " -4000").encode(), 0.0)

    assert reading.range_m == pytest.approx(-0.5996, abs=1e-4)


def test_one_run_after_another_and_several_peers_are_read() -> None:
    decoder = IwFtmDecoder()
    readings = decoder.feed((IW + IW_FAILED + IW_MAIL + IW).encode(), 0.0)

    assert [reading.emitter for reading in readings] == [
        "aa:bb:cc:dd:ee:01",
        "50:e4:e0:e0:d8:30",
        "aa:bb:cc:dd:ee:01",
    ]
    assert decoder.counts.refused == {"no response": 1}


def test_distances_stand_where_there_is_no_round_trip_and_attempts_are_a_quality() -> None:
    text = IW.replace("RTT_AVG: 48877", "DIST_AVG: 7326").replace(
        "RTT_VARIANCE: 3814209", "DIST_VARIANCE: 1000000\n      SOMETHING_NEW: 3"
    )
    text = text.replace("BURST_INDEX: 0", "NUM_FTMR_ATTEMPTS: 8\n      NUM_FTMR_SUCCESSES: 6")
    (reading,) = IwFtmDecoder().feed(text.encode(), 0.0)

    assert reading.range_m == pytest.approx(7.326)
    assert reading.range_sigma_m == pytest.approx(1.0)
    assert reading.quality == pytest.approx(0.75)


def test_a_peer_without_data_is_refused() -> None:
    decoder = IwFtmDecoder()
    text = "\n".join(IW.splitlines()[:2]) + " - no data!\nwdev 0x1: peer measurement complete\n"

    assert decoder.feed(text.encode(), 0.0) == []
    assert decoder.counts.refused == {"no distance": 1}


def test_the_newest_firmware_s_refusal_is_no_reading() -> None:
    decoder = IwFtmDecoder()

    assert decoder.feed(b"command failed: Operation not supported (-95)\n", 0.0) == []


@pytest.mark.parametrize(
    ("line", "range_m"),
    [
        (
            "I (51234) rover: FTM session complete. Estimated RTT - 41 nSec,"
            " Estimated Distance - 6.28 meters",
            6.28,
        ),
        ("FTM Estimate: Distance RAW: 4512.0000,Distance: 5.1200 m, Return Time: 301 ns", 5.12),
        ("FTM Estimate: Distance RAW: 4512, Distance: -1.3800 m, Return Time: 301 ns", -1.38),
    ],
)
def test_words_of_a_sketch_before_the_distance_do_not_hide_it(line: str, range_m: float) -> None:
    (reading,) = Esp32FtmDecoder().feed(f"{line}\n".encode(), 0.0)
    assert reading.range_m == range_m
