"""Received powers of scans, sniffers and detectors of pulses."""

from __future__ import annotations

import struct

import pytest

from companion.radios.power_scans import (
    NO_ADDRESS,
    PowerScanDecoder,
    PowerScanOptions,
    UavrtDecoder,
)

MAC = "c4:7c:8d:00:00:01"
TO_ALL = "ff:ff:ff:ff:ff:ff"


def scanned(text: str, *, single: bool = False) -> tuple[list[tuple[object, object]], list[str]]:
    """Emitters with their powers, and the reasons of refusals."""
    decoder = PowerScanDecoder(PowerScanOptions(single_emitter=single))
    readings = decoder.feed(text.encode(), 0.0)
    return [(each.emitter, each.power_dbm) for each in readings], [*decoder.counts.refused]


@pytest.mark.parametrize(
    ("text", "power_dbm"),
    [
        (f"BSS {MAC}(on wlan0)\n\tfreq: 2412\n\tsignal: -64.00 dBm\n\tSSID: x\n", -64.0),
        (
            f"Station {MAC} (on wlan0)\n\tsignal:  \t-61 [-63, -65] dBm\n\tsignal avg:\t-9 dBm\n",
            -61,
        ),
        (f"Connected to {MAC} (on wlan0)\n\tsignal: -48 dBm\n\trx bitrate: 6.0 MBit/s\n", -48.0),
        (f"   Cell 01 - Address: {MAC}\n   Quality=49/70  Signal level=-61 dBm  \n", -61.0),
        (f"> HCI Event: x\n    Address: {MAC.upper()} (Static)\n    RSSI: -61 dBm (0xc3)\n", -61.0),
        (f"@ MGMT Event: x\n    LE Address: {MAC} (OUI C4)\n    RSSI: -51 dBm (0xcd)\n", -51.0),
        (f"[CHG] Device {MAC.upper()} RSSI: -61\n", -61.0),
        (f"[CHG] Device {MAC} RSSI: is -61\n", -61.0),
        (f"\x1b[K[\x1b[0;93mCHG\x1b[0m] Device {MAC} RSSI: 0xffffffc3 (-61)\n", -61.0),
        (f"Device {MAC} (random)\n\tName: tag\n\tRSSI: 0xffffffc3 (-61)\n", -61.0),
        (f"Device found: {MAC.upper()} (random) (RSSI -61), type 0, AD data len 29\n", -61.0),
        (f"[DEVICE]: {MAC} (random), AD evt type 0, AD data len 29, RSSI -61\n", -61.0),
        (f"PACKET TYPE=MGMT, CHAN=06, RSSI=-61, ADDR1={TO_ALL}, ADDR2={MAC}\n", -61.0),
        (f"11b -61dBm signal -95dBm noise antenna 0 DA:{TO_ALL} SA:{MAC} Probe (x)\n", -61.0),
        (
            f"11n -61dBm signal -63dBm signal antenna 0 -88dBm signal antenna 1 SA:{MAC} Beacon\n",
            -61.0,
        ),
        (
            f"-61dBm signal -95dBm noise antenna 0 -74dBm signal antenna 1 TA:{MAC} Beacon\n",
            -61.0,
        ),
        (f"Advertised Device: Name: , Address: {MAC}, txPower: -59, rssi: -61 \n", -61.0),
        (f"{MAC}\t2437\t-61\t[WPA2-PSK-CCMP][ESS]\thome\n", -61.0),
        (f"RSSI: -61 Ch: 6 BSSID: {MAC} ESSID: Orange-Triangle-District\n", -61.0),
        (f'{{"mac":"{MAC.upper()}","rssi":-61,"ch":6}}\n', -61.0),
        (f"{MAC.replace(':', '-')} -61.5 dBm\n", -61.5),
        (f"{MAC.upper()}: tag (-61 dBm)\n", -61.0),
        (f"{MAC} RX RSSI     : -61\n", -61.0),
        (f'CSI_DATA,17,{MAC},-61,11,1,0,-95,0,6,"[1,-2]"\n', -61.0),
        (f"CSI_DATA,AP,{MAC.upper()},-61,11,1,0,-95,0,6,[1 -2]\n", -61.0),
        (f"{MAC} rxRssi=-61\n", -61.0),
        (f"{MAC} rssi -61 dBm, threshold -90 dBm\n", -61.0),
        (f"{MAC} tx power -12 dBm rssi -61\n", -61.0),
        (f"{MAC.upper()}  -61 dBm / -95 dBm (SNR 34)  20 ms ago\n", -61.0),
        (f"Access Point: {MAC}\n  Signal: -61 dBm  Noise: -95 dBm\n", -61.0),
        (f"Access Point: {MAC}   \n  Link Quality=60/70  Signal level=-61 dBm\n", -61.0),
        (f"      bdaddr {MAC.upper()} (Random)\n      RSSI: -61\n", -61.0),
        (
            f"Station {MAC} (on wlan0)\n\tsignal:  \t-61 dBm\n\tbeacon signal avg:\t-58 dBm\n"
            "\tlast ack signal:-40 dBm\n\tavg ack signal:\t-41 dBm\n",
            -61.0,
        ),
    ],
)
def test_a_power_is_of_the_device_of_its_line_or_block(text: str, power_dbm: float) -> None:
    assert scanned(text) == ([(MAC, power_dbm)], [])


