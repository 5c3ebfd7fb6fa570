"""Devices that print received powers, and cells on board that report the timing advance.

Powers come from scans, a sniffer, LoRa gateways, and a detector of pulses. Sources: `iw dev ...
scan` on a Raspberry Pi; BlueZ 5.65 `btmon`; ESP32 promiscuous sketches; Semtech packet forwarder,
PROTOCOL.TXT sections 3.2 and 4 (PUSH_DATA, rxpk); ChirpStack 4, uplink event; The Things Stack,
"Data Formats"; DonLakeFlyer/MavlinkTagController2, `pulse_detector.py`.

The cells are srsRAN 4G, srsRAN Project and OAI. The timing advance is the round-trip time, in steps
that are cut off downwards where the random access channel measures it: 16 Ts (78.07 m) in LTE, half
of that in NR at 30 kHz. A phone is identified by the temporary identity of its attachment.

Sources: 3GPP TS 36.213 4.2.3 and TS 38.213 4.2; the logs' formats as srsRAN_4G, srsRAN Project and
OpenAirInterface print them.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from typing import ClassVar

from sim_link.emulators.emulator import (
    LIGHT_MPS,
    SIMULATION_BEGAN_S,
    U32,
    Answer,
    Emulator,
    LineEmulator,
    RangeLines,
    Round,
    clamped,
    lines,
    mac_of,
    round_trip_s,
)

CHANNEL_NOISE_DBM = -117.0
"""Noise of a LoRa channel of 125 kHz: -174 dBm/Hz, 51 dB of bandwidth, 6 dB of the receiver."""
MAX_SNR_DB = 14.0
"""Signal-to-noise ratio at which the SX1301 saturates."""
PULSE_NOISE_DBM = -150.0
GATEWAY_EUI = "AA555A0000000101"


class WifiScan(LineEmulator):
    """`iw dev wlan0 scan`, one channel again and again."""

    name = "wifi_scan"
    title = "Linux iw, scan of access points"
    names = "{mac}"
    rate_hz = 4.0

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:
        """Return a block for an access point."""
        return [
            f"BSS {mac_of(answer.emitter_id)}(on wlan0)",
            f"\tlast seen: {self.device_s(asked.sent_at_s):.3f}s [boottime]",
            "\tTSF: 0 usec (0d, 00:00:00)",
            "\tfreq: 2437",
            "\tbeacon interval: 100 TUs",
            f"\tsignal: {round(answer.power_dbm):.2f} dBm",
            f"\tlast seen: {round(1e3 * asked.lag_s)} ms ago",
            "\tSSID: phone",
            "\tCountry: DE\tEnvironment: Indoor/Outdoor",
            "\t\tChannels [1 - 13] @ 20 dBm",
        ]


class BleScan(LineEmulator):
    """`btmon` during a scan of Bluetooth advertisements."""

    name = "ble_scan"
    title = "BlueZ btmon, advertisements"
    names = "{mac_capitals}"
    rate_hz = 5.0
    banner = lines(["Bluetooth monitor ver 5.65"])

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:  # noqa: ARG002
        """Return an event for an advertisement."""
        power_dbm = round(answer.power_dbm)
        return [
            f"> HCI Event: LE Meta Event (0x3e) plen 40    #{self.next_number()} [hci0] 35.351116",
            "      LE Advertising Report (0x02)",
            "        Num reports: 1",
            f"        Address: {mac_of(answer.emitter_id).upper()} (Static)",
            "        Data length: 28",
            "        TX power: 5 dBm",
            f"        RSSI: {power_dbm} dBm (0x{power_dbm & 0xFF:02x})",
        ]


class Esp32Sniffer(LineEmulator):
    """An ESP32 in promiscuous mode, a line for each frame of management."""

    name = "esp32_sniffer"
    title = "ESP32 promiscuous mode, PACKET TYPE lines"
    names = "{mac}"

    def lines_of(self, answer: Answer, asked: Round) -> list[str]:  # noqa: ARG002
        """Return a probe request of a device."""
        to_all = "ff:ff:ff:ff:ff:ff"
        return [
            f"PACKET TYPE=MGMT, CHAN=06, RSSI={round(answer.power_dbm):02d}, ADDR1={to_all}, "
            f"ADDR2={mac_of(answer.emitter_id)}, ADDR3={to_all}"
        ]


def heard_by_gateway(power_dbm: float) -> tuple[int, float]:
    """Return the power of the channel and the signal to noise ratio, as a gateway reports them."""
    channel_mw = 10.0 ** (0.1 * power_dbm) + 10.0 ** (0.1 * CHANNEL_NOISE_DBM)
    snr_db = min(power_dbm - CHANNEL_NOISE_DBM, MAX_SNR_DB)
    return round(10.0 * math.log10(channel_mw)), round(snr_db, 1)


class LoraForwarder(Emulator):
    """Semtech's packet forwarder: PUSH_DATA datagrams, a packet in each."""

    name = "lora_forwarder"
    title = "LoRa gateway, Semtech packet forwarder"
    names = "260B{0:04X}"
    rate_hz = 1.0

    def encode(self, asked: Round) -> bytes:
        """Return a datagram for each packet."""
        return b"".join(self._datagram(answer, asked) for answer in asked.heard)

    def _datagram(self, answer: Answer, asked: Round) -> bytes:
        rssi_dbm, snr_db = heard_by_gateway(answer.power_dbm)
        address = struct.pack("<I", 0x260B0000 | answer.emitter_id)
        count = struct.pack("<H", self.next_number(1 << 16))
        payload = b"\x40" + address + b"\x00" + count + b"\x01" + bytes(9)
        packet = {
            "tmst": round(1e6 * self.device_s(asked.sent_at_s)) % U32,
            "chan": 2,
            "rfch": 0,
            "freq": 868.5,
            "stat": 1,
            "modu": "LORA",
            "datr": "SF7BW125",
            "codr": "4/5",
            "rssi": rssi_dbm,
            "lsnr": snr_db,
            "size": len(payload),
            "data": base64.b64encode(payload).decode(),
        }
        token = self._rng.bytes(2)
        head = b"\x02" + token + b"\x00" + bytes.fromhex(GATEWAY_EUI)
        return head + json.dumps({"rxpk": [packet]}, separators=(",", ":")).encode()


