"""Sources of ranging: one per ranging link, bytes and time in, measurements out.

A radio with a format of its own has a decoder in `companion.radios`, and `RadioStage` as its
source. For MAVLink, RADIO_RANGING is our own message; LANDING_TARGET of type RADIO_BEACON and
RANGING_BEACON are read as well. Degrees, millimetres, NED and the sentinels (NaN, UINT8_MAX,
UINT32_MAX) are converted here. Infinities and absurd numbers pass on purpose: the tracker rejects
them and counts the reason.

Rates. A measurement costs the flight computer a fraction of a millisecond before it is fused, so
that a sender at 1 kHz would take half of a core. Measurements beyond the rate are dropped as they
arrive, which passes the newest at a steady rate, are counted, and are announced. Rates go by our
own clock: stamps are under the sender's control.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol, get_args

from companion.domain import RangingMeasurement
from companion.guidance.commands import Announce, Severity
from companion.link.conversion.sender_clock import CLOCK_TOLERANCE_S, SenderClock, VehicleClock
from companion.link.intake import RateLimit
from companion.link.text_gate import CAUSE_PERIOD_S
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message, Message, RangingFlag, mavlink

UINT8_MAX = 0xFF
UINT32_MAX = 0xFFFFFFFF
MAX_BEARING_RAD = math.pi + 1e-6
"""Half a turn plus the rounding of 32 bits."""
MAX_LINK_DELAY_S = 0.5
"""Longest constant delay by which a radio's clock seems later than the autopilot's."""
MAX_SENDERS = 16
"""Limit of ranging senders of a link whose clocks are kept."""
RATE_MAX_HZ = 20.0
"""Measurements a second of an emitter, as for radios with native formats (`rate_max_hz`)."""
MAX_EMITTERS = 16
"""Emitters of one sender with separate rates: as many as `emitters.most` allows."""
MANY_DROPPED = 10
"""Dropped measurements before the next text: half a second's worth, more than a burst."""
RangingMessage = (
    MAVLink_radio_ranging_message
    | mavlink.MAVLink_landing_target_message
    | mavlink.MAVLink_ranging_beacon_message
)
BODY_FRAME, LINE_OF_SIGHT, NON_LINE_OF_SIGHT, ARRAY_ANGLE = (int(flag) for flag in RangingFlag)
RANGING_IDS = frozenset(kind.id for kind in get_args(RangingMessage))
"""Message ids that are read as ranging."""


class RangingSource(Protocol):
    """Source of measurements on one link, without sockets or clocks."""

    def receive(self, data: bytes, now_s: float) -> list[RangingMeasurement]:
        """Return the measurements that bytes complete; bad bytes are dropped, never raised.

        The bytes are a datagram, or any part of a stream; of a MAVLink link one verified frame.
        """


class SenderRate:
    """Rates of one sender: of all its measurements, and of each emitter."""

    def __init__(self) -> None:
        most_hz = RATE_MAX_HZ * MAX_EMITTERS
        self._all = RateLimit(most_hz, burst=int(most_hz))
        self._by_emitter: dict[int, RateLimit] = {}
        self.dropped = 0
        """Dropped measurements since the last text."""
        self._texts = RateLimit(1.0 / CAUSE_PERIOD_S)

    def acquire(self, emitter_id: int, now_s: float) -> bool:
        """Return True if a measurement of an emitter may pass; otherwise it is counted."""
        limit = self._by_emitter.get(emitter_id)
        if limit is None:
            if len(self._by_emitter) >= MAX_EMITTERS:
                del self._by_emitter[next(iter(self._by_emitter))]
            limit = self._by_emitter[emitter_id] = RateLimit(RATE_MAX_HZ, burst=int(RATE_MAX_HZ))
        is_due = limit.acquire(now_s) and self._all.acquire(now_s)
        self.dropped += not is_due
        return is_due

    def text(self, sender: tuple[int, int], now_s: float) -> Announce | None:
        """Return the warning that is due about dropped measurements, or None."""
        if self.dropped < MANY_DROPPED or not self._texts.acquire(now_s):
            return None
        count, self.dropped = self.dropped, 0
        system, component = sender
        return Announce(
            Severity.WARNING,
            f"ranging of {system}/{component}: {count} skipped, "
            f"over {RATE_MAX_HZ:.0f} Hz per emitter; lower its rate",
        )


