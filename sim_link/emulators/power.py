"""Devices that print received powers alone: a Bluetooth scan, an access point scan, a gateway.

No range can be made of it; it is here to be refused by name.

Sources: zephyr `samples/bluetooth/observer`; `iw dev ... scan`; Semtech packet forwarder,
PROTOCOL.TXT section 4 (rxpk); sandeepmistry/arduino-LoRa `LoRaReceiver`.
"""

from __future__ import annotations

from sim_link.emulators.emulator import Answer, Emulator, Round, lines, mac_of


class PowerScan(Emulator):
    """Lines of four kinds of receivers, alternately."""

    name = "rssi_scan"
    title = "scans and gateways that print received powers alone"
    names = "{mac_capitals}"
    gives = "power"
    rate_hz = 5.0

    def encode(self, asked: Round) -> bytes:
        """Return the lines of each kind about an emitter."""
        return lines([line for answer in asked.heard for line in self._lines(answer)])

    def _lines(self, answer: Answer) -> list[str]:
        dbm, mac = round(answer.power_dbm), mac_of(answer.emitter_id).upper()
        kinds = (
            [f"Device found: {mac} (random) (RSSI {dbm}), type 0, AD data len 29"],
            [f"\tsignal: {dbm:.2f} dBm"],
            [f'{{"rxpk":[{{"chan":2,"freq":868.1,"rssi":{dbm},"lsnr":5.1,"size":23}}]}}'],
            [f"Received packet 'hello 12' with RSSI {dbm}"],
        )
        return kinds[self.next_number(len(kinds))]