@pytest.mark.parametrize(
    "whole",
    [
        "Device found: {} (random) (RSSI -61), type 0, AD data len 29\n",
        "[DEVICE]: {} (random), AD evt type 0, AD data len 29, RSSI -61\n",
        "PACKET TYPE=MGMT, CHAN=06, RSSI=-61, ADDR1=ff:ff:ff:ff:ff:ff, ADDR2={}\n",
        "-61dBm signal -95dBm noise antenna 0 DA:ff:ff:ff:ff:ff:ff SA:{} Probe (x)\n",
        "Advertised Device: Name: , Address: {}, txPower: -59, rssi: -61 \n",
        "[CHG] Device {} RSSI: -61\n",
        "{}\t2437\t-61\t[WPA2-PSK-CCMP][ESS]\thome\n",
        "{} rssi=-61\n",
    ],
)
def test_a_line_torn_into_the_next_gives_no_device_the_power_of_another(whole: str) -> None:
    other = "c4:7c:8d:00:00:02"
    torn, after = whole.format(other).replace("-61", "-40"), whole.format(MAC)
    allowed = {(MAC, -61.0), (other, -40.0), (other, -4.0)}  # a torn number is a shorter one
    for length in range(len(torn)):
        assert set(scanned(torn[:length] + after)[0]) <= allowed, torn[:length]


def test_the_age_of_a_result_is_its_own() -> None:
    text = (
        f"BSS {MAC}(on wlan0)\n\tsignal: -64.00 dBm\n\tlast seen: 120 ms ago\n"
        f"Station {MAC} (on wlan0)\n\tinactive time:\t304 ms\n\tsignal: -61 dBm\n\n"
    )
    readings = PowerScanDecoder().feed(text.encode(), 0.0)

    assert [each.age_s for each in readings] == [0.12, 0.304]


@pytest.mark.parametrize(
    "line",
    [
        "Received packet 'hello 12' with RSSI -61",
        "[SX1276] RSSI:\t\t-61.00 dBm",
        "12s,Packet,RSSI,-61dBm,SNR,9dB",
        "RSSI: -61",
        "rssi=-61",
    ],
)
def test_a_line_without_an_address_needs_a_single_emitter(line: str) -> None:
    assert scanned(line + "\n") == ([], [NO_ADDRESS])
    assert scanned(line + "\n", single=True) == ([(None, -61.0)], [])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (f"  Cell 01 - Address: {MAC}\n  Quality=49/70  Signal level=49/100\n", "is a share"),
        (f"BSS {MAC}(on wlan0)\n\tsignal: 61/100\n", "is a share"),
        ("RSSI return value: -5\n", "relative to an unknown level"),
        (f"  Address: {MAC}\n  RSSI: 127 dBm (0x7f)\n", "not negative"),
        (f"{MAC} RSSI: 61\n", "not negative"),
        (f"{MAC} RSSI: 0\n", "not negative"),
        (f"  Address: {MAC}\n  RSSI: invalid (0x99)\n", "no power"),
        (f"{MAC} RSSI: -6,1 dBm\n", "no power in dBm"),
        (f"{MAC} RSSI: -9999\n", "no power in dBm"),
        (f"{MAC} rssi -61 dBm, signal -90 dBm\n", "several powers"),
        (f"rssi=-61 from {MAC} to aa:bb:cc:dd:ee:ff\n", "several addresses"),
        ("11b -61dBm signal antenna 1 Acknowledgment RA:aa:bb:cc:dd:ee:ff\n", "sender's address"),
        ('{"rxpk":[{"rssi":-61}]}\n', "lora_gateway reads them"),
    ],
)
def test_what_is_no_power_of_one_device_is_refused_by_a_reason(text: str, reason: str) -> None:
    readings, reasons = scanned(text)

    assert readings == []
    assert reason in " ".join(reasons)