class MavlinkRanging:
    """Source of MAVLink ranging, each sender on its own clock, or on the autopilot's if shared.

    By its definition a stamp counts from the vehicle's boot or from 1970. One that agrees with the
    autopilot's clock is converted with that: then a link's constant delay, which no sender's own
    stamps can show, does not shift the vehicle position at the time of the measurement.
    """

    def __init__(self, codec: MavCodec, vehicle_clock: VehicleClock) -> None:
        self._codec = codec
        self._vehicle_clock = vehicle_clock
        self._clocks: dict[tuple[int, int], SenderClock] = {}
        self._rates: dict[tuple[int, int], SenderRate] = {}
        self._on_vehicle_clock: set[tuple[int, int]] = set()
        """Senders whose latest stamp was from the autopilot's clock."""
        self._slips = vehicle_clock.slips

    def receive(self, data: bytes, now_s: float) -> list[RangingMeasurement]:
        """Return the measurement in a verified frame, if it is a ranging message."""
        message = self._codec.decode_proved(data)
        return self.measure(message, now_s) if isinstance(message, RangingMessage) else []

    def measure(self, message: RangingMessage, now_s: float) -> list[RangingMeasurement]:
        """Return the measurement in a decoded message."""
        if self._slips != self._vehicle_clock.slips:  # senders on its clock start again
            self._slips = self._vehicle_clock.slips
            for each in tuple(self._on_vehicle_clock):
                self._forget(each)
        sender = (message.get_srcSystem(), message.get_srcComponent())
        clock = self._clocks.get(sender)
        if clock is None:
            if len(self._clocks) >= MAX_SENDERS:
                self._forget(next(iter(self._clocks)))
            clock = self._clocks[sender] = SenderClock()
            self._rates[sender] = SenderRate()
        stamp_s, measured_at_s = message.time_usec / 1e6, now_s
        if stamp_s:  # a sender without a clock has no stamp to use or compare
            known_s = self._vehicle_clock.offset_at_s(now_s)
            own_s = clock.timebase.offset_at_s(now_s)
            is_behind = own_s is not None and known_s is not None and own_s < known_s
            if is_behind and known_s is not None and sender in self._on_vehicle_clock:
                clock.timebase.raise_to(known_s, now_s)  # it lost time, in steps too small to show
            measured_at_s = clock.read(stamp_s, now_s).time_s
            own_offset_s = clock.timebase.offset_at_s(measured_at_s)
            vehicle_offset_s = self._vehicle_clock.offset_at_s(measured_at_s)
            self._on_vehicle_clock.discard(sender)
            clock.timebase.known_rate = None
            if own_offset_s is not None and vehicle_offset_s is not None:
                later_s = own_offset_s - vehicle_offset_s
                if -CLOCK_TOLERANCE_S <= later_s <= MAX_LINK_DELAY_S:
                    self._on_vehicle_clock.add(sender)
                    clock.timebase.known_rate = self._vehicle_clock.excess_rate
                    measured_at_s = min(now_s, stamp_s + vehicle_offset_s)
        measurement = ranging_from_message(message, measured_at_s)
        if measurement is None or not self._rates[sender].acquire(measurement.emitter_id, now_s):
            return []
        return [measurement if stamp_s else replace(measurement, stamp_us=None)]

    def texts(self, now_s: float) -> list[Announce]:
        """Return warnings about senders whose measurements were dropped."""
        due = [rate.text(sender, now_s) for sender, rate in self._rates.items() if rate.dropped]
        return [text for text in due if text is not None]

    def _forget(self, sender: tuple[int, int]) -> None:
        del self._clocks[sender], self._rates[sender]
        self._on_vehicle_clock.discard(sender)


