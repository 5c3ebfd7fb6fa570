"""Lines of real radios as a user types them: the right value, or a reason that helps.

Lines have the shape of public logs; numbers and addresses are changed.
"""

from __future__ import annotations

import math

import pytest

from companion.config.radios import flown_radios, radio_setups
from companion.errors import ConfigError
from companion.flight_setup import radio_links
from tests.typed_radio import Typed

NO_DELAY = "RACH:  tti=9241, preamble=31, offset=11, temp_crnti=0x4a\n"
OAI = (
    "[NR_PHY]   [RAPROC] 183.19 Initiating RA procedure with preamble 21, energy 51.0 dB "
    "(I0 0, thres 120), delay 5 start symbol 0 freq index 0\n"
    "[NR_MAC]   UE 5f1c: 184.7 Generating RA-Msg2 DCI, RA RNTI 0x10b, state 1, CoreSetType 0, "
    "RAPID 21, timing_offset = 5 (estimated distance 390.6 [m])\n"
)
GNB_OLD = OAI.splitlines(keepends=True)[0]


@pytest.mark.parametrize(
    ("radio", "printed", "ranges_m"),
    [
        ("srsran_4g:offset_steps=11@file:enb.log", NO_DELAY, [39.04]),
        ("oai@file:gnb.log", OAI, [390.35]),
        ("oai:offset_steps=4@file:gnb.log", OAI, [78.07]),
        ("oai:numerology=1@file:gnb.log", GNB_OLD + GNB_OLD, [5.5 * 39.0355]),
        (
            "android_rtt@file:rtt.csv",
            "Timestamp,AP MAC Address,Distance (mm),Std Dev (mm),RSSI\n"
            "1718000000123,aa:bb:cc:00:00:01,5430,120,-61\n"
            "1718000000125,aa:bb:cc:00:00:02,9430,110,-63\n",
            [5.43, 9.43],
        ),
        ("android_rtt:unit=mm@file:r.csv", "bssid,distance\naa:bb:cc:00:00:01,6120\n", [6.12]),
        ("android_rtt@file:r.csv", "time,AP1 RTT(mm),AP2 RTT(mm)\n1,4500,7250\n", [4.5, 7.25]),
        (
            r"lines:pattern='mc [0-9a-f]{2} (?P<range_mm_hex>[0-9a-f]{8})'@/dev/ttyACM0",
            "mc 0f 00000663 000005a3 00000512\n",
            [1.635],
        ),
        (r'lines:pattern="d: (?P<range_m>\d+\.\d+), @ ok"@/dev/ttyACM0', "d: 3.25, @ ok\n", [3.25]),
        (r"lines:pattern=d=(?P<range_cm>\d+);@/dev/ttyACM0", "d=325;\n", [3.25]),
        (
            "makerfabs_at@/dev/ttyUSB0",
            "AT+RANGE=tid:1,mask:02,seq:7,range:(0,245,0,0),rssi:(0.00,-71.20,0.00,0.00)\n",
            [2.45],
        ),
        (
            "pans@/dev/ttyACM0",
            "DIST,1,AN0,022E,0.00,0.00,0.00,3.44,POS,nan,nan,nan,0\n",
            [3.44],
        ),
        ("sx1280@/dev/ttyUSB0", "[SX1280] Distance:\t\t\t12.34 meters (raw)\n", [12.34]),
        (
            "qorvo_cli@/dev/ttyACM0",
            '{"Block":3948, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":71,"LPDoA_deg":0.00,'
            '"LAoA_deg":0.00,"LFoM":0,"RAoA_deg":0.00,"CFO_100ppm":622},'
            '{"Addr":"0x0002","Status":"Err"}]}\n',
            [0.71],
        ),
        (
            r"lines:pattern='from: (?P<emitter>\w+)\s+Range: (?P<range_m>-?[\d.]+) m'@/dev/x",
            "from: 1786\t Range: 3.25 m\t RX power: -78.21 dBm\n",
            [3.25],
        ),
        (r"lines:pattern='(?P<rtt_ns>[\d.]+)'@/dev/x", "rtt 49.2 nSec\n", [7.375]),
        (r"lines:pattern='r=(?P<range_m>\S+) s='@/dev/x", "r=4.5 s=0.1\n", [4.5]),
        (r"lines:pattern='d=(?P<range_m>[\d.]+)'@/dev/x", "lat-d=4.5, 17\n", [4.5]),
        ("android_rtt@file:r.csv", "\ufeffbssid,distance_mm\naa:bb:cc:00:00:01,5430\n", [5.43]),
        ("android_rtt@file:r.csv", "bssid;distance_mm\naa:bb:cc:00:00:01;5430\n", [5.43]),
        ("android_rtt@file:r.csv", "mac,rangeCm\naa:bb:cc:00:00:01,543\n", [5.43]),
        ("android_rtt@file:r.csv", "bssid,distance (ft)\naa:bb:cc:00:00:01,17.8\n", [5.425]),
        ("android_rtt@file:r.csv", "bssid,Distance [km]\naa:bb:cc:00:00:01,0.0543\n", [54.3]),
        (
            "esp32_ftm@/dev/ttyUSB0",
            "I (12:01:33.120) ftm: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters\n",
            [5.07],
        ),
        (
            "trek1000@/dev/ttyACM0",
            "mc 01 0000066F 000005A3 00000512 000004FE 0958 C0 40424042 a0:0\n",
            [1.647],
        ),
        ("bu01@/dev/ttyUSB0", "an0: 1.23 m an1: 2.34 m\n", [1.23, 2.34]),
        ("ftm_csv@/dev/ttyUSB0", "1234|82|-61\n", [12.34]),
        ("ftm_csv:columns=[emitter,range_cm],delimiter=;@/dev/ttyUSB0", "7;1234\n", [12.34]),
        ("ftm_csv@/dev/ttyUSB0", "2,33,49,507,2,33120,-61,1,2,3,4,33980,-60,1,2,3,4,\n", [5.07]),
        (
            "esp32_ftm@/dev/ttyUSB0",
            "\x1b[0;32mI (39) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 "
            "meters\x1b[0m\n",
            [5.07],
        ),
    ],
)
def test_a_line_has_the_value_that_its_radio_measured(
    radio: str, printed: str, ranges_m: list[float]
) -> None:
    typed = Typed(radio, printed)

    assert sorted(typed.ranges_m) == pytest.approx(ranges_m, abs=0.01), typed.lines


