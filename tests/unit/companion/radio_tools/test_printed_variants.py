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
AZIMUTH = r"lines:pattern='az=(?P<azimuth_deg>[\d.]+)'@/dev/x"
BESIDE_D = r"lines:pattern='d\W*(?P<range_m>[\d.]+)'@/dev/x"
WHOLE_LINE = r"lines:pattern='^d=(?P<range_m>[\d.]+)m$'@/dev/x"
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
        (WHOLE_LINE, "\x1b[1md=3.21m\x1b(B\x1b[m\n", [3.21]),
        (WHOLE_LINE, "\x1b]0;uwb\x07d=3.21m\n", [3.21]),
        (WHOLE_LINE, "\x1b[38:5:2md=3.21m\x1b[0m\n", [3.21]),
        (WHOLE_LINE, "\ufeffd=3.21m\n", [3.21]),
        (BESIDE_D, "d -> 3.2 m\n", [3.2]),
        (BESIDE_D, "d => 3.2 m\n", [3.2]),
        (r"lines:pattern='range>(?P<range_m>[\d.]+)'@/dev/x", "<range>3.2</range>\n", [3.2]),
        (IN_M, "d=3.2 m 20 dBm\n", [3.2]),
        (
            "android_rtt@file:r.csv",
            "bssid,distance_mm,is_valid\naa:bb:cc:00:00:01,5430,True\n",
            [5.43],
        ),
        ("pans@/dev/x", "\ufeffDIST,1,AN0,0EA1,0.00,0.00,0.00,2.97\n", [2.97]),
        ("ndjson@stdin:", '\ufeff{"emitter_id":1,"range":3.2}\n', [3.2]),
        (r"lines:pattern='cm.?: (?P<range_cm>\d+)'@/dev/x", '{"d_cm": 320}\n', [3.2]),
        (r"lines:pattern=': (?P<range_m>[\d.]+)'@/dev/x", "12345 ms: 3.2\n", [3.2]),
        (r"lines:pattern='\) (?P<rtt_ns>[\d.]+)'@/dev/x", "rtt (ns) 33.3\n", [4.99]),
        (IN_M, "d=3.2 success=1 errors=0 status: ok\n", [3.2]),
        ("ftm_csv:columns=[emitter,range_cm]@/dev/x", "anchor,range_cm\n7,320\n", [3.2]),
        ("ndjson@stdin:", '{"emitter_id":1,"range":3.2,"id":77,"status":"OK"}\n', [3.2]),
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
        ("android_rtt@file:r.csv", "bssid,distance_mm\naa:bb:cc:00:00:01,NaN\n", "is not a number"),
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
        ("pans@/dev/x", "tag DIST,1,AN0,0EA1,0,0,0,2.97\n", "1 line not recog"),
        (r"lines:pattern=': (?P<range_m>\d+)'@/dev/x", "Dist (cm): 320\n", "stands behind `cm`"),
        (r"lines:pattern=': (?P<range_m>\d+)'@/dev/x", '{"range_cm": 320}\n', "stands behind `cm`"),
        (r"lines:pattern=': (?P<range_m>\d+)'@/dev/x", '{"rangeMm": 3200}\n', "stands behind `mm`"),
        (r"lines:pattern=': (?P<range_m>\d+)'@/dev/x", "Range in cm: 320\n", "stands behind `cm`"),
        (r"lines:pattern='=(?P<range_m>\d+)'@/dev/x", "dist[mm]=3200\n", "stands behind `mm`"),
        (r"lines:pattern='=(?P<azimuth_deg>[\d.]+)'@/dev/x", "az_rad=1.2\n", "behind `rad`"),
        (
            r"lines:pattern='(?P<time_ms>\d+) d=(?P<range_m>[\d.]+)'@/dev/x",
            "t_us=1234567 d=3.2\n",
            "time_ms stands behind `us`",
        ),
        (r"lines:pattern='(?P<range_m>[\d.]+)'@/dev/x", "rtt (ns) 33.3\n", "stands behind `ns`"),
        (IN_MM, "d=3_250\n", "before digits"),
        (IN_MM, "d=3\uff0e2\n", "before digits"),
        (IN_MM, "d=3 250 mm\n", "part of a longer number"),
        (IN_M, "d=1.#INF\n", "part of a longer number"),
        (IN_M, "d=1.#QNAN m\n", "part of a longer number"),
        (r"lines:pattern='az=(?P<azimuth_deg>[\d.]+)'@/dev/x", "az=45.0 left\n", "a side"),
        (
            r"lines:pattern='az=(?P<azimuth_deg>[\d.]+)'@/dev/x",
            "az=45.0\N{DEGREE SIGN} W\n",
            "a side",
        ),
        (IN_M, "d=3.2 m, status=TIMEOUT\n", "says itself that it is not valid"),
        (IN_M, "d=3.2 m INVALID\n", "says itself that it is not valid"),
        (IN_M, "d=3.2 m, valid=0\n", "says itself that it is not valid"),
        (
            "ftm_csv:columns=[emitter,range_m,_]@/dev/x",
            "7,3.2,RX_TIMEOUT\n",
            "says itself that it is not valid",
        ),
        (
            "ndjson@stdin:",
            '{"emitter_id":1,"range":3.2,"valid":false}\n',
            "says itself that it is not valid",
        ),
        ("bu03@/dev/x", "distance: 655.35\n", "all bits set"),
        ("pans@/dev/x", "DIST,1,AN0,0EA1,0.00,0.00,0.00,65.535\n", "all bits set"),
        ("ndjson@stdin:", '{"emitter_id":1,"range":65535.0}\n', "all bits set"),
        ("qorvo_cli@/dev/x", QORVO.replace("=245", "=32767") + "\n", "all bits set"),
        ("ndjson@stdin:", '{"anchor":3,"range":3.2}\n', "key `anchor` may name the emitter"),
        ("ndjson@stdin:", '{"MAC":"aa:bb:cc:00:00:01","range":3.2}\n', "key `mac` may name"),
        ("ndjson@stdin:", '{"emitter_id":1,"range":320,"unit_range":"cm"}\n', "range is in metres"),
        ("ndjson@stdin:", '{"emitter_id":1,"range":320,"uom":"cm"}\n', "range is in metres"),
        ("ndjson@stdin:", '{"emitter_id":1,"range":32,"Units":{"range":"ft"}}\n', "is in metres"),
        (
            "ftm_csv:columns=[emitter,range_m]@/dev/x",
            "anchor,range_cm\n7,320\n",
            "range_m is in `cm` by the header",
        ),
        (
            "ftm_csv:columns=[emitter,range_cm]@/dev/x",
            "anchor,range (mm)\n7,3200\n",
            "range_cm is in `mm` by the header",
        ),
        (
            "pdoa_js@/dev/x",
            'JS0045{"TWR": {"a16":"2E5C","R":3,"T":8605,"D":3.43,"P":1,"Xcm":1,"Ycm":3}}\n',
            "not a whole number of centimetres",
        ),
        (
            "uudf@/dev/x",
            '+UUDF:CCF9578E0D8A,-42,0.35,0.10,-43,37,"CCF9578E0D89","",15869,23\n',
            "not a whole number of degrees",
        ),
        (
            "makerfabs_at@/dev/x",
            "AT+RANGE=tid:1,mask:03,seq:7,range:(245,991,0,0),ancid:(0,0,-1,-1)\n",
            "several ranges of one emitter",
        ),
        ("bu01@/dev/x", "an0: 1.23 m an0: 2.34 m\n", "several ranges of one emitter"),
        (
            "pans@/dev/x",
            "DIST,2,AN0,0EA1,0,0,0,2.97,AN1,0EA1,0,0,0,4.97\n",
            "several ranges of one emitter",
        ),
        ("rssi:unnamed=number@exec:x", "c4:7c:8d:00:00:01 RSSI -61 dBmV\n", "followed by `dbmv`"),
        ("rssi:unnamed=number@exec:x", "c4:7c:8d:00:00:01 RSSI: -0.61e2\n", "a longer number"),
        ("rssi:unnamed=number@exec:x", "c4:7c:8d:00:00:01 signal: -61 dB\n", "followed by `db`"),
        ("rssi:unnamed=number@exec:x", "c4:7c:8d:00:00:01 RSSI: -128\n", "below the noise"),
        (BESIDE_D, "d=>100.0 m\n", "says only a limit"),
        (BESIDE_D, "d=< 0.5 m\n", "says only a limit"),
        (BESIDE_D, "d: >= 100 m\n", "says only a limit"),
        (r"lines:pattern='d=(?P<range_ft>\d+)'@/dev/x", "d=5 ft 3 in\n", "a smaller unit"),
        (r"lines:pattern='d=(?P<range_m>\d+)'@/dev/x", "d=3 m 20 cm\n", "a smaller unit"),
        (r"lines:pattern='d=(?P<range_m>\d+)'@/dev/x", "d=3m20\n", "a smaller unit"),
        (AZIMUTH, "az=45\N{DEGREE SIGN}30'\n", "a smaller unit"),
        (AZIMUTH, "az=45 deg 30 min\n", "a smaller unit"),
        (IN_M, "d=3.2 m (stale)\n", "says itself that it is not valid"),
        (IN_M, "d=3.2 m [NO LOCK]\n", "says itself that it is not valid"),
        (IN_M, "d=999.99\n", "nines"),
        (IN_MM, "d=99999\n", "nines"),
        (
            "android_rtt@file:r.csv",
            "bssid,distance_mm,valid\naa:bb:cc:00:00:01,5430,false\n",
            "status is a failure",
        ),
        ("qorvo_cli@/dev/x", QORVO.replace("=245", "=2,45") + "\n", "torn measurement"),
        (
            "qorvo_cli@/dev/x",
            QORVO.replace("]}", '] [mac_address=0x0001, status="SUCCESS", distance[cm]=945]}\n'),
            "several ranges of one emitter",
        ),
        (
            "lora_gateway:unnamed=number@udp:127.0.0.1:1700",
            '{"deviceInfo":{"devEui":"0101010101010101"},"rxInfo":[{"gatewayId":"aa","rssi":-57,'
            '"snr":3,"crcStatus":"BAD_CRC"}]}\n',
            "wrong checksum",
        ),
        ("nlink@/dev/x", "\x00\x01\x02", "no line or frame in 3 bytes; first: 00 01 02"),
        ("nlink@/dev/x", "tag 7 -> 3.2 m\n", "no line or frame in 15 bytes; first: tag 7 -> 3.2 m"),
        (
            "ndjson@udp:127.0.0.1:1700",
            '{"emitter_id":1,"range":3.2}{"emitter_id":1,"range":3.3}',
            'no line end in 56 bytes; first: {"emitter_id":1,',
        ),
        (r"lines:pattern='p=(?P<power_dbm>\S+)'@/dev/x", "p=0\n", "power of exactly 0 dBm"),
        ("android_rtt@file:r.csv", "bssid,distance_mm\n,5430\n", "row without its emitter's name"),
        (
            "ftm_csv@/dev/x",
            ",33,35,507,2,33000,-51,1,2,3,4,34000,-52,5,6,7,8,\n",
            "row without its emitter's name",
        ),
        (
            "ftm_csv:columns=[emitter,range_cm]@/dev/x",
            ",507\n",
            "row without its emitter's name",
        ),
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


@pytest.mark.parametrize("unit_us", [1_000, 1_000_000])
def test_a_clock_that_hardly_advances_is_named(unit_us: int) -> None:
    """Milliseconds or seconds under a name in microseconds."""
    typed = Typed("ndjson@stdin:", "")
    for tenth in range(50):
        stamp = (1_718_000_000_000_000 + 100_000 * tenth) // unit_us
        line = f'{{"emitter_id":1,"time_usec":{stamp},"range":{3 + 0.01 * tenth:.2f}}}\n'
        typed.stage.receive(line.encode(), 0.6 + 0.1 * tenth)

    assert typed.stage.all_refused["time of the radio hardly advances: clock=arrival"] > 20


def test_a_clock_that_jumps_is_not_said_to_stand_still() -> None:
    typed = Typed("ndjson@stdin:", "")
    for tenth in range(100):
        stamp = 1_718_000_000_000_000 + 100_000 * tenth - (3_600_000_000 if tenth > 50 else 0)
        line = f'{{"emitter_id":1,"time_usec":{stamp},"range":{3 + 0.01 * tenth:.2f}}}\n'
        typed.stage.receive(line.encode(), 0.6 + 0.1 * tenth)

    assert not typed.stage.all_refused
