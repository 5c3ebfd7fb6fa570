"""Lines as other firmware, locales, terminals and loggers print them: no value is silently wrong.

Shapes are those of public logs with a unit, a line end, a prefix or a field changed.
"""

from __future__ import annotations

import math

import pytest

from tests.typed_radio import Typed

ESP = "I (393564) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters"
QORVO = (
    "SESSION_INFO_NTF: {session_handle=1, sequence_number=7, block_index=7, n_measurements=1"
    ' [mac_address=0x0001, status="SUCCESS", distance[cm]=245]}'
)
BY_TAG = r"lines:pattern='(?P<emitter>\w+):(?P<range_cm>\d+),'@/dev/x"
IN_M, IN_MM = (rf"lines:pattern='d=(?P<range_{u}>[\d.]+)'@/dev/x" for u in ("m", "mm"))
PREAMBLE = (
    "[RAPROC] 1.9 Initiating RA procedure with preamble 9, energy 51.0 dB, delay 6 start symbol"
)
ANSWER = "Generating RA-Msg2 DCI, RAPID 9, timing_offset = 6 (estimated distance 468.8 [m])"


@pytest.mark.parametrize(
    ("radio", "printed", "ranges_m"),
    [
        (IN_M, "d=3.21\rd=4.21\r", [4.21]),
        (IN_M, "\x1b[0;32md=3.21\x1b[0m\r\n", [3.21]),
        (r"lines:pattern='^d=(?P<range_m>[\d.]+)m$'@/dev/x", "\x1b[1md=3.21m\x1b[0m\n", [3.21]),
        (IN_M, "12:00:01.123 [INFO] uwb: d=3.25 m quality=2\n", [3.25]),
        (IN_M, "d=3.25 (m)\n", [3.25]),
        (IN_M, "d=3.25 (s=0.1)\n", [3.25]),
        (IN_M, "d=3.25,45\n", [3.25]),
        (r"lines:pattern='d=(?P<range_mm>\d+),'@/dev/x", "d=3250,45\n", [3.25]),
        (r"lines:pattern='d=(?P<range_m>[\d.e+-]+)'@/dev/x", "d=1.2e1\n", [12.0]),
        (r"lines:pattern='d=(?P<range_mm_hex>\w+)'@/dev/x", "d=0x4d2\n", [1.234]),
        (BY_TAG, "a:320,b:430,\n", [3.2, 4.3]),
        ("esp32_ftm@/dev/x", f"12:00:01.5 -> {ESP}\r", [5.07]),
        ("esp32_ftm@/dev/x", f"{ESP}, RSSI: -55\n", [5.07]),
        ("android_rtt@file:r.csv", "bssid,distance_mm\raa:bb:cc:00:00:01,5430\r", [5.43]),
        (
            "android_rtt@file:r.csv",
            "ssid,bssid,distance_mm\nRange,aa:bb:cc:00:00:01,5430\nx,aa:bb:cc:00:00:02,6430\n",
            [5.43, 6.43],
        ),
        (
            "android_rtt@file:r.csv",
            "bssid,distance_mm,status\naa:bb:cc:00:00:01,5430,STATUS_SUCCESS\n"
            "aa:bb:cc:00:00:02,6430,OK\naa:bb:cc:00:00:03,7430,FAIL\n",
            [5.43, 6.43],
        ),
        ("pans@/dev/x", "\x1b[1mDIST,1,AN0,0EA1,0.00,0.00,0.00,2.97\x1b[0m\r\n", [2.97]),
        ("pans@/dev/x", "DIST,2,AN1,0EA2,0,0,0,3.10,AN0,0EA1,0,0,0,2.97\n", [2.97, 3.1]),
        (
            "trek1000@/dev/x",
            "MC 05 00000663 0 0\rMC 01 00000663" + 3 * " 000005A3" + " 095F C1 0024F3A0 a1:0\r",
            [1.635],
        ),
        (
            "makerfabs_at@/dev/x",
            "AT+RANGE=tid:1,mask:03,seq:12,range:(123,456,0,0),rssi:(78,6,0,0)\n",
            [1.23, 4.56],
        ),
        ("qorvo_cli@/dev/x", QORVO.replace(" [", "\r [") + "\r", [2.45]),
        ("qorvo_cli@/dev/x", QORVO.replace(" [", "\n\r [") + "\r\n", [2.45]),
        ("bu01@/dev/x", "an0:1.23m\nan1:4,56m\nan2:123cm\nan3: 0.00m\n", [1.23]),
        ("bu03@/dev/x", "\x1b[Kdistance: 1.234\rdistance: 1,234\r", [1.234]),
        (
            "ndjson@stdin:",
            '{"emitter_id":1,"range":3.2}\r{"emitter_id":2,"range":4.2}\r',
            [3.2, 4.2],
        ),
        ("oai:numerology=0@file:g.log", f"{PREAMBLE}\n{ANSWER}\n", [6 * 78.0711]),
    ],
)
def test_a_variant_of_a_line_has_its_value(radio: str, printed: str, ranges_m: list[float]) -> None:
    typed = Typed(radio, printed)

    assert sorted(typed.ranges_m) == pytest.approx(ranges_m, abs=0.01), typed.lines