@pytest.mark.parametrize(
    ("radio", "printed", "reason"),
    [
        ("oai@file:gnb.log", GNB_OLD, "numerology is unknown: set it"),
        ("oai:numerology=1@file:gnb.log", OAI.splitlines()[1] + "\n", "log is of numerology 0"),
        (
            "srsran_4g:log=phy@file:enb.log",
            "PRACH: 0/1, preamble=40, offset=88.1 us, peak2avg=801.0, max_offset=30.0 us\n",
            "offset is beyond max_offset",
        ),
        ("android_rtt@file:r.csv", "distance_mm,rssi\n5430,-61\n", "no emitter column known"),
        ("android_rtt@file:r.csv", "bssid,distance\naa:bb:cc:00:00:01,5430\n", "no unit"),
        (
            "android_rtt@file:r.csv",
            "a,b,c,bssid,distance_mm,d,e,f,g,h,i\n1,2,3,aa:bb:cc:00:00:01,5430,1,2,3,4\n",
            "row of 9 cells below a header of 11",
        ),
        (
            r"lines:pattern='mc [0-9a-f]{2} (?P<range_mm>\w+)'@/dev/ttyACM0",
            "mc 0f 00000663 000005a3\nmc 0f 6e2 000005a3\n",
            "may be hexadecimal",
        ),
        (
            "esp32_ftm@/dev/ttyUSB0",
            "W (1) wifi:FTM session ends with 1 valid readings out of 31, Avg raw RTT: 490 nSec\n"
            "I (9) ftm_station: Estimated RTT - 481 nSec, Estimated Distance - 72.14 meters\n",
            "too little quality",
        ),
        ("sx1280@/dev/ttyUSB0", "[SX1280] Distance: 370096288.00 meters (raw)\n", "beyond every"),
        ("sx1280@/dev/ttyUSB0", "[SX1280] Distance: 0.00 meters (raw)\n", "exactly 0"),
        ("lines:pattern='(?P<range_mm>[0-9]+)mm'@/dev/x", "0x1, 4294967295mm\n", "all bits set"),
        ("lines:pattern='(?P<range_mm>[0-9]+)mm'@/dev/x", "0x1, 0mm\n", "exactly 0"),
        (
            "ndjson@udp:127.0.0.1:5005",
            '{"emitter_id":1,"azimuth":-10.2,"elevation":1.20}\n',
            "key `azimuth` is of another format",
        ),
        ("ndjson@stdin:", '{"bearing":45}\n{"bearing":1.2}\n', "angles of this stream"),
        ("ndjson@stdin:", '{"emitter_id":1,"range":12.5,"unit":"ft"}\n', "range is in metres"),
        (
            "qorvo_cli@/dev/ttyACM0",
            "SESSION_INFO_NTF: {session_handle=1, block_index=1, n_measurements=1\n"
            ' [mac_address=0x0001, status="SUCCESS", distance[cm]=65535]}\n',
            "all bits set",
        ),
        (
            "pdoa_js@/dev/ttyACM0",
            'JS003D{"TWR": {"a16":"2E5C","R":3,"T":8605,"D":65535,"Xcm":0,"Ycm":0}}\n',
            "all bits set",
        ),
        (
            "makerfabs_at@/dev/ttyUSB0",
            "AT+RANGE=tid:1,mask:01,seq:7,range:(65535,0,0,0),rssi:(0.00,0.00,0.00,0.00)\n",
            "no slot answered",
        ),
        ("ryuw122@/dev/ttyUSB0", "+ANCHOR_RCV=DAVID123,5,HELLO,65535 cm\n", "all bits set"),
        ("pozyx@/dev/ttyACM0", "12345ms, 4294967295mm, -83dBm\n", "all bits set"),
        (r"lines:pattern='az.*?(?P<azimuth_deg>[\d.]+)'@/dev/x", "azimuth: -45.2\n", "the sign"),
        (r"lines:pattern='d=(?P<range_m>\d+)'@/dev/x", "d=3.25\n", "part of a longer number"),
        (r"lines:pattern='(?P<range_m>[\d.]+) m'@/dev/x", "d 3,25 m\n", "part of a longer number"),
        (r"lines:pattern='(?P<range_mm>\d+)'@/dev/x", "1234ms, 5678mm\n", "followed by `ms`"),
        (r"lines:pattern='d=(?P<range_m>\d+)'@/dev/x", "d=327 cm\n", "followed by `cm`"),
        (r"lines:pattern='d=(?P<range_m>[\d.]+)'@/dev/x", "d=12.5ft\n", "followed by `ft`"),
        (r"lines:pattern='d=(?P<range_m>[\d.]+)'@/dev/x", "d=12.5 yards\n", "followed by `yards`"),
        (r"lines:pattern='d=(?P<range_m>[\d.]+)'@/dev/x", "d=12.5'\n", "followed by `'`"),
        (r"lines:pattern='p=(?P<power_dbm>[\d.-]+)'@/dev/x", "p=-6.5 dB\n", "followed by `db`"),
        (r"lines:pattern='p=(?P<power_dbm>[\d.-]+)'@/dev/x", "p=-61 mW\n", "followed by `mw`"),
        (r"lines:pattern='RSSI.*?(?P<power_dbm>\d+)'@/dev/x", "RSSI: -61\n", "the sign"),
        (
            r"lines:pattern='d=(?P<range_m>[\d,]+)'@/dev/x",
            "d=3,25 m\n",
            "a decimal point is needed",
        ),
        (r"lines:pattern='d=(?P<range_m>\S+)'@/dev/x", "d=nan\n", "is not a number"),
        (
            "android_rtt@file:r.csv",
            "bssid;distance_m\naa:bb:cc:00:00:01;5,43\n",
            "a decimal point is needed",
        ),
        (
            "android_rtt@file:r.csv",
            "bssid,distance_mm\naa:bb:cc:00:00:01,5,430\n",
            "row of 3 cells below a header of 2",
        ),
        ("bu03@/dev/ttyUSB0", "distance: 1.23 cm\n", "followed by `cm`"),
        ("ryuw122@/dev/ttyUSB0", "+ANCHOR_RCV=DAVID123,5,HELLO,1.20 m\n", "torn line"),
        (
            "makerfabs_at@/dev/ttyUSB0",
            "AT+RANGE=tid:1,mask:02,seq:7,range:(0,2.45,0,0),rssi:(0,0,0,0)\n",
            "not a whole number of centimetres",
        ),
        ("ndjson@stdin:", '{"range":12.5,"range_unit":"ft"}\n', "range is in metres"),
        ("ndjson@stdin:", '{"bearing":-0.785,"bearing_std":5}\n', "bearing is in radians"),
        ("ndjson@stdin:", '{"emitter_id":1,"rssi_dbm":-61}\n', "a power is power_dbm"),
        ("ndjson@stdin:", '{"emitter_id":1,"power_dbm":61}\n', "power is not within"),
        (
            "trek1000@/dev/ttyACM0",
            "mc 01 ffffffff 000005a3 00000512 000004fe 0958 c0 40424042 a0:0\n",
            "beyond every radio",
        ),
        (
            "kraken@http://127.0.0.1:8081",
            "1718000000000, 218, 61.3, -21.4, 433.92, UCA, 403.2, S1, 0.0, 0.0, 0, 0, GPS, R, R, R,"
            " R\n",
            "frequency is out of bounds",
        ),
        (
            "oai:numerology=0@file:gnb.log",
            GNB_OLD.replace("delay 5", "delay 65535"),
            "timing advance is out of bounds",
        ),
        (
            "esp32_ftm@/dev/ttyUSB0",
            "I (9) ftm_station: Estimated RTT - 0 nSec, Estimated Distance - 42949672.95 meters\n",
            "distance is out of bounds",
        ),
    ],
)
def test_what_cannot_be_a_value_is_refused_by_a_reason_that_helps(
    radio: str, printed: str, reason: str
) -> None:
    typed = Typed(radio, printed)

    assert not typed.ranges_m
    assert not typed.newest
    assert reason in typed.head


