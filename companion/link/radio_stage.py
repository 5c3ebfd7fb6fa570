"""Common stage behind every radio's decoder: from readings to measurements.

Theory of operation. A decoder reports in the radio's own convention; everything that depends on the
site and not on the format is done here, once: names of emitters to ids, offset and scale of ranges,
sign and mount of bearings, the field of view, default sigmas, the device's clock, and the detection
of stuck or repeated readings. Refusals are counted by reason, and the valid part of a partly
refused reading is kept.
"""

from __future__ import annotations

import math
import re
from collections import Counter

from companion.domain import POWER_LIMITS_DBM, RangingMeasurement
from companion.geometry.coordinates import bearing_enu_from_ned, wrap_pi
from companion.link.conversion.sender_clock import ClockStep, SenderClock
from companion.link.intake import RateLimit
from companion.link.interface import MAX_EMITTERS, EmitterNames, RadioSetup, printable
from companion.radios.decoder import AngleFrame, LineDecoder, RadioReading
from companion.radios.fields import is_overflow_m

MAX_ANGLE_RAD = 2.0 * math.pi + 1e-6
"""A whole turn; more is most likely another unit."""
MAX_TEXT_BYTES, MAX_HEX_BYTES = 80, 24
"""Bytes that are shown of a stream in which nothing is understood, as text or in hexadecimal."""
_UTF_16 = re.compile(rb"\xff\xfe|\xfe\xff|(?:[ -~]\x00){8}|(?:\x00[ -~]){8}")
"""Beginning of text as Windows' editors and shells save it: a byte order mark, or 8 characters."""
REACH_M = 101_000.0
"""Longest range of any radio: LTE's largest timing advance, 1282 steps (TS 36.213 4.2.3). A longer
one is an overflow or in another unit."""
STALLED_S = 2.0
"""Time without a measurement within its rate, at least 1 Hz, after which stamps of an emitter stand
still because they are in another unit."""


class DeviceClock:
    """Radio's own clock on ours: unwrapped, and then converted like a sender's clock."""

    def __init__(self, wrap_s: float | None = None) -> None:
        self.restarts = 0
        self._wrap_s = wrap_s
        self._clock = SenderClock()
        self._last: tuple[float, float] | None = None
        """Newest unwrapped stamp, and its arrival."""

    @property
    def is_heard(self) -> bool:
        """True if there ever was a stamp."""
        return self._clock.timebase.offset_at_s(0.0) is not None

    @property
    def is_usable(self) -> bool:
        """True if its stamps are usable."""
        return not self._clock.is_too_fast

    def read(self, stamp_s: float, now_s: float) -> float:
        """Return the time of a stamp on our clock."""
        if self._wrap_s is not None:
            stamp_s = self._unwrapped(stamp_s, self._wrap_s, now_s)
        reading = self._clock.read(stamp_s, now_s)
        self.restarts += reading.step is not ClockStep.NONE
        return reading.time_s if self.is_usable else now_s

    def _unwrapped(self, stamp_s: float, wrap_s: float, now_s: float) -> float:
        """Return the stamp in the turn of the counter that is nearest to the elapsed time."""
        if self._last is not None:
            last_s, heard_s = self._last
            stamp_s += wrap_s * round((last_s + now_s - heard_s - stamp_s) / wrap_s)
        self._last = (stamp_s, now_s)
        return stamp_s


def _shown(data: bytes) -> str:
    """Return the first line if the bytes are text, else the first bytes in hexadecimal."""
    line = (data.splitlines() or [b""])[0]
    if data.isascii() and line.decode().isprintable():
        return line.decode()
    return data[:MAX_HEX_BYTES].hex(" ")


