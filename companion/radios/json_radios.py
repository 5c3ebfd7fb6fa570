"""Radios that report in JSON: LoRa gateways and servers, and any program that prints RADIO_RANGING.

LoRa: Semtech's packet forwarder, ChirpStack, The Things Stack. Each received packet has the power
of the whole channel and its signal to noise ratio, from which the power of the signal alone
follows: it is below the noise more often than not.

Sources: Lora-net/packet_forwarder PROTOCOL.TXT 3.2 and 4 (`rxpk`), Lora-net/sx1302_hal the same
(`rssis`); ChirpStack's `UplinkEvent`, versions 3 and 4; The Things Stack, "Data Formats"; LoRaWAN
L2 1.0.4 chapters 4 and 6 (addresses in a packet).

RADIO_RANGING is one object a line. Names and units are those of the message (docs/wire.md): metres,
radians, microseconds; received power is `power_dbm`. Absent or null values were not measured.
Unknown keys are ignored, so a line may carry more for its log.
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

from companion.domain import NonNegative, Params
from companion.radios.decoder import (
    AngleFrame,
    FrameDecoder,
    LineDecoder,
    RadioReading,
    is_power_only,
)
from companion.radios.fields import NOT_VALID, is_marked_invalid

PER_S = 1e6
JOIN_REQUEST, DATA_UP = 0, (2, 4)
"""Message types that devices send."""


class LoraGatewayOptions(Params, frozen=True):
    """Selects the gateway on the vehicle."""

    gateway: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """EUI or name of the gateway, where several may report the same packet."""


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
        """Return a reading for each packet; None if the object has another kind."""
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
    """Return the number of the first key that has one, or None."""
    return next((float(found[key]) for key in keys if _finite(found.get(key))), None)


def _objects(value: object) -> list[Mapping[str, Any]]:
    items: Iterable[object] = value if isinstance(value, list) else ()
    return [item for item in items if isinstance(item, dict)]


def _text(found: object, *path: str) -> str | None:
    """Return the text at a path of keys, or None."""
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
    """Return the EUI of a device, which version 3 writes in base64; None: invalid."""
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


MAX_BEARING_RAD = 2.0 * math.pi + 1e-6
MAX_ELEVATION_RAD = 0.5 * math.pi + 1e-6
MAX_SIGMA_RAD = math.pi / math.sqrt(3.0) + 1e-6
"""Standard deviation of an angle that may be anywhere on the circle."""
UNITS = re.compile(
    r'"(?:\w{0,20}units?|units?_\w{0,20}|uom)"\s*:\s*(?:"(?!(?:m|rad|us|dBm)?")|\{)', re.IGNORECASE
)
"""Key that names a unit not used by RADIO_RANGING."""
IDENTITY = re.compile(
    r'"((?:anchor|tag|beacon|node|device|emitter|peer|responder)(?:_?(?:id|name))?|id|uid|bssid'
    r'|mac(?:_?addr(?:ess)?)?|addr(?:ess)?|dev_?(?:eui|addr))"\s*:',
    re.IGNORECASE,
)
"""Key by which other programs name an emitter: without `emitter_id` all would be one."""
RECORD_SEPARATOR = "\x1e"
"""Before each text of a JSON sequence (RFC 8142)."""

EmitterId = Annotated[int, msgspec.Meta(ge=0, le=65_535)]
EmitterName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class Line(msgspec.Struct, frozen=True):
    """Keys of a line that are used."""

    emitter_id: EmitterId | EmitterName | None = None
    time_usec: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] | None = None
    range: float | None = None
    range_std: NonNegative | None = None
    bearing: float | None = None
    bearing_std: NonNegative | None = None
    elevation: float | None = None
    elevation_std: NonNegative | None = None
    power_dbm: float | None = None
    quality: Annotated[int, msgspec.Meta(ge=0, le=100)] | None = None
    body_frame: bool | None = None
    array_angle: bool | None = None
    line_of_sight: bool | None = None

    azimuth: Any = msgspec.UNSET
    distance: Any = msgspec.UNSET
    range_m: Any = msgspec.UNSET
    range_mm: Any = msgspec.UNSET
    bearing_deg: Any = msgspec.UNSET
    elevation_deg: Any = msgspec.UNSET


FOREIGN = {
    "azimuth": "bearing",
    "bearing_deg": "bearing",
    "distance": "range",
    "range_m": "range",
    "range_mm": "range",
    "elevation_deg": "elevation",
}
"""Keys of other formats by the key that they correspond to here, with other units."""
STRANGE_SHARE = 20
"""Good lines that must follow each angle beyond a turn before angles are used again: one torn digit
does not end a stream, degrees do."""
RULES = {
    "emitter_id": "emitter_id must be 0 to 65535, or a name in quotes",
    "time_usec": "time_usec must be whole microseconds, not negative",
    "range": "range must be a number of metres",
    "range_std": "range_std must be a number of metres, not negative",
    "bearing": "bearing must be a number of radians",
    "bearing_std": "bearing_std must be a number of radians, not negative",
    "elevation": "elevation must be a number of radians",
    "elevation_std": "elevation_std must be a number of radians, not negative",
    "power_dbm": "power_dbm must be a number of dBm",
    "quality": "quality must be a whole number from 0 to 100",
    "body_frame": "body_frame must be true or false",
    "array_angle": "array_angle must be true or false",
    "line_of_sight": "line_of_sight must be true, false or null",
}
FIELD = re.compile(r"\$\.(\w+)")
"""Path of a faulty value in msgspec's error: made of our own names, never of the line's."""

DECODER = msgspec.json.Decoder(Line)


class NdjsonDecoder(LineDecoder):
    """Decoder of one measurement a line, of any emitter."""

    has_stamps = False

    def begin(self) -> None:
        """Begin with any unit of angles: another program may send next."""
        super().begin()
        self._beyond_turn = 0

    def read_line(self, line: str, received_s: float) -> list[RadioReading]:
        """Return the reading of a line; blank ones and comments have none."""
        text = line.strip(f"{RECORD_SEPARATOR} \t\r")
        if not text or text.startswith("#"):
            return []
        parsed = self._parsed(text)
        reason = parsed if isinstance(parsed, str) else self._wrong_with(parsed, text)
        if reason is not None:
            self.counts.refuse(reason)
            return []
        assert isinstance(parsed, Line)
        self.counts.frames += 1
        return [_reading_of(parsed)]

    def _wrong_with(self, line: Line, text: str) -> str | None:
        """Return the reason why a line cannot be used, or None.

        The unit of angles is the stream's: if any exceeds a turn, all are in degrees.
        """
        foreign = _foreign_key(line)
        if foreign is not None:
            return f"key `{foreign}` is of another format: companion radio list"
        if is_marked_invalid(text):
            return NOT_VALID
        identity = None if '"emitter_id"' in text else IDENTITY.search(text)
        if identity is not None:
            return f"key `{identity[1].lower()}` may name the emitter: emitter_id does"
        if UNITS.search(text):
            return "key `unit` is none of m, rad, us, dBm: range is in metres"
        if (line.range, line.bearing, line.elevation, line.power_dbm) == (None,) * 4:
            what = "no range, bearing, elevation or power"
            return f"{what}: a power is power_dbm" if is_power_only(text) else what
        names = ("bearing", "elevation", "bearing_std", "elevation_std")
        bounds = (MAX_BEARING_RAD, MAX_ELEVATION_RAD, MAX_SIGMA_RAD, MAX_SIGMA_RAD)
        for name, most_rad in zip(names, bounds, strict=True):
            if abs(getattr(line, name) or 0.0) > most_rad:
                self._beyond_turn += 1
                return f"{name.removesuffix('_std')} is in radians"
        has_angle = line.bearing is not None or line.elevation is not None
        if has_angle and self._beyond_turn * STRANGE_SHARE > self.counts.frames:
            return "angles of this stream are in another unit: radians are needed"
        return None

    def _parsed(self, text: str) -> Line | str:
        """Return the parsed line, or the reason why it is invalid."""
        if "\N{REPLACEMENT CHARACTER}" in text:
            return "not UTF-8"
        try:
            return DECODER.decode(text)
        except msgspec.ValidationError as error:
            field = FIELD.search(str(error))
            return RULES.get(field[1], "not as agreed") if field else "not a JSON object"
        except (msgspec.DecodeError, RecursionError):
            return "not JSON"


def _foreign_key(line: Line) -> str | None:
    """Return a key of another format that has a missing quantity, or None."""
    for key, name in FOREIGN.items():
        if getattr(line, key) is not msgspec.UNSET and getattr(line, name) is None:
            return key
    return None


def _reading_of(line: Line) -> RadioReading:
    frame = AngleFrame.NOSE if line.body_frame else AngleFrame.NORTH
    if line.array_angle:  # regardless of `body_frame`, as by the message's flags
        frame = AngleFrame.ARRAY
    return RadioReading(
        emitter=line.emitter_id,
        device_time_s=None if line.time_usec is None else line.time_usec / 1e6,
        range_m=line.range,
        range_sigma_m=line.range_std,
        azimuth_rad=line.bearing,
        azimuth_sigma_rad=line.bearing_std,
        elevation_rad=line.elevation,
        elevation_sigma_rad=line.elevation_std,
        power_dbm=line.power_dbm,
        frame=frame,
        quality=None if line.quality is None else line.quality / 100.0,
        line_of_sight=line.line_of_sight,
    )