SCAN = "BSS c4:7c:8d:00:00:01(on wlan0)\n\tsignal: -64.00 dBm\n\tlast seen: 120 ms ago\n"
UPLINK = (
    '{"deviceInfo":{"devEui":"0101010101010101"},"rxInfo":[{"gatewayId":"aa","rssi":-57,'
    '"snr":30}]}\n'
)
PULSE = (
    "Conf: 1 Id:  2 snr:  21.3 heading: 123.0 stft_score: 1e+02 noise_psd: 1e-09 freq: 146000000\n"
)


@pytest.mark.parametrize(
    ("radio", "printed", "power_dbm"),
    [
        ("rssi:emitters={C4:7C:8D:00:00:01: 1}@exec:iw dev wlan0 scan", SCAN, -64.0),
        ("rssi:unnamed=number@exec:btmon", "[CHG] Device C4:7C:8D:00:00:01 RSSI: -61\n", -61.0),
        ("rssi:single_emitter=true@/dev/ttyUSB0", "Received packet 'x' with RSSI -61\n", -61.0),
        ("rssi:single_emitter=true,power_offset_db=3@/dev/ttyUSB0", "RSSI: -61\n", -58.0),
        ("lora_gateway:unnamed=number@udp:127.0.0.1:1700", UPLINK, -57.0),
        ("uavrt@file:controller.log", PULSE, 21.3 - 150.0),
        ("ndjson@stdin:", '{"emitter_id":1,"power_dbm":-61.0}\n', -61.0),
        (r"lines:pattern='(?P<emitter>\w+) (?P<power_dbm>-\d+)dBm'@/dev/x", "t1 -61dBm\n", -61.0),
        ("ftm_csv:columns=[emitter,power_dbm]@/dev/x", "02:00:00:00:00:07,-61\n", -61.0),
        (
            r"lines:pattern='snr (?P<power_db>[\d.-]+)',power_offset_db=-117@/dev/x",
            "snr -6.5 dB\n",
            -123.5,
        ),
    ],
)
def test_a_received_power_is_read(radio: str, printed: str, power_dbm: float) -> None:
    typed = Typed(radio, printed)

    (measurement,) = typed.newest.values()
    assert measurement.power_dbm == pytest.approx(power_dbm, abs=0.05), typed.lines


