"""Interface of the endpoint: roles of links, parameters, settings of a radio, journal, recorder.

The mount is configured once for each kind of antenna. A direction finder's angle about its
upright is turned by `bearing_mount_deg` here, and is then a bearing from the vehicle's nose. An
array's angle (`AngleFrame.ARRAY`) is not an angle about any upright, cannot be turned by addition,
and is passed unchanged: its mount is `estimation.filter.antenna.mount_deg`.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar, Literal, Protocol

import msgspec

from companion.domain import NonNegative, Params, Positive, Signed
from companion.guidance.commands import ReportResult, Severity
from companion.guidance.events import Event
from companion.link.ranging_sources import RATE_MAX_HZ
from companion.mav.endpoint import Address
from companion.radios.decoder import RadioKind

EmitterId = Annotated[int, msgspec.Meta(ge=0, le=65535)]
Degrees = Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Sign = Literal[1, -1]
MAX_EMITTERS = 256
"""Limit of names of a stream; forged input can invent any number."""
LAST_ID = 65_535
_MAC = re.compile(
    r"[0-9a-f]{2}(?:[:-][0-9a-f]{2}){5}(?:(?:[:-][0-9a-f]{2}){2})?"
    r"|[0-9a-f]{4}(?:\.[0-9a-f]{4}){2,3}|[0-9a-f]{12}|[0-9a-f]{16}",
    re.I,
)
"""Address of 6 or 8 bytes, in any of its notations."""
_SHORT = re.compile(r"[0-9a-f]{4}|[0-9a-f]{8}", re.I)
"""Address of 2 or 4 bytes."""
_NUMBER = re.compile(r"[1-9][0-9]{0,18}|0[0-9]{0,4}|0[xX][0-9a-fA-F]{1,16}")


class RadioSettings(Params, frozen=True):
    """Settings that turn the readings of one radio into measurements."""

    emitters: dict[str, EmitterId] = msgspec.field(default_factory=dict)
    """Ids by the name on the wire; addresses in any case and notation."""
    emitter: EmitterId = 1
    """Id of readings without an emitter."""
    unnamed: Literal["number", "refuse"] = "number"
    """Treatment of an emitter that is not in `emitters`: a permanent id, or refusal."""
    frequency_tolerance_khz: Positive | None = None
    """Names are frequencies in MHz and match within this; null: names are names."""

    range_offset_m: Signed = 0.0
    """Offset of ranges: range = (reported - range_offset_m) / range_scale."""
    range_scale: Annotated[float, msgspec.Meta(ge=0.5, le=2.0)] = 1.0
    range_min_m: Signed = 0.0
    """Minimum corrected range; a shorter one is refused."""
    range_max_m: Positive | None = None
    """Longest corrected range; a longer one is refused; null: by `AcceptanceParams`, 2 km."""
    zero: Literal["refuse", "accept"] = "refuse"
    """Treatment of a range of exactly 0, which most radios report if nothing was measured."""
    range_sigma_m: Positive | None = None
    """Sigma where the radio reports none, and its lower limit; null: the estimation's."""

    power_offset_db: Signed = 0.0
    """Offset that is added to received powers: gains of antennas, or the level to which the radio
    relates them."""

    bearing_sign: Sign = 1
    """-1 where the device counts counter-clockwise."""
    bearing_mount_deg: Degrees = 0.0
    """Zero of the device, clockwise from the vehicle's nose; not for arrays, see above."""
    elevation_sign: Sign = 1
    field_of_view_deg: Annotated[float, msgspec.Meta(gt=0.0, le=360.0)] = 360.0
    """Full angle about the device's zero within which its angles are used."""
    bearing_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] | None = None
    elevation_sigma_deg: Annotated[float, msgspec.Meta(gt=0.0, le=90.0)] | None = None

    quality_min: Share = 0.0
    """Minimum quality; a reading of lower quality is refused."""
    sigma_factors: tuple[tuple[Share, Positive], ...] = ()
    """Ascending [quality, factor] pairs: from that quality on sigmas get the factor."""

    clock: Literal["device", "arrival"] = "device"
    """Clock of a reading's time, where the device has one."""
    clock_wrap_s: Positive | None = None
    """Period after which the device's clock wraps to zero; null: that of the radio's kind."""
    lag_s: Annotated[float, msgspec.Meta(ge=-1.0, le=5.0)] = 0.0
    """Delay of the reading's time after the measurement."""
    max_age_s: Positive | None = None
    """Largest age of a reading; an older one is refused; null: by `AcceptanceParams`, 1 s."""
    rate_max_hz: Annotated[float, msgspec.Meta(ge=1.0, le=1e6)] | None = RATE_MAX_HZ
    """Limit of measurements a second of an emitter, as each costs milliseconds; null: none."""
    stuck_after: Annotated[int, msgspec.Meta(ge=2)] | None = None
    """Equal ranges in a row before more are refused; null: only while the vehicle moves."""
    poll_s: Annotated[float, msgspec.Meta(ge=0.02, le=60.0)] | None = None
    """Poll interval of a polled radio; null: that of its kind."""
    timeout_s: NonNegative = 5.0
    """Silence after which the operator is warned; 0: never."""

    def __post_init__(self) -> None:
        if self.range_max_m is not None and self.range_max_m <= self.range_min_m:
            raise ValueError("range_max_m: must be above range_min_m")
        qualities = [quality for quality, _ in self.sigma_factors]
        if qualities != sorted(set(qualities)):
            raise ValueError("sigma_factors: qualities must ascend")
        EmitterNames(self)