class ChirpStack(Emulator):
    """ChirpStack's uplink events, a line each as an MQTT subscriber prints them."""

    name = "chirpstack"
    title = "ChirpStack 4, uplink events"
    names = "02000000000{0:05x}"
    rate_hz = 1.0

    def encode(self, asked: Round) -> bytes:
        """Return a line for each packet."""
        events = [self._event(answer) for answer in asked.heard]
        return "".join(json.dumps(each, separators=(",", ":")) + "\n" for each in events).encode()

    def _event(self, answer: Answer) -> dict[str, object]:
        rssi_dbm, snr_db = heard_by_gateway(answer.power_dbm)
        return {
            "deduplicationId": "3ac7e3c4-4401-4b8d-9386-a5c902f9202d",
            "deviceInfo": {
                "deviceName": "tag",
                "devEui": self.name_on_wire(answer.emitter_id),
                "tags": {},
            },
            "devAddr": "00189440",
            "fCnt": self.next_number(1 << 16),
            "data": "qmNg",
            "rxInfo": [{"gatewayId": GATEWAY_EUI.lower(), "rssi": rssi_dbm, "snr": snr_db}],
            "txInfo": {"frequency": 868100000},
        }


class TheThingsStack(ChirpStack):
    """The Things Stack's uplink messages."""

    name = "things_stack"
    title = "The Things Stack, uplink messages"

    def _event(self, answer: Answer) -> dict[str, object]:
        rssi_dbm, snr_db = heard_by_gateway(answer.power_dbm)
        gateway = {
            "gateway_ids": {"gateway_id": "on-the-vehicle", "eui": GATEWAY_EUI},
            "rssi": rssi_dbm,
            "channel_rssi": rssi_dbm,
            "snr": snr_db,
        }
        return {
            "end_device_ids": {
                "device_id": "tag",
                "dev_eui": self.name_on_wire(answer.emitter_id).upper(),
            },
            "uplink_message": {"f_cnt": self.next_number(1 << 16), "rx_metadata": [gateway]},
        }


class Uavrt(Emulator):
    """A detector of a pulsed VHF tag: twelve float64 for each pulse."""

    name = "uavrt"
    title = "UAV-RT pulses, datagrams of the detector"
    rate_hz = 1.0
    epoch_s = SIMULATION_BEGAN_S
    FREQUENCY_HZ: ClassVar[float] = 146_000_000.0
    CONFIRMED: ClassVar[float] = 2.0

    def encode(self, asked: Round) -> bytes:
        """Return a datagram for each pulse."""
        return b"".join(self._pulse(answer, asked) for answer in asked.heard)

    def _pulse(self, answer: Answer, asked: Round) -> bytes:
        start_s = self.device_s(asked.sent_at_s)
        snr_db = answer.power_dbm - PULSE_NOISE_DBM
        group = (float(self.next_number(1 << 16)), 0.0, snr_db)
        head = (float(answer.emitter_id), self.FREQUENCY_HZ, start_s, start_s + 1.0, snr_db, 1e2)
        return struct.pack("<12d", *head, *group, self.CONFIRMED, 1.0, 1e-9)