def test_devices_of_a_scan_are_shown_until_one_is_listed() -> None:
    typed = Typed(
        "rssi@exec:iw dev wlan0 scan", SCAN + SCAN.replace("-64", "-40").replace("1(", "2(")
    )

    assert not typed.newest
    assert typed.lines[-1] == (
        "  not in `emitters`: c4:7c:8d:00:00:02 (-40 dBm), c4:7c:8d:00:00:01 (-64 dBm)"
    )


def test_few_valid_readings_of_a_session_widen_the_sigma() -> None:
    ends = "W (1) wifi:FTM session ends with {} valid readings out of 31, Avg raw RTT: 9.2 nSec\n"
    result = "I (9) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters\n"

    for valid, sigma_m in ((5, 2.8), (8, 2.0), (16, 1.4), (29, 1.0)):
        typed = Typed("esp32_ftm@/dev/ttyUSB0", ends.format(valid) + result)
        assert typed.newest[1].range_sigma_m == pytest.approx(sigma_m)


POWERS = [
    "Device found: C4:7C:8D:00:00:01 (random) (RSSI -61), type 0, AD data len 29",
    "[CHG] Device C4:7C:8D:00:00:01 RSSI: -61",
    "        RSSI: -61 dBm (0xc3)",
    "\tsignal: -61.00 dBm",
    "          Quality=49/70  Signal level=-61 dBm",
    "12:01:33.120 1.0 Mb/s 2437 MHz 11b -61dBm signal antenna 1 Probe Request (home)",
    "PACKET TYPE=MGMT, CHAN=06, RSSI=-61, ADDR1=ff:ff:ff:ff:ff:ff, ADDR2=c4:7c:8d:00:00:01",
    "Received packet 'hello 12' with RSSI -61",
    "[SX1276] RSSI:\t\t-61.00 dBm",
    '{"rxpk":[{"tmst":3512348611,"chan":2,"freq":866.3,"rssi":-35,"lsnr":5.1,"size":32}]}',
    '{"emitter_id":"c4:7c:8d:00:00:01","power_dbm":-61.0}',
    "Conf: 1 Id:  2 snr:  21.3 heading: 123.0 stft_score:   1e+02 noise_psd: 1e-09 freq: 146000000",
]