@dataclass(frozen=True, slots=True)
class RadioSetup:
    """Selected radio: its kind and settings."""

    kind: RadioKind
    settings: RadioSettings
    options: Params | None = None
    """Options of the decoder; None: its defaults."""
    is_uncalibrated: bool = False
    """True if its ranges have a constant that must be calibrated, and is not."""


class EmitterNames:
    """Ids of emitters by their names on the wire; a name without one gets one by the name alone."""

    def __init__(self, settings: RadioSettings) -> None:
        self.texts: list[str] = []
        """Texts for the operator, cleared by the reader."""
        self._settings = settings
        self._tolerance_mhz = 1e-3 * (settings.frequency_tolerance_khz or 0.0)
        self._ids: dict[str | float, int] = {}
        self._known: dict[str | int | None, int | None] = {None: settings.emitter}
        for name, number in settings.emitters.items():
            key = self._key(name)
            if key is None:
                raise ValueError(f"emitters: `{name}` is not a frequency in MHz")
            if key in self._ids:
                raise ValueError(f"emitters: `{name}` is given twice")
            self._ids[key] = number

    def id_of(self, emitter: str | int | None) -> int | None:
        """Return the emitter's id; None if it has none and gets none."""
        try:
            return self._known[emitter]
        except KeyError:
            pass
        number = self._find(emitter)
        if len(self._known) < MAX_EMITTERS:
            self._known[emitter] = number
        return number

    def _key(self, emitter: str | int) -> str | float | None:
        """Return a normalised name; None if names must be frequencies and it is not."""
        if self._tolerance_mhz:
            try:
                return float(emitter)
            except ValueError:
                return None
        text = str(emitter).strip()
        if isinstance(emitter, str) and _MAC.fullmatch(text):
            digits = re.sub("[:.-]", "", text.lower())
            return ":".join(digits[at : at + 2] for at in range(0, len(digits), 2))
        if _NUMBER.fullmatch(text):
            return str(int(text, 16 if text[:2] in ("0x", "0X") else 10))
        return text.lower() if _SHORT.fullmatch(text) else text

    def _find(self, emitter: str | int | None) -> int | None:
        assert emitter is not None  # known from the start
        key = self._key(emitter)
        if isinstance(key, float):
            key = self._nearest(key)
        if key is None or key in self._ids:
            return None if key is None else self._ids[key]
        is_number = isinstance(key, str) and key.isdigit() and int(key) <= LAST_ID
        if self._settings.unnamed == "refuse" or len(self._ids) >= MAX_EMITTERS:
            return None
        number = self._ids[key] = int(key) if is_number else self._new_id(str(key))
        if not is_number:
            self.texts.append(f"emitter `{printable(emitter)}` has the id {number}")
        return number

    def _nearest(self, mhz: float) -> float:
        """Return the nearest known frequency, if within tolerance; else this one."""
        frequencies = [known for known in self._ids if isinstance(known, float)]
        nearest = min(frequencies, key=lambda known: abs(known - mhz), default=mhz)
        return nearest if abs(nearest - mhz) <= self._tolerance_mhz else mhz

    def _new_id(self, name: str) -> int:
        number = 1 + zlib.crc32(name.encode()) % LAST_ID
        taken = set(self._ids.values())
        while number in taken:
            number = 1 + number % LAST_ID
        return number