@pytest.mark.parametrize(
    "printed",
    [
        "RSSI threshold -80 dBm",
        "RSSI limit: -85 dBm",
        "RSSI cutoff (-80 dBm)",
        "min rssi -90",
        "max_rssi -40",
        "minimum RSSI: -80",
        "rssi >= -80 dBm",
        "heard again if stronger than -80 dBm",
        "devices below -80 dBm",
        "-80 dBm threshold",
        "noise floor: -95 dBm",
        "noise=-95 dBm",
        "-95 dBm noise floor",
        "background -95 dBm",
        "sensitivity -97 dBm",
        "tx power -12 dBm",
        "transmit power: -12 dBm",
        "output power: -12 dBm",
        "EIRP -10 dBm",
        "expected RSSI -60 dBm",
        "reference rssi -59",
        "calibrated power -59 dBm",
        "default signal: -63",
        "remote rssi -70",
        "min -80 avg -63 max -50 dBm",
        "TxPower: -12 dBm",
        "TXPower -12 dBm",
        "tx_power_level: -12 dBm",
        "txpwr=-12dBm",
        "measuredPower: -59 dBm",
        "NoiseFloor: -95 dBm",
        "noise_floor: -95 dBm",
        "rssiThreshold: -80 dBm",
        "minRssi: -80 dBm",
    ],
)
def test_a_setting_or_noise_beside_an_address_is_no_received_power(printed: str) -> None:
    for line in (f"{MAC} {printed}", f"{printed} {MAC}", f"scan: {MAC}, {printed}"):
        assert scanned(line + "\n")[0] == [], line
    assert scanned(f"Station {MAC} (on wlan0)\n\t{printed}\n")[0] == []
    assert scanned(f"{printed}\n", single=True)[0] == []


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        (" BSSID              PWR  Beacons    #Data, #/s  CH   MB   ENC CIPHER", "tcpdump -e"),
        (" BSSID              STATION            PWR   Rate    Lost    Frames", "tcpdump -e"),
        ("BSSID, First time seen, Last time seen, channel, Speed, Privacy", "tcpdump -e"),
        ("Station MAC, First time seen, Last time seen, Power, # packets", "tcpdump -e"),
        ("IN-USE  BSSID              SSID  MODE   CHAN  RATE  SIGNAL  BARS", "is a share"),
        ("         Signal             : 72%", "is a share"),
        ('{"mod":"ASK","freq":433.9,"rssi":-0.1,"snr":24.5,"noise":-24.6}', "full scale"),
        ("RSSI      : -0.1 dB        SNR       : 24.5 dB     Noise   : -24.6 dB", "full scale"),
    ],
)
def test_a_tool_whose_levels_are_no_use_is_named_or_replaced(printed: str, reason: str) -> None:
    readings, reasons = scanned(printed + "\n", single=True)

    assert readings == []
    assert reason in " ".join(reasons)


LORA_RX = "DEBUG | 12:00:00 18 [RadioIf] Lora RX (id=0x3d820dc9 fr=0xc0065b1b to=0xa6e7499a, "