@pytest.mark.parametrize("radio", ["ndjson@stdin:", "esp32_ftm@/dev/ttyUSB0", "sx1280@/dev/x"])
@pytest.mark.parametrize("line", POWERS)
def test_a_received_power_alone_is_refused_by_that_reason(radio: str, line: str) -> None:
    typed = Typed(radio, f"{line}\n")

    if radio.startswith("ndjson") and "power_dbm" in line:
        assert [m.power_dbm for m in typed.newest.values()] == [-61.0]
        return
    assert not typed.newest
    if radio.startswith("ndjson") and "rssi" in line and line.startswith("{"):
        assert "a power is power_dbm" in typed.head
    elif radio.startswith("ndjson") and not line.startswith("{"):
        assert "not a JSON object" in typed.head or "not JSON" in typed.head
    else:
        assert "received power only" in typed.head


@pytest.mark.parametrize(
    "line",
    [
        "tag 7: dist 3.25 RSSI -70",
        "RSSI: -70 dBm, 3.2 m",
        "bearing 120 snr 12",
        "angle=12 rssi=-60",
    ],
)
def test_a_power_beside_a_range_or_an_angle_is_a_format_that_is_not_known(line: str) -> None:
    typed = Typed("esp32_ftm@/dev/ttyUSB0", f"{line}\n")

    assert typed.head.endswith(f"1 line not recognised; first: {line}")