class RadioStage:
    """Stage from one radio's bytes to measurements, a `RangingSource` of `ranging_sources`.

    If a plugin's decoder raises, its partial input is dropped, and the failure is counted.
    """

    def __init__(self, setup: RadioSetup) -> None:
        self.setup = setup
        self.decoder = setup.kind.decoder(setup.options)
        settings = setup.settings
        self.names = EmitterNames(settings)
        self.clock = DeviceClock(settings.clock_wrap_s or setup.kind.clock_wrap_s)
        self.received = 0
        """Number of bytes so far."""
        self._first = b""
        """First bytes of the stream, which are shown if nothing is understood."""
        self.received_s: float | None = None
        """Arrival time of the latest bytes."""
        self.lost = 0
        self.measured = 0
        self.age_s: float | None = None
        """Age of the latest measurement on arrival."""
        self.refused: Counter[str] = Counter()
        self.newest: dict[int, RangingMeasurement] = {}
        self.unlisted: dict[str, float | None] = {}
        """Names on the wire that are refused because they are not listed, and their power."""
        self._mount_rad = math.radians(settings.bearing_mount_deg)
        self._half_view_rad = math.radians(0.5 * settings.field_of_view_deg) + 1e-9
        self.thinned = 0
        """Number of measurements beyond `rate_max_hz`."""
        self._rates: dict[int, RateLimit] = {}
        self._passed_s: dict[int, float] = {}
        """Arrival of each emitter's latest measurement within its rate."""
        self._last: dict[int, RadioReading] = {}
        self._equal: Counter[int] = Counter()

    def receive(self, data: bytes, now_s: float) -> list[RangingMeasurement]:
        """Return the measurements that bytes complete; no bytes: the line was lost."""
        if not data:
            self.decoder.reset()
            self.lost += 1
            return []
        self.received += len(data)
        self._first += data[: MAX_TEXT_BYTES - len(self._first)]
        self.received_s = now_s
        try:
            readings = self.decoder.feed(data, now_s)
        except Exception as error:
            self._refuse(f"the decoder failed ({type(error).__name__})")
            self.decoder.reset()
            return []
        measured = [self._measure(reading, now_s) for reading in readings]
        found = [each for each in measured if each is not None and self._is_due(each, now_s)]
        if found:
            self.measured += len(found)
            self.age_s = now_s - found[-1].measured_at_s
            self.newest.update((measurement.emitter_id, measurement) for measurement in found)
        return found

    def _is_due(self, measurement: RangingMeasurement, now_s: float) -> bool:
        """Return True if the measurement is within its emitter's rate, by its own time."""
        rate_hz, emitter_id = self.setup.settings.rate_max_hz, measurement.emitter_id
        if rate_hz is None:
            return True
        limit = self._rates.get(emitter_id)
        if limit is None:
            limit = self._rates[emitter_id] = RateLimit(rate_hz, burst=2)
        if limit.acquire(measurement.measured_at_s):
            self._passed_s[emitter_id] = now_s
            return True
        if now_s - self._passed_s.get(emitter_id, now_s) > STALLED_S:
            self._refuse("time of the radio hardly advances: clock=arrival")
        else:
            self.thinned += 1
        return False

    @property
    def all_refused(self) -> Counter[str]:
        """Refusals by reason, the decoder's and the stage's."""
        counts = self.decoder.counts
        bad = Counter({"bad checksum": counts.bad_checksum}) if counts.bad_checksum else Counter()
        return self.refused + counts.refused + bad

    @property
    def unrecognised(self) -> str:
        """Description of input that is not of the format; empty: all is."""
        counts = self.decoder.counts
        is_lines = isinstance(self.decoder, LineDecoder)
        if is_lines and not counts.readings and _UTF_16.match(self._first):
            return "text in UTF-16: save or send it as UTF-8"
        if counts.unrecognised:
            lines = "line" if counts.unrecognised == 1 else "lines"
            first = counts.first_unrecognised
            return f"{counts.unrecognised} {lines} not recognised; first: {first}"
        if not self.received or counts.readings or self.all_refused:
            return ""
        if counts.frames:
            lines = "line or frame" if counts.frames == 1 else "lines or frames"
            return f"{counts.frames} {lines} understood, no measurement"
        is_text = is_lines and self._first.isascii()
        missing = (
            "line end" if is_text and not re.search(b"[\r\n]", self._first) else "line or frame"
        )
        return f"no {missing} in {self.received} bytes; first: {_shown(self._first)}"

    def _refuse(self, reason: str) -> None:
        self.refused[reason] += 1

    def _measure(self, reading: RadioReading, now_s: float) -> RangingMeasurement | None:
        settings = self.setup.settings
        emitter_id = self.names.id_of(reading.emitter)
        if emitter_id is None:
            self._refuse("emitter is not listed")
            shown = printable(reading.emitter)
            if shown in self.unlisted or len(self.unlisted) < MAX_EMITTERS:
                self.unlisted[shown] = reading.power_dbm
            return None
        if self._is_repeated(emitter_id, reading):
            return None
        if reading.quality is not None and reading.quality < settings.quality_min:
            self._refuse("too little quality")
            return None
        device_s = reading.device_time_s
        time_s = now_s
        if device_s is not None and settings.clock == "device" and math.isfinite(device_s):
            time_s = self.clock.read(device_s, now_s)
        time_s -= reading.age_s + settings.lag_s
        if settings.max_age_s is not None and now_s - time_s > settings.max_age_s:
            self._refuse("too old")
            return None
        return self._corrected(emitter_id, time_s, reading)

    def _is_repeated(self, emitter_id: int, reading: RadioReading) -> bool:
        """Return True if it was seen before (a polled page), or the range is stuck."""
        last = self._last.get(emitter_id)
        self._last[emitter_id] = reading
        if last is not None and reading.device_time_s is not None and reading == last:
            self._refuse("seen before")
            return True
        limit = self.setup.settings.stuck_after
        if limit is None or reading.range_m is None:
            return False
        is_equal = last is not None and last.range_m == reading.range_m
        self._equal[emitter_id] = self._equal[emitter_id] + 1 if is_equal else 1
        if self._equal[emitter_id] <= limit:
            return False
        self._refuse("range is stuck")
        return True

    def _corrected(
        self, emitter_id: int, time_s: float, reading: RadioReading
    ) -> RangingMeasurement | None:
        range_m, bearing_rad = self._range_m(reading), self._bearing_rad(reading)
        elevation_rad, power_dbm = self._elevation_rad(reading), self._power_dbm(reading)
        said = (reading.range_m, reading.azimuth_rad, reading.elevation_rad)
        if (range_m, bearing_rad, elevation_rad) == (None,) * 3 and (
            power_dbm is None or said != (None,) * 3
        ):  # a power with a range or an angle that cannot be used is not used alone
            return None
        settings, device_s = self.setup.settings, reading.device_time_s
        factor = self._sigma_factor(reading.quality)
        said_m = reading.range_sigma_m
        said_m = settings.range_sigma_m if said_m is None else said_m / settings.range_scale
        is_by_north = reading.frame is AngleFrame.NORTH
        return RangingMeasurement(
            emitter_id=emitter_id,
            measured_at_s=time_s,
            range_m=range_m,
            range_sigma_m=None if range_m is None else _times(factor, said_m),
            bearing_enu_rad=bearing_rad if is_by_north else None,
            bearing_body_rad=None if is_by_north else bearing_rad,
            bearing_sigma_rad=None
            if bearing_rad is None
            else _times(factor, _said_or(reading.azimuth_sigma_rad, settings.bearing_sigma_deg)),
            elevation_rad=elevation_rad,
            elevation_sigma_rad=None
            if elevation_rad is None
            else _times(
                factor, _said_or(reading.elevation_sigma_rad, settings.elevation_sigma_deg)
            ),
            power_dbm=power_dbm,
            is_array_angle=reading.frame is AngleFrame.ARRAY,
            quality=reading.quality,
            line_of_sight=reading.line_of_sight,
            stamp_us=None if device_s is None else _microseconds(device_s),
            least_sigmas=(
                settings.range_sigma_m,
                _said_or(None, settings.bearing_sigma_deg),
                _said_or(None, settings.elevation_sigma_deg),
            ),
        )

    def _range_m(self, reading: RadioReading) -> float | None:
        """Return the range corrected for offset and scale; None: refused, or not measured."""
        said_m, settings = reading.range_m, self.setup.settings
        if said_m is None:
            return None
        range_m = (said_m - settings.range_offset_m) / settings.range_scale
        most_m = math.inf if settings.range_max_m is None else settings.range_max_m
        is_finite = math.isfinite(range_m)
        is_refused_zero = said_m == 0.0 and settings.zero == "refuse"
        is_code = is_finite and is_overflow_m(said_m)
        checks = (
            (is_refused_zero, "range of exactly 0: nothing measured"),
            (said_m > REACH_M, "range above 100 km: beyond every radio"),
            (not is_finite, "range is not finite"),
            (is_code, "range of all bits set, or all nines: nothing measured"),
            (range_m < settings.range_min_m, "range below range_min_m"),
            (range_m > most_m, "range above range_max_m"),
        )
        for is_wrong, reason in checks:
            if is_wrong:
                self._refuse(reason)
                return None
        return range_m

    def _bearing_rad(self, reading: RadioReading) -> float | None:
        """Return the bearing in its frame: ENU if north-referenced, else body or array; or None."""
        said_rad, settings = reading.azimuth_rad, self.setup.settings
        if said_rad is None:
            return None
        if not abs(said_rad) <= MAX_ANGLE_RAD:
            self._refuse("bearing is not an angle in radians")
            return None
        if reading.frame is AngleFrame.NORTH:
            return bearing_enu_from_ned(said_rad)
        if abs(wrap_pi(said_rad)) > self._half_view_rad:
            self._refuse("outside field_of_view_deg")
            return None
        turned_rad = settings.bearing_sign * said_rad
        if reading.frame is AngleFrame.ARRAY:
            if settings.bearing_mount_deg != 0.0:
                self._refuse("an array has estimation.filter.antenna.mount_deg instead")
                return None
            return wrap_pi(turned_rad)
        return wrap_pi(turned_rad + self._mount_rad)

    def _elevation_rad(self, reading: RadioReading) -> float | None:
        said_rad = reading.elevation_rad
        if said_rad is None:
            return None
        if not abs(said_rad) <= MAX_ANGLE_RAD:
            self._refuse("elevation is not an angle in radians")
            return None
        return self.setup.settings.elevation_sign * said_rad

    def _power_dbm(self, reading: RadioReading) -> float | None:
        (least_dbm, most_dbm), power_dbm = POWER_LIMITS_DBM, reading.power_dbm
        if power_dbm is None:
            return None
        power_dbm += self.setup.settings.power_offset_db
        if least_dbm <= power_dbm <= most_dbm:
            return power_dbm
        self._refuse(f"power is not within {least_dbm:g} to {most_dbm:g} dBm")
        return None

    def _sigma_factor(self, quality: float | None) -> float:
        """Return the factor of the last pair whose quality is reached, or the first one's."""
        steps = self.setup.settings.sigma_factors
        if quality is None or not steps:
            return 1.0
        reached = [factor for least, factor in steps if quality >= least]
        return reached[-1] if reached else steps[0][1]


def _times(factor: float, sigma: float | None) -> float | None:
    return None if sigma is None else factor * sigma


def _said_or(said_rad: float | None, default_deg: float | None) -> float | None:
    if said_rad is not None or default_deg is None:
        return said_rad
    return math.radians(default_deg)


def _microseconds(time_s: float) -> int | None:
    return round(1e6 * time_s) if math.isfinite(time_s) else None