@pytest.mark.parametrize(
    ("line", "emitter", "power_dbm"),
    [
        (
            f"{LORA_RX}WantAck=0, HopLim=3 Ch=0x8 encrypted rxSNR=-9 rxRSSI=-121 hopStart=3)",
            "0xc0065b1b",
            -121.0,
        ),
        ("+RCV=50,5,HE,LO,-121,-9", 50, -121.0),
        ("+RCV=51,5,HE+RCV=50,5,HELLO,-61,40", 50, -61.0),
        ("+EVT:RXP2P:-121:-9:48656C6C6F", None, -121.0),
        ('{"t":{"Mac":"C47C8D000001","RSSI":-61}}', "c47c8d000001", -61.0),
    ],
)
def test_a_packet_names_its_device_by_other_than_a_mac_address(
    line: str, emitter: object, power_dbm: float
) -> None:
    assert scanned(line + "\n", single=True) == ([(emitter, power_dbm)], [])


def test_a_relayed_packet_has_the_power_of_the_relay() -> None:
    line = f"{LORA_RX}WantAck=0, HopLim=2 Ch=0x8 encrypted rxSNR=5.5 rxRSSI=-71 hopStart=3)\n"
    copies = "[Router] Add packet record (id=0x3d820dc9 fr=0xc0065b1b rxSNR=5.5 rxRSSI=-71)\n"

    readings, reasons = scanned(line + copies, single=True)
    assert readings == []
    assert "relay" in " ".join(reasons)


def test_a_block_ends_where_the_next_event_begins() -> None:
    text = f"> HCI Event: a\n  Address: {MAC} (Static)\n> HCI Event: b\n  RSSI: -61 dBm (0xc3)\n"

    assert scanned(text) == ([], [NO_ADDRESS])


def test_powers_beside_distances_are_of_a_format_that_is_not_known() -> None:
    for quantity in (
        "dist 3.2",
        "d_cm=3",
        "distance_m=3",
        '"distanceMm":3200',
        "angle: 12",
        "Range=3",
    ):
        decoder = PowerScanDecoder()
        assert decoder.feed(f"{MAC} rssi -61 {quantity}\n".encode(), 0.0) == []
        assert decoder.counts.unrecognised == 1


def pulse(
    tag: float = 2.0,
    hertz: float = 146e6,
    snr: float = 21.3,
    status: float = 2.0,
    sure: float = 1.0,
) -> bytes:
    return struct.pack("<12d", tag, hertz, 1718e6, 1718e6, snr, 1, 5, 0, snr, status, sure, 1e-9)


def test_a_confirmed_pulse_is_a_power_with_its_time() -> None:
    decoder = UavrtDecoder()
    quiet = pulse(hertz=0.0) + pulse(status=3.0)

    (reading,) = decoder.feed(quiet + pulse() + pulse(sure=0.0), 0.0)
    assert (reading.emitter, reading.device_time_s, reading.power_dbm) == (2, 1718e6, 21.3)
    assert decoder.counts.frames == 4
    assert decoder.counts.refused == {"pulse is not confirmed": 1}


@pytest.mark.parametrize(
    "datagram",
    [
        pulse(tag=2.5),
        pulse(hertz=9e9),
        pulse(status=7.0),
        pulse(sure=0.5),
        pulse(tag=float("nan")),
        pulse(tag=-1.0),
    ],
)
def test_what_is_no_pulse_is_no_frame(datagram: bytes) -> None:
    decoder = UavrtDecoder()

    assert decoder.feed(datagram + pulse(), 0.0) == UavrtDecoder().feed(pulse(), 0.0)
    assert decoder.counts.resync_bytes == len(datagram)


@pytest.mark.parametrize("snr", [float("nan"), float("inf"), 1e6])
def test_a_pulse_without_an_snr_is_refused(snr: float) -> None:
    decoder = UavrtDecoder()

    assert decoder.feed(pulse(snr=snr), 0.0) == []
    assert decoder.counts.refused == {"no SNR": 1}


def test_the_controllers_log_is_read_and_its_unconfirmed_pulses_refused() -> None:
    decoder = UavrtDecoder()
    line = "[01:02:03|I]  Conf: {} Id:  3 snr:  17.5 heading: 123.0 freq: 146000000 (a.cpp:1)\n"

    (reading,) = decoder.feed((line.format(1) + line.format(0)).encode(), 0.0)
    assert (reading.emitter, reading.device_time_s, reading.power_dbm) == (3, None, 17.5)
    assert decoder.counts.refused == {"pulse is not confirmed": 1}
