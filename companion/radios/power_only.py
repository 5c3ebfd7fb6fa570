"""Lines that report a received power and nothing that a position can be derived from.

Scans of Bluetooth and Wi-Fi, sniffers, LoRa gateways, detectors of pulses: they print how strong a
signal was. The estimator uses ranges and directions, and a power becomes neither without a path
loss model, which rubble does not have. Such lines are refused for one reason, in whatever format
they come, so that a radio of this kind is named and never silent.

Forms seen: `iw dev ... scan`, `iwlist`, `tcpdump -e` (radiotap), `hcitool`, `bluetoothctl`,
`btmon`, Zephyr's `observer`, ESP32 promiscuous sketches, receivers of RadioLib and
sandeepmistry/arduino-LoRa, Semtech's packet forwarder and ChirpStack (JSON), and the pulses of
DonLakeFlyer/MavlinkTagController2.
"""

from __future__ import annotations

import re

POWER_ONLY = "received power only: neither a range nor a direction (docs/radios.md)"

_POWER = re.compile(
    r"-\d{1,3}(?:\.\d+)? ?dBm\b"
    r"|\b(?:rssi|rss|signal|signal level|power_dbm|power_db|lsnr|snr|snr_db)\b\W{1,8}-?\d",
    re.IGNORECASE,
)
_MEASURED = re.compile(
    r"\d ?(?:m|cm|mm|km|ft|ns|ps|deg|rad|meters?)\b|\N{DEGREE SIGN}"
    r"|dist|rang|rtt|tof|bearing|azimuth|elevation|angle|doa",
    re.IGNORECASE,
)
"""Other quantities: a line with one of them is of an unknown format, and is counted as that."""


def is_power_only(line: str) -> bool:
    """Return True if a line has a received power, and no range or angle by any name."""
    return _POWER.search(line) is not None and _MEASURED.search(line) is None
