"""LoRa gateways and servers: JSON of Semtech's packet forwarder, ChirpStack, The Things Stack.

Each received packet has the power of the whole channel and its signal to noise ratio, from which
the power of the signal alone follows: it is below the noise more often than not.

Sources: Lora-net/packet_forwarder PROTOCOL.TXT 3.2 and 4 (`rxpk`), Lora-net/sx1302_hal the same
(`rssis`); ChirpStack's `UplinkEvent`, versions 3 and 4; The Things Stack, "Data Formats"; LoRaWAN
L2 1.0.4 chapters 4 and 6 (addresses in a packet).
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import msgspec

from companion.domain import Params
from companion.radios.decoder import FrameDecoder, RadioKind, RadioReading

PER_S = 1e6
CLOCK_WRAP_S = 2**32 / PER_S
"""Period of the gateway's 32-bit microseconds."""
JOIN_REQUEST, DATA_UP = 0, (2, 4)
"""Message types that devices send."""


class LoraGatewayOptions(Params, frozen=True):
    """Selects the gateway on the vehicle."""

    gateway: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """Its EUI or name, where several may report the same packet."""


class LoraGatewayDecoder(FrameDecoder):
    """Decoder of packets as JSON objects, one in a datagram, a message or a line."""

    Options = LoraGatewayOptions
    options: LoraGatewayOptions
    start = re.compile(rb"\{ ?(?:\"|\Z)")
    _TOKEN = re.compile(rb"\"(?:[^\"\\\n]|\\.)*+(?:\"|(\\?\Z)|\n)|[{}\n]")
    longest_object = 32_768

    def size_at(self, data: bytes, at: int) -> int | None:
        """Return the size of the object that begins there; it has no line end in it."""
        depth, end = 0, min(len(data), at + self.longest_object)
        for token in self._TOKEN.finditer(data, at, end):
            text = token[0]
            if token[1] is not None:
                break
            if text.endswith(b"\n"):
                return 0
            depth += (text == b"{") - (text == b"}")
            if not depth:
                return token.end() - at
        return 0 if end == at + self.longest_object else None

    def read_frame(self, frame: bytes) -> list[RadioReading] | None:
        """Return a reading for each packet; None if the object is of another kind."""
        try:
            found = json.loads(frame)
        except (ValueError, RecursionError):
            return None
        if not isinstance(found, dict):
            return None
        if "rxpk" in found or "stat" in found:
            packets = found.get("rxpk", [])
            return [reading for packet in _objects(packets) for reading in self._packet(packet)]
        uplink = found.get("data", found)
        uplink = uplink if isinstance(uplink, dict) else found
        message = uplink.get("uplink_message")
        if isinstance(message, dict):
            return self._received(_thing(uplink), _objects(message.get("rx_metadata")))
        if "rxInfo" in found:
            return self._received(_device(found), _objects(found["rxInfo"]))
        return None

    def _packet(self, packet: Mapping[str, Any]) -> list[RadioReading]:
        """Return the reading of a packet of the forwarder."""
        if packet.get("stat", 1) not in (0, 1):
            self.counts.refuse("packet with a wrong checksum")
            return []
        signals = [each for each in _objects(packet.get("rsig")) if _finite(each.get("rssic"))]
        best = max(signals, key=lambda each: float(each["rssic"]), default=packet)
        power_dbm = signal_dbm(_first(best, "rssis"), None)
        if power_dbm is None:
            power_dbm = signal_dbm(_first(best, "rssi", "rssic"), _first(best, "lsnr"))
        stamp = _first(packet, "tmst")
        time_s = None if stamp is None else stamp / PER_S
        return self._reading(_sender(packet.get("data")), power_dbm, time_s)

    def _received(
        self, emitter: str | None, gateways: list[Mapping[str, Any]]
    ) -> list[RadioReading]:
        """Return the reading of a packet that a server reports with all its gateways."""
        chosen = self.options.gateway.lower()
        names = [{name.lower() for name in _names(each)} for each in gateways]
        if chosen:
            gateways = [each for each, own in zip(gateways, names, strict=True) if chosen in own]
        if not gateways:
            self.counts.refuse("not received by the gateway on the vehicle")
            return []
        if len({frozenset(own) for own in names}) > 1 and not chosen:
            self.counts.refuse("several gateways: set gateway to the one on the vehicle")
            return []
        if any(each.get("crcStatus") == "BAD_CRC" for each in gateways):
            self.counts.refuse("packet with a wrong checksum")
            return []
        powers = [
            signal_dbm(_first(each, "rssi"), _first(each, "snr", "loRaSNR")) for each in gateways
        ]
        best = max((power for power in powers if power is not None), default=None)
        return self._reading(emitter, best, None)

    def _reading(
        self, emitter: str | None, power_dbm: float | None, time_s: float | None
    ) -> list[RadioReading]:
        if emitter is None or power_dbm is None:
            self.counts.refuse("packet without a device" if emitter is None else "no power")
            return []
        return [RadioReading(emitter, device_time_s=time_s, power_dbm=power_dbm)]