def ranging_from_message(message: Message, measured_at_s: float) -> RangingMeasurement | None:
    """Return the measurement in a ranging message with its time on our clock; None: no ranging."""
    if isinstance(message, mavlink.MAVLink_landing_target_message):
        return _from_landing_target(message, measured_at_s)
    if isinstance(message, mavlink.MAVLink_ranging_beacon_message):
        return _from_ranging_beacon(message, measured_at_s)
    if not isinstance(message, MAVLink_radio_ranging_message):
        return None
    flags = message.flags
    # an arcsine is in the antenna's frame, never north-referenced, even without BODY_FRAME
    is_body = bool(flags & (BODY_FRAME | ARRAY_ANGLE))
    line_of_sight = None
    if flags & LINE_OF_SIGHT:
        line_of_sight = True
    elif flags & NON_LINE_OF_SIGHT:
        line_of_sight = False
    range_m, range_sigma_m, bearing_rad, bearing_sigma_rad = _or_none(
        message.range, message.range_std, message.bearing, message.bearing_std
    )
    elevation_rad, elevation_sigma_rad, power_dbm = _or_none(
        message.elevation, message.elevation_std, message.power
    )
    bearing_enu_rad = bearing_rad  # one in degrees stays, and is rejected later
    if abs(message.bearing) <= MAX_BEARING_RAD:
        bearing_enu_rad = math.remainder(math.pi / 2.0 - message.bearing, math.tau)
    return RangingMeasurement(
        emitter_id=message.emitter_id,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=range_m,
        range_sigma_m=range_sigma_m,
        bearing_enu_rad=None if is_body else bearing_enu_rad,
        bearing_body_rad=bearing_rad if is_body else None,
        bearing_sigma_rad=bearing_sigma_rad,
        elevation_rad=elevation_rad,
        elevation_sigma_rad=elevation_sigma_rad,
        power_dbm=power_dbm or None,  # 0: the sender has no such field
        is_array_angle=bool(flags & ARRAY_ANGLE),
        quality=None if message.quality == UINT8_MAX else message.quality / 100.0,
        line_of_sight=line_of_sight,
    )


def _from_landing_target(
    message: mavlink.MAVLink_landing_target_message, measured_at_s: float
) -> RangingMeasurement | None:
    """Convert LANDING_TARGET: `distance` is slant, 0 unknown; `angle_x` is from the nose.

    None for targets other than a radio beacon.
    """
    if message.type != mavlink.LANDING_TARGET_TYPE_RADIO_BEACON:
        return None
    range_m, bearing_body_rad = _or_none(message.distance, message.angle_x)
    return RangingMeasurement(
        emitter_id=message.target_num,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=None if range_m == 0.0 else range_m,
        bearing_body_rad=bearing_body_rad,
    )


def _from_ranging_beacon(
    message: mavlink.MAVLink_ranging_beacon_message, measured_at_s: float
) -> RangingMeasurement:
    """Convert RANGING_BEACON: millimetres, UINT32_MAX (or accuracy 0) is unknown.

    Its beacon position is not used: this project looks for the position of an emitter.
    """
    unknown_sigma = message.range_accuracy in (0, UINT32_MAX)
    return RangingMeasurement(
        emitter_id=message.beacon_id,
        measured_at_s=measured_at_s,
        stamp_us=message.time_usec,
        range_m=None if message.range == UINT32_MAX else message.range / 1000.0,
        range_sigma_m=None if unknown_sigma else message.range_accuracy / 1000.0,
    )


def _or_none(*values: float) -> list[float | None]:
    """Return the values of fields, NaN as None."""
    return [None if math.isnan(value) else float(value) for value in values]
