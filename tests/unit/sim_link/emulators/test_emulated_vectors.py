"""Observed output of real radios, built by the emulators byte for byte."""

from __future__ import annotations

import pytest

from sim_link.emulators.bearings import KrakenDirection, uudf_line
from sim_link.emulators.nlink import (
    ANCHOR,
    TAG,
    Node,
    NodeState,
    Peer,
    aoa_frame,
    iot_frame,
    node_frame2,
    node_frame3,
    node_frame5,
)
from sim_link.emulators.power import rach_line
from sim_link.emulators.printed_lines import sx1280_valid
from sim_link.emulators.uwb_binary import (
    pans_anchor,
    pans_location,
    session_info,
    sr150_frame,
    uci_record,
)
from sim_link.emulators.uwb_text import (
    at_range,
    dist_line,
    js_frame,
    qorvo_record,
    session_info_ntf,
)
from sim_link.emulators.wifi import (
    arduino_estimate,
    esp_estimate,
    esp_log,
    esp_session,
    iw_burst,
    iw_failure,
    rtt_row,
)


def of_hex(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


PEERS = (
    Peer(0, 2.850, -90.5, -79.5),
    Peer(1, 6.051, -91.0, -80.0),
    Peer(2, 7.304, -85.0, -79.5),
    Peer(3, 5.350, -92.0, -80.0),
)


def test_nooploop_prints_ranges_and_angles() -> None:
    node = Node(0, 160_702, 0, 4.847, TAG, of_hex("00 00 f1 06"))
    record = (
        (0, 0.767, 28.50, -81.5, -79.5),
        (1, 0.770, 1.73, -82.0, -79.5),
        (2, 1.004, 9.71, -82.5, -80.0),
        (3, 1.416, -49.67, -81.5, -80.0),
    )
    peers = [Peer(i, m, fp, rx, left, role=ANCHOR) for i, m, left, fp, rx in record]
    vector = (
        "55 07 42 00 02 00 be 73 02 00 00 00 00 00 00 00 f1 06 ef 12 04 01 00 ff 02 00 22 0b "
        "a3 9f 9e 00 01 01 02 03 00 ad 00 a4 9f 00 00 01 02 ec 03 00 cb 03 a5 a0 00 00 01 03 "
        "88 05 00 99 ec a3 a0 00 00 33"
    )
    first = peers[0]
    peers[0] = Peer(0, first.range_m, first.fp_dbm, first.rx_dbm, 28.50, reserved=b"\x9e\x00")
    assert aoa_frame(node, peers) == of_hex(vector)


def test_nooploop_prints_ranges() -> None:
    vector = (
        "55 05 32 00 02 01 f8 11 07 00 6f d0 6e 00 00 00 01 02 5a 13 04 01 00 22 0b 00 b5 9f "
        "01 01 a3 17 00 b6 a0 01 02 88 1c 00 aa 9f 01 03 e6 14 00 b8 a0 9a"
    )
    node = Node(1, 463_352, 7_262_319, 4.954, TAG, of_hex("00 00 01 02"))
    assert node_frame3(node, PEERS) == of_hex(vector)
    vector = (
        "55 08 41 00 02 01 00 00 00 f8 11 07 00 6f d0 6e 00 00 00 01 02 5a 13 04 01 00 00 00 "
        "00 22 0b 00 b5 9f 01 01 00 00 00 a3 17 00 b6 a0 01 02 00 00 00 88 1c 00 aa 9f 01 03 "
        "00 00 00 e6 14 00 b8 a0 ac"
    )
    assert node_frame5(node, PEERS) == of_hex(vector)


def test_nooploop_prints_place_and_ranges() -> None:
    text = (
        "55 04 ac 00 02 01 ba 66 1d 00 06 09 ff de 0a 00 df ff ff e8 03 00 fa ff ff 1a 00 00 "
        "00 00 00 c0 12 00 00 00 00 00 00 00 27 ac e2 3c 56 ed 1c 3c d2 70 3b bd 32 57 66 3e "
        "3b cb 1b 41 93 70 61 bd 25 b2 6b 41 a1 22 6c 41 da da 6b 41 6d 23 e9 23 70 dd db f7 "
        "30 3f 5f d6 31 3f ba 81 1e 3e 47 69 e2 bd 91 9b 40 40 c5 23 00 00 40 40 5c d5 1c 00 "
        "00 00 1d 00 6d 13 04 01 00 6b 0c 00 b1 9f a6 66 1d 00 16 45 01 01 ac 15 00 b4 a1 a6 "
        "66 1d 00 d3 01 01 02 48 1a 00 ca 9f a6 66 1d 00 38 ba 01 03 2b 12 00 c6 a0 a6 66 1d "
        "00 64 40 25"
    )
    vector = of_hex(text)
    node = Node(1, 9_157, 1_926_842, 4.973, TAG)
    position_m, velocity_mps = (2.782, -0.033, 1.000), (-0.0006, 0.0026, 0.0)
    motion = NodeState(b"\x06\x09\xff", position_m, velocity_mps, vector[31:102], vector[106:116])
    record = (
        (0, 3.179, -88.5, -79.5, "16 45"),
        (1, 5.548, -90.0, -80.5, "d3 01"),
        (2, 6.728, -101.0, -79.5, "38 ba"),
        (3, 4.651, -99.0, -80.0, "64 40"),
    )
    peers = [
        Peer(i, metres, fp, rx, reserved=of_hex(rest), system_ms=1_926_822)
        for i, metres, fp, rx, rest in record
    ]
    assert node_frame2(node, motion, peers) == vector


def test_nooploop_iot_prints_azimuth_and_elevation() -> None:
    vector = (
        "6a 00 1d 00 00 4f 00 30 fa db 0b 00 00 01 00 5b 00 2f 12 01 00 a5 f0 3c 03 8f a5 00 8c"
    )
    node = Node(0x30004F00, system_ms=777_210)
    peer = Peer(0x2F005B00, 0.274, -71.5, -82.5, -39.31, 8.28)
    assert iot_frame(node, [(peer, b"")]) == of_hex(vector)


def test_fira_prints_a_round() -> None:
    record = uci_record(1, 0, 0, 235, (24.898, 100), (12.0, 95), -66.5)
    vector = (
        "62 00 00 38 07 00 00 00 2a 00 00 00 00 c8 00 00 00 01 00 00 00 00 00 00 00 00 00 00 "
        "01 01 00 00 00 eb 00 73 0c 64 00 06 5f 00 00 00 00 00 00 01 85 00 00 00 00 00 00 00 "
        "00 00 00 00"
    )
    assert session_info(7, [record]) == of_hex(vector)
    empty = "62 00 00 19 00 02 03 04 05 06 07 08 00 0a 01 01 01 01 00 00 00 00 00 00 00 00 00 00 00"
    assert session_info(0x04030200, [], 0x08070605, 0x0101010A) == of_hex(empty)


def test_an_sr150_prints_a_frame() -> None:
    vector = (
        "8e 30 00 01 00 00 00 2a 00 00 00 64 00 00 00 22 11 22 11 00 00 02 00 00 fb 80 02 00 "
        "00 00 00 5a 50 00 00 1b"
    )
    frame = sr150_frame(1, 0x1122, 0, 512, 0, -10.0, 5.0)
    assert frame == of_hex(vector)


def test_pans_answers() -> None:
    vector = (
        "40 01 00 41 0d e0 06 00 00 36 06 00 00 fe 01 00 00 28 49 29 02 2f 2f 98 08 00 00 64 "
        "ea 0b 00 00 78 0a 00 00 00 00 00 00 64 d0 2e b6 08 00 00 64 cc 0b 00 00 00 00 00 00 "
        "00 00 00 00 64"
    )
    anchors = [
        pans_anchor(0x2F2F, 2200, (3.050, 2.680, 0.0)),
        pans_anchor(0x2ED0, 2230, (3.020, 0.0, 0.0)),
    ]
    made = pans_location((1.760, 1.590, 0.510), 40, anchors)
    assert made == of_hex(vector)


def test_pans_prints_its_anchors() -> None:
    anchors = [
        ("022E", (7.94, 8.03, 0.0), 3.44),
        ("9280", (7.95, 0.0, 0.0), 5.68),
        ("DCAE", (0.0, 8.03, 0.0), 7.76),
        ("5431", (0.0, 0.0, 0.0), 8.73),
    ]
    assert dist_line(anchors, (6.95, 5.37, -1.97, 52)) == (
        "DIST,4,AN0,022E,7.94,8.03,0.00,3.44,AN1,9280,7.95,0.00,0.00,5.68,AN2,DCAE,0.00,8.03,0.00,"
        "7.76,AN3,5431,0.00,0.00,0.00,8.73,POS,6.95,5.37,-1.97,52"
    )


def test_qorvo_prints_a_session() -> None:
    record = {
        "distance[cm]": "91",
        "loc_az_pdoa": "65.35",
        "loc_az": "24.90",
        "loc_el_pdoa": "32.12",
        "loc_el": "12.01",
        "rmt_az": "22.84",
        "rmt_el": "13.59",
        "RSSI[dBm]": "-66.5",
    }
    assert session_info_ntf(0, [qorvo_record(1, record)]) == (
        "SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1\n"
        ' [mac_address=0x0001, status="SUCCESS", distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90,'
        " loc_el_pdoa=32.12, loc_el=12.01, rmt_az=22.84, rmt_el=13.59, RSSI[dBm]=-66.5]}"
    )
    two = [qorvo_record(1, {"distance[cm]": "245"}), qorvo_record(2, {}, "RX_TIMEOUT")]
    assert session_info_ntf(7, two) == (
        "SESSION_INFO_NTF: {session_handle=1, sequence_number=7, block_index=7, n_measurements=2\n"
        ' [mac_address=0x0001, status="SUCCESS", distance[cm]=245];\n'
        ' [mac_address=0x0002, status="RX_TIMEOUT"]}'
    )


def test_a_pdoa_kit_prints_its_frames() -> None:
    accelerations = {"X": 53_015, "Y": 60_972, "Z": 10_797}
    ranged = {"a16": "2E5C", "R": 3, "T": 8605, "D": 343, "P": 1695, "Xcm": 165, "Ycm": 165}
    twr = {"TWR": {**ranged, "O": 14, "V": 1, **accelerations}}
    assert js_frame(twr, after_colon=" ") == (
        'JS0076{"TWR": {"a16":"2E5C","R":3,"T":8605,"D":343,"P":1695,"Xcm":165,"Ycm":165,"O":14,'
        '"V":1,"X":53015,"Y":60972,"Z":10797}}'
    )
    service = {"SN": {"a16": "0001", "V": 0, "X": -458, "Y": -83, "Z": 876}}
    assert js_frame(service, after_colon=" ") == (
        'JS0035{"SN": {"a16":"0001","V":0,"X":-458,"Y":-83,"Z":876}}'
    )
    assert js_frame({"NewTag": "1122334455667788"}) == 'JS001D{"NewTag":"1122334455667788"}'


def test_makerfabs_prints_its_slots() -> None:
    nothing = (0,) * 8
    silence = (0.0,) * 8
    rssi_dbm = (0.0, 0.0, -77.93, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert at_range(1, 4, 63, (0, 0, 30, 0, 0, 0, 0, 0), rssi_dbm) == (
        "AT+RANGE=tid:1,mask:04,seq:63,range:(0,0,30,0,0,0,0,0),"
        "rssi:(0.00,0.00,-77.93,0.00,0.00,0.00,0.00,0.00)"
    )
    four = (997, 1321, 911, 738, 0, 0, 0, 0)
    assert at_range(7, 15, 128, four, None, (0, 1, 2, 3, -1, -1, -1, -1)) == (
        "AT+RANGE=tid:7,mask:0F,seq:128,range:(997,1321,911,738,0,0,0,0),"
        "ancid:(0,1,2,3,-1,-1,-1,-1)"
    )
    assert at_range(0, 0x80, 197, nothing, silence) == (
        "AT+RANGE=tid:0,mask:80,seq:197,range:(0,0,0,0,0,0,0,0),"
        "rssi:(0.00,0.00,0.00,0.00,0.00,0.00,0.00,0.00)"
    )


def test_an_esp32_prints_an_estimate() -> None:
    assert esp_log("I", 393_564, esp_estimate(5.07), is_coloured=False) == (
        "I (393564) ftm_station: Estimated RTT - 33 nSec, Estimated Distance - 5.07 meters"
    )
    assert esp_log("W", 393_564, esp_session(26, 31, 49.218, -1), is_coloured=False) == (
        "W (393564) wifi:FTM session ends with 26 valid readings out of 31, "
        "Avg raw RTT: 49.218 nSec, Avg RSSI: -1"
    )
    assert esp_log("E", None, "wifi:No valid FTM Measurements found!", is_coloured=False) == (
        "E wifi:No valid FTM Measurements found!"
    )


@pytest.mark.parametrize(
    ("range_m", "line"),
    [
        (27.60, "FTM Estimate: Distance: 27.60 m, Return Time: 184 ns"),
        (0.13, "FTM Estimate: Distance: 0.13 m, Return Time: 0 ns"),
    ],
)
def test_the_arduino_example_prints_a_distance(range_m: float, line: str) -> None:
    assert arduino_estimate(range_m) == line


def test_iw_prints_a_burst_and_a_failure() -> None:
    burst = iw_burst("xx:xx:xx:xx:xx:xx", 3_250_511_642_082, -50, 48_877, 3_814_209, 3_906)
    assert burst == [
        "  Peer xx:xx:xx:xx:xx:xx: status=0 (SUCCESS) @3250511642082 tsf=0",
        "    FTM",
        "      BURST_INDEX: 0",
        "      NUM_BURSTS_EXP: 0",
        "      BURST_DURATION: 0",
        "      FTMS_PER_BURST: 0",
        "      RSSI_AVG: 4294967246",
        "      RSSI_SPREAD: 0",
        "      RTT_AVG: 48877",
        "      RTT_VARIANCE: 3814209",
        "      RTT_SPREAD: 3906",
    ]
    assert iw_failure("70:3a:cb:be:85:cc", 305_699_895_518) == [
        "  Peer 70:3a:cb:be:85:cc: status=3 (FAILURE) @305699895518 tsf=0",
        "    FTM failed: NO_RESPONSE (1)",
    ]


def test_a_telephone_logs_a_row() -> None:
    bssid = "aa:bb:cc:dd:ee:ff"
    row = rtt_row(1_718_000_000_123, bssid, 5430, 120, -61, 7)
    assert row == "1718000000123,1,Lost,aa:bb:cc:dd:ee:ff,5430,120,-61,8,7"
    assert rtt_row(1_718_000_000_123, bssid).endswith(",0,0,-127,8,0")


def test_a_kraken_prints_a_direction_both_ways_round() -> None:
    found = KrakenDirection(1_718_000_000_500, 142, 61.3, -21.4, 433_920_000, 403.2)
    fields = found.row.split(", ")
    assert len(fields) == 377
    assert ", ".join(fields[:8]) == ("1718000000500, 218, 61.3, -21.4, 433920000, UCA, 403.2, S1")
    assert fields[8:17] == ["0.0", "0.0", "0", "0", "GPS", "R", "R", "R", "R"]
    assert (fields[17 + 142], fields[17 + 322]) == ("1.00", "0.00")
    assert "<DOA>142</DOA>" in found.xml
    assert "<TIME>1718000000500</TIME>" in found.xml


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            uudf_line("CCF9578E0D8A", 20, 0, -42, '-43,37,"CCF9578E0D89","",15869,23'),
            '+UUDF:CCF9578E0D8A,-42,20,0,-43,37,"CCF9578E0D89","",15869,23',
        ),
        (
            uudf_line("6C1DEBA41845", -11, 20, -56, '0,39,"6C1DEBA79D14","",746675'),
            '+UUDF:6C1DEBA41845,-56,-11,20,0,39,"6C1DEBA79D14","",746675',
        ),
        (
            rach_line(341, 12, 3, 0x46),
            "RACH:  tti=341, cc=0, pci=1, preamble=12, offset=3, temp_crnti=0x46",
        ),
        (sx1280_valid(0x47, -60), "Valid,Register,47,Distance,3.2,RSSIReg,78,RSSI,-60dBm"),
        (sx1280_valid(0x1F, -60), "Valid,Register,1F,Distance,1.4,RSSIReg,78,RSSI,-60dBm"),
    ],
)
def test_lines_are_as_they_were_seen(line: str, expected: str) -> None:
    assert line == expected