def printable(emitter: str | int | None) -> str:
    """Return a name on the wire for texts, shortened and without control characters."""
    return "".join(c if c.isprintable() else "?" for c in str(emitter)[:40])


class LinkRole(Enum):
    """Purpose of a link."""

    VEHICLE = "vehicle"
    """Link to the autopilot; there is exactly one."""
    RANGING = "ranging"
    """Ranging only, because a real autopilot does not forward our message."""
    GCS = "gcs"


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """One link; its index among all of them is `Chunk.link`."""

    role: LinkRole
    radio: RadioSetup | None = None
    """Radio format of a RANGING link; None: MAVLink."""


VEHICLE_ONLY = (LinkSpec(LinkRole.VEHICLE),)


class VehicleParams(Params, frozen=True):
    """Autopilot, and the kind of setpoint for it."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one received."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""


class LinkParams(Params, frozen=True):
    """Use of the companion's links."""

    component_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """MAVLink component id; null: 191, or the next free one up to 194 where that is taken."""

    rate_hz: Annotated[float, msgspec.Meta(ge=20.0, le=50.0)] = 20.0
    """Control ticks, and so setpoints, per second."""
    lossy_rate_hz: ClassVar[float] = 50.0
    """Control ticks per second on a lossy line; no configured rate is higher."""
    lossy_share: ClassVar[float] = 0.2
    """Share of lost frames of the autopilot above which a line is lossy."""
    downlink_bytes_s: Annotated[float, msgspec.Meta(ge=100.0, le=1e9)] = 5760.0
    """Capacity of the slowest link to a ground station, bytes/s: 57,600 baud, the usual telemetry
    radio. Texts get one per cent of it."""
    signing_key_file: str | None = None
    """File of the key that signs MAVLink 2; null: no signing. `--signing-key` precedes."""
    unsigned_ranging: bool = False
    """True: with a key, `--ranging` links accept unsigned ranging messages of a radio that cannot
    sign; anything else that is unsigned is refused on every link."""

    stop_unread_streams: bool = False
    """True: the autopilot is asked to stop streams on this link that the companion does not use;
    only for a link without other receivers. It lasts until the autopilot restarts."""
    gcs_icon: bool = False
    """True: ground stations on `--gcs` links get the estimate as an ADSB_VEHICLE, an icon."""


@dataclass(frozen=True, slots=True)
class EndpointParams:
    """Parameters of an endpoint."""

    vehicle: VehicleParams
    link: LinkParams
    links: tuple[LinkSpec, ...]


class Journal(Protocol):
    """Log of the endpoint; never raises and never blocks."""

    def frame(self, data: bytes, now_s: float) -> None:
        """Record a raw frame, received or sent on the vehicle link, or received on another."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Record a line for the event log."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Record a text for the operator."""

    def result(self, report: ReportResult, now_s: float) -> None:
        """Record that the target is localised."""


class InputRecorder(Protocol):
    """Receiver of all inputs in order; never raises and never blocks."""

    def frame(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record a valid frame that was not our own."""

    def raw(self, data: bytes, link: int, peer: Address | None, now_s: float) -> None:
        """Record bytes of a radio with its own format."""

    def tick(self, now_s: float) -> None:
        """Record that the timer fired."""

    def event(self, event: Event) -> None:
        """Record an event of the process or the operator; others follow from frames and ticks."""