LTE_STEP_M = 0.5 * LIGHT_MPS * 16.0 / (15_000.0 * 2048.0)
NR_STEP_M = 0.5 * LTE_STEP_M
"""Step at a subcarrier spacing of 30 kHz."""
FRAMES, SUBFRAMES = 1024, 10
"""Number after which the counters wrap: 10.24 s."""
PREAMBLES = 64


def steps_of(range_m: float, step_m: float) -> int:
    """Return whole steps of the timing advance; never negative."""
    return max(0, int(range_m // step_m))


def rach_line(tti: int, preamble: int, offset: int, crnti: int) -> str:
    """Return the console and MAC log of srsRAN 4G."""
    return (
        f"RACH:  tti={tti}, cc=0, pci=1, preamble={preamble}, offset={offset}, "
        f"temp_crnti=0x{crnti:x}"
    )


class Srsran4g(RangeLines):
    """An LTE cell: a line whenever a phone is made to attach."""

    name = "srsran_4g"
    title = "srsRAN 4G, RACH lines"
    rate_hz = 2.0
    names = "0x{0:x}"
    first = 0x46
    ids = range((1 << 16) - first)
    banner = lines(["", "==== eNodeB started ===", "Type <t> to view trace"])

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:
        """Return that its random access was heard, and that it is connected."""
        tti = clock_ms % (FRAMES * SUBFRAMES)
        offset, crnti = steps_of(range_m, LTE_STEP_M), self.first + answer.emitter_id
        preamble = int(self._rng.integers(PREAMBLES))
        return [rach_line(tti, preamble, offset, crnti), f"User 0x{crnti:x} connected"]


class Srsran(Emulator):
    """NR cell whose timing advance loop is off, so that the remainder is the whole advance."""

    name = "srsran"
    title = "srsRAN Project, metrics of the remote control"
    rate_hz = 1.0
    first = 17_921
    ids = range((1 << 16) - first)
    epoch_s = SIMULATION_BEGAN_S

    def encode(self, asked: Round) -> bytes:
        """Return a report with all phones; a timing advance of 0.0 was not observed."""
        ues = [self._ue(number, answer) for number, answer in enumerate(asked.answers)]
        cell = {"cell_metrics": {"pci": 1}, "ue_list": ues}
        report = {"timestamp": round(self.device_s(asked.sent_at_s), 3), "cells": [cell]}
        return (json.dumps(report, separators=(",", ":")) + "\n").encode()

    def _ue(self, number: int, answer: Answer) -> dict[str, object]:
        ta_ns = 0.0 if answer.range_m is None else round(1e9 * round_trip_s(answer.range_m), 1)
        return {"ue": number, "pci": 1, "rnti": self.first + answer.emitter_id, "ta_ns": ta_ns}


class Oai(RangeLines):
    """An NR cell at 30 kHz: two lines for each random access, which name no phone.

    The second one, of 2024 and later, has the distance; steps are rounded to the nearest.
    """

    name = "oai"
    title = "OpenAirInterface gNB, RAPROC lines"
    names = ""
    rate_hz = 2.0
    most = 1

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> list[str]:
        """Return both lines of a phone that was heard."""
        subframe = clock_ms % (FRAMES * SUBFRAMES)
        when = f"{subframe // SUBFRAMES}.{2 * (subframe % SUBFRAMES) + 1}"
        delay = max(0, round(range_m / NR_STEP_M))
        preamble = int(self._rng.integers(PREAMBLES))
        energy = clamped(10.0 * (answer.power_dbm + 120.0), 1, 999)
        return [raproc_line(when, preamble, energy, delay), msg2_line(when, preamble, delay)]


def raproc_line(when: str, preamble: int, energy_tenths: int, delay: int) -> str:
    """Return a line of the gNB's MAC log."""
    energy = f"{energy_tenths // 10}.{energy_tenths % 10}"
    return (
        f"[RAPROC] {when} Initiating RA procedure with preamble {preamble}, energy {energy} dB "
        f"(I0 120, thres 120), delay {delay} start symbol 0 freq index 0"
    )


def msg2_line(when: str, preamble: int, delay: int) -> str:
    """Return the MAC log of a gNB of 2024 and later; its metres are those of 3e8 m/s."""
    distance_m = 3e8 / 2.0 * 16.0 / 30.72e6 / 2.0 * delay
    return (
        f"[NR_MAC] UE 4f1c: {when} Generating RA-Msg2 DCI, RA RNTI 0x10b, state 1, CoreSetType 0, "
        f"RAPID {preamble}, timing_offset = {delay} (estimated distance {distance_m:.1f} [m])"
    )