@pytest.mark.parametrize(
    ("radio", "printed", "reason"),
    [
        (IN_M, "d=3,21 m\n", "before digits"),
        (IN_MM, "d=1,234 mm\n", "before digits"),
        (IN_M, "d=3.2 (ft)\n", "followed by `ft`"),
        (IN_M, "d=3.2[cm]\n", "followed by `cm`"),
        (IN_M, "d=320   cm\n", "followed by `cm`"),
        (
            r"lines:pattern='rtt=(?P<rtt_ns>[\d.]+)'@/dev/x",
            "rtt=0.48 \u00b5s\n",
            "followed by `us`",
        ),
        (r"lines:pattern='(?P<azimuth_deg>[-\d.]+)'@/dev/x", "az=\u221210.2\n", "the sign"),
        (r"lines:pattern='(?P<range_m>[\d.]+)'@/dev/x", "12:00:01.1 d=3.25\n", "several matches"),
        (BY_TAG, "a:320,a:330,\n", "several matches"),
        (r"lines:pattern='(?P<range_m>[\d.]+) m'@/dev/x", "v 3.25 m/s\n", "followed by `m/s`"),
        (IN_M, "d=1'234.5 m\n", "before digits"),
        (IN_M, "d=3.2%\n", "followed by `percent`"),
        (IN_M, "d=3.2in\n", "followed by `in`"),
        (IN_MM, "d=32 \u043c\n", "followed by `\u043c`"),
        ("ftm_csv:columns=[emitter,range_m]@/dev/x", "7,3,2\n", "decimal comma?"),
        ("ftm_csv:columns=[emitter,range_m]@/dev/x", "7;3,2\n", "1 line not recognised"),
        (r"lines:pattern='(?P<range_mm_hex>[0-9]+)'@/dev/x", "d 05a3\n", "part of a longer"),
        (r"lines:pattern='(?P<range_mm_hex>[0-9a-f]+)'@/dev/x", "range\n", "part of a longer"),
        (IN_M, "d=1.2e1\n", "part of a longer number"),
        (r"lines:pattern='d=(?P<range_m>[-\w.]+)'@/dev/x", "d=-1\n", "range_min_m"),
        ("android_rtt@file:r.csv", "bssid,distance_mm\naa:bb:cc:00:00:01,\n", "without a distance"),
        ("android_rtt@file:r.csv", "bssid,distance_mm\naa:bb:cc:00:00:01,NaN\n", "is no number"),
        ("oai:numerology=1@file:g.log", f"{PREAMBLE}\n{ANSWER}\n", "log is of numerology 0"),
        (
            "qorvo_cli@/dev/x",
            QORVO.replace("[cm]=245", "[mm]=2450, loc_az=10.0") + "\n",
            "not in cm",
        ),
        (
            "doppler@/dev/x",
            '{"signal_present":false,"bearing":12.3,"raw":12.1,"confidence":0.9,"snr_db":3,'
            '"bearing_uncertainty_deg":null,"x":1}\n',
            "no signal",
        ),
        (
            "lora_gateway:unnamed=number@udp:127.0.0.1:1700",
            '{"rxpk":[{"rssi":20,"lsnr":5.0,"stat":1,"data":"QAQDAgEAAQABqqqqqqo="}]}',
            "no power",
        ),
        ("rssi:unnamed=number@exec:x", "Address: c4:7c:8d:00:00:01, RSSI: 61\n", "not negative"),
        (
            "trek1000@/dev/x",
            "mr 01 00000663" + 3 * " 000005a3" + " 095f c1 0024f3a0 a0:0\n",
            "1 line or frame understood, no measurement",
        ),
        ("pans@/dev/x", "POS,1.0,2.0,0.5,80\n", "understood, no measurement"),
        ("pans@/dev/x", "[2026-01-01 12:00:00] DIST,1,AN0,0EA1,0,0,0,2.97\n", "1 line not recog"),
        ("nlink@/dev/x", "\x00\x01\x02", "no line or frame in 3 bytes; first: 00 01 02"),
        ("nlink@/dev/x", "tag 7 -> 3.2 m\n", "no line or frame in 15 bytes; first: tag 7 -> 3.2 m"),
    ],
)
def test_a_variant_that_cannot_be_read_says_why(radio: str, printed: str, reason: str) -> None:
    typed = Typed(radio, printed)

    assert not typed.newest, typed.lines
    assert reason in typed.head


@pytest.mark.parametrize(
    ("printed", "power_dbm"),
    [
        ("Address: c4:7c:8d:00:00:01, RSSI: -61\n", -61.0),
        ("[bluetooth]# \r\x1b[K[CHG] Device C4:7C:8D:00:00:01 RSSI: -61\r\n", -61.0),
        ("\x1b[32m[CHG]\x1b[0m Device C4:7C:8D:00:00:01 RSSI: 0xffffffc3 (-61)\r", -61.0),
    ],
)
def test_a_variant_of_a_scan_has_its_power(printed: str, power_dbm: float) -> None:
    typed = Typed("rssi:unnamed=number@exec:x", printed)

    (measurement,) = typed.newest.values()
    assert measurement.power_dbm == pytest.approx(power_dbm), typed.lines
    assert "not recognised" not in typed.head


def test_a_line_end_cut_in_two_ends_one_line() -> None:
    typed = Typed(IN_M, "d=3.2\r")
    for piece in (b"\n", b"", b"d=4.2", b"\r", b"\nd=5.2\r\n"):
        typed.stage.receive(piece or b"\r", 0.6)

    assert math.isclose(typed.ranges_m[0], 5.2)
    assert typed.stage.decoder.counts.unrecognised == 0