@pytest.mark.parametrize("group", ["rssi", "snr_db"])
def test_a_level_is_named_as_a_power_or_refused(group: str) -> None:
    with pytest.raises(ConfigError, match="name it power_dbm"):
        radio_setups(flown_radios((), [f"lines:pattern='RSSI (?P<{group}>.*)'@/dev/ttyUSB0"]))


def test_a_frame_whose_layout_is_not_published_is_named() -> None:
    frame = bytes((0x55, 0x0B, 34, 0)) + bytes(range(29))
    typed = Typed("nlink@/dev/ttyUSB0", "")
    typed.stage.receive(frame + bytes((sum(frame) & 0xFF,)), 0.5)

    assert [*typed.stage.all_refused] == [
        "NodeFrame7: its layout is not published; choose AOA_NodeFrame0 in NAssistant"
    ]


@pytest.mark.parametrize("radio", ["nlink", "esp32_ftm", "pans", "kraken", "makerfabs_at"])
def test_lines_in_no_format_are_counted_and_the_first_is_shown(radio: str) -> None:
    typed = Typed(f"{radio}@/dev/ttyUSB0", "dist tag 7 -> 3.2 m\r\n\r\n[12:01:33] tick\r\n")

    words = "2 lines not recognised; first: dist tag 7 -> 3.2 m"
    if radio == "nlink":
        words = "no line or frame in 40 bytes; first: dist tag 7 -> 3.2 m"
    assert typed.head.endswith(words)
    assert typed.words.endswith(words)


def test_what_is_asked_each_period_is_an_option_and_a_period_alone_is_refused() -> None:
    asked = "lines:pattern='(?P<range_mm>[0-9]+)mm',request='D,1',poll_s=0.5@/dev/ttyUSB0"
    (setup,) = radio_setups(flown_radios((), [asked]))

    assert setup.kind.decoder(setup.options).request() == b"D,1\r\n"
    assert setup.settings.poll_s == 0.5
    with pytest.raises(ConfigError, match="nothing is polled at /dev/ttyUSB0"):
        radio_links(flown_radios((), [asked.replace("request", "hello")]))


def test_an_open_quote_or_a_bare_comma_is_named() -> None:
    with pytest.raises(ConfigError, match="needs quotes"):
        flown_radios((), [r"lines:pattern=(?P<range_m>\d+),\d@/dev/ttyUSB0"])


def test_a_full_turn_of_degrees_does_not_pass_as_radians() -> None:
    degrees = "".join(f'{{"bearing":{value}}}\n' for value in range(-179, 180, 7))
    typed = Typed("ndjson@stdin:", degrees)

    assert sum(typed.stage.all_refused.values()) == len(range(-179, 180, 7))
    assert not math.isnan(typed.stage.received_s or math.nan)


def test_a_radio_whose_offset_must_be_calibrated_is_named_as_uncalibrated() -> None:
    assert "uncalibrated: range offset unknown" in Typed("srsran_4g@file:enb.log", NO_DELAY).head
    known = Typed("srsran_4g:offset_steps=11@file:enb.log", NO_DELAY)
    assert "uncalibrated" not in known.head