def signal_dbm(rssi_dbm: float | None, snr_db: float | None) -> float | None:
    """Return the power of the signal in a channel's whole power; None: not measured.

    0 is the protocols' default, and means none; no gateway receives more.
    """
    if rssi_dbm is None or rssi_dbm >= 0.0:
        return None
    if snr_db is None:
        return rssi_dbm
    return rssi_dbm - 10.0 * math.log10(1.0 + 10.0 ** (-0.1 * max(-100.0, snr_db)))


def _finite(value: object) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(float(str(value))) < float(2**53)


def _first(found: Mapping[str, Any], *keys: str) -> float | None:
    """Return the number of the first key that has one."""
    return next((float(found[key]) for key in keys if _finite(found.get(key))), None)


def _objects(value: object) -> list[Mapping[str, Any]]:
    items: Iterable[object] = value if isinstance(value, list) else ()
    return [item for item in items if isinstance(item, dict)]


def _text(found: object, *path: str) -> str | None:
    """Return the text at a path of keys."""
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return found[:64] if isinstance(found, str) and found else None


def _names(gateway: Mapping[str, Any]) -> list[str]:
    """Return the names by which a gateway may be configured."""
    ids = (("gatewayId",), ("gatewayID",), ("gateway_ids", "eui"), ("gateway_ids", "gateway_id"))
    return [name for name in (_text(gateway, *path) for path in ids) if name is not None]


def _thing(uplink: Mapping[str, Any]) -> str | None:
    ids = uplink.get("end_device_ids")
    return _text(ids, "dev_eui") or _text(ids, "device_id")


def _device(event: Mapping[str, Any]) -> str | None:
    """Return the EUI of a device, which version 3 writes in base64."""
    eui = _text(event, "deviceInfo", "devEui") or _text(event, "devEUI")
    if eui is None or re.fullmatch(r"[0-9A-Fa-f]{16}", eui):
        return eui
    raw = _decoded(eui)
    return raw.hex() if len(raw) == 8 else None


def _sender(payload: object) -> str | None:
    """Return a packet's device: address or EUI in hexadecimal; None if it has none."""
    raw = _decoded(payload)
    kind = raw[0] >> 5 if raw else -1
    if kind in DATA_UP and len(raw) >= 12:
        return raw[4:0:-1].hex().upper()
    return raw[16:8:-1].hex().upper() if kind == JOIN_REQUEST and len(raw) == 23 else None


def _decoded(payload: object) -> bytes:
    try:
        return base64.b64decode(payload, validate=True) if isinstance(payload, str) else b""
    except (binascii.Error, ValueError):
        return b""


LORA_GATEWAY = RadioKind(
    name="lora_gateway",
    decoder=LoraGatewayDecoder,
    title="LoRa gateways: packet forwarder, ChirpStack, The Things Stack",
    gives="power",
    emitter="a LoRaWAN device",
    transport="udp",
    clock_wrap_s=CLOCK_WRAP_S,
    defaults={"unnamed": "refuse"},
)
