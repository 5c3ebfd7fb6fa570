"""Effects of each link or content fault on a datagram that is sent while it acts.

Faults of the link make it lost, late, damaged or copied. Those of content change frames from the
vehicle and its radio, but keep ids, sequence number and, with the key, a valid signature. Every
effect owns its generator, so that adding one fault never changes what another one draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from companion.mav import codec
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message as RadioRanging
from companion.mav.dialect import mavlink
from companion.mav.signing import HASH_LENGTH, SigningKey, is_signed
from sim_link.autopilot.incidents import FaultRecord
from sim_link.autopilot.protocols.message_streams import message_id, message_ids
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.observer import Delivery

F = TypeVar("F", bound=FaultRecord)
G = TypeVar("G", bound=faults.ContentFault)
T = TypeVar("T")
NO_MAGIC = bytes(set(range(256)) - {0xFD, 0xFE})
"""Bytes that begin no frame."""


class FaultEffect(Generic[F]):
    """One fault, in one direction if it has one, until its end on the caller's clock.

    Effect described by its record. With a key changed frames are signed again.
    """

    def __init__(
        self, fault: F, rng: np.random.Generator, began_s: float, key: SigningKey | None = None
    ) -> None:
        self.fault = fault
        self._rng = rng
        self.start_s, self.end_s = began_s + fault.start_s, began_s + fault.end_s
        self._key = key

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:  # noqa: ARG002
        """Return the deliveries of a datagram sent at `now_s`, given those without this fault."""
        return [each for due_s, data in deliveries for each in self._pass(data, due_s)]

    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        """Return the deliveries that replace one delivery; by default none."""
        del data, due_s
        return []

    def watch(self, data: bytes) -> None:
        """Observe a datagram that passes while the fault is inactive."""

    def _happens(self, share: float) -> bool:
        return float(self._rng.random()) < share

    def _any_of(self, choices: Sequence[T]) -> T:
        return choices[int(self._rng.integers(len(choices)))]


class LinkEffect(FaultEffect[faults.LinkFault]):
    """A fault of the link that treats each delivery by itself."""

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Return the deliveries that replace them; copies come after all the originals."""
        kept = deliveries if isinstance(self.fault, faults.LinkDuplicates) else []
        return kept + super().apply(deliveries, now_s)

    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        match self.fault:
            case faults.LinkLoss(share=share):
                return [] if self._happens(share) else [(due_s, data)]
            case faults.LinkDelay(delay_s=delay_s):
                return [(due_s + delay_s, data)]
            case faults.LinkHold():
                return [(max(due_s, self.end_s), data)]
            case faults.LinkJitter(jitter_s=jitter_s, share=share):
                hit, late = self._rng.random(2).tolist()
                return [(due_s + (late * jitter_s if hit < share else 0.0), data)]
            case faults.LinkDuplicates(copies=copies, spread_s=spread_s, share=share):
                count = copies if self._happens(share) else 0
                late_s = self._rng.uniform(0.0, spread_s, count).tolist()
                return [(due_s + each_s, data) for each_s in late_s]
            case faults.LinkBitFlips() | faults.LinkTruncation() | faults.LinkGarbage() as fault:
                damaged = self._damage(fault, data) if self._happens(fault.share) else data
                return [(due_s, damaged)]
        return []

    def _damage(
        self, fault: faults.LinkBitFlips | faults.LinkTruncation | faults.LinkGarbage, data: bytes
    ) -> bytes:
        match fault:
            case faults.LinkBitFlips(bits=bits):
                flipped = bytearray(data)
                for bit in self._rng.integers(0, 8 * len(data), bits).tolist():
                    flipped[bit // 8] ^= 1 << bit % 8
                return bytes(flipped)
            case faults.LinkTruncation():
                return data[: int(self._rng.integers(1, max(2, len(data))))]
            case faults.LinkGarbage(most_bytes=most):
                count = int(self._rng.integers(1, most + 1))
                junk = self._rng.integers(0, len(NO_MAGIC), count).tolist()
                return bytes(NO_MAGIC[each] for each in junk) + data


class _Bursts(FaultEffect[faults.LinkBursts]):
    _is_bad = False
    _until_s: float | None = None

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Drop deliveries that fall into a bad period."""
        fault = self.fault
        if self._until_s is None:
            self._until_s = now_s + float(self._rng.exponential(fault.mean_good_s))
        while self._until_s <= now_s:
            self._is_bad = not self._is_bad
            mean_s = fault.mean_bad_s if self._is_bad else fault.mean_good_s
            self._until_s += float(self._rng.exponential(mean_s))
        share = fault.loss_bad if self._is_bad else fault.loss_good
        return [each for each in deliveries if not self._happens(share)]


class _RateCap(FaultEffect[faults.LinkRateCap]):
    _free_s = 0.0

    def apply(self, deliveries: list[Delivery], now_s: float) -> list[Delivery]:
        """Delay each frame behind earlier ones, and lose it if the queue is full."""
        bytes_per_s = self.fault.bits_per_s / 8.0
        through: list[Delivery] = []
        for due_s, data in deliveries:
            begin_s = max(now_s, self._free_s)
            if begin_s - now_s > self.fault.queue_bytes / bytes_per_s:
                continue
            self._free_s = begin_s + len(data) / bytes_per_s
            through.append((max(due_s, self._free_s), data))
        return through


LINK_EFFECTS: dict[type[FaultRecord], type[FaultEffect[Any]]] = {
    faults.LinkBlackout: LinkEffect,
    faults.LinkLoss: LinkEffect,
    faults.LinkBursts: _Bursts,
    faults.LinkBitFlips: LinkEffect,
    faults.LinkTruncation: LinkEffect,
    faults.LinkGarbage: LinkEffect,
    faults.LinkDuplicates: LinkEffect,
    faults.LinkDelay: LinkEffect,
    faults.LinkJitter: LinkEffect,
    faults.LinkRateCap: _RateCap,
    faults.LinkHold: LinkEffect,
}
"""Effects by fault, in the order in which they act on one datagram."""


_READER = MavCodec(9, 9)


def rewrite_frame(frame: bytes, change: Callable[[Any], None], key: SigningKey | None) -> bytes:
    """Return the frame with changed fields, signed again with the key; unreadable: unchanged."""
    if is_signed(frame) and key is None:
        return frame
    message = _READER.decode_frame(frame)
    if message is None:
        return frame
    change(message)
    mav = mavlink.MAVLink(
        None, srcSystem=message.get_srcSystem(), srcComponent=message.get_srcComponent()
    )
    mav.seq = message.get_seq()
    packed: bytes = message.pack(mav, force_mavlink1=frame[0] == codec.MAGIC_V1)
    return packed if not is_signed(frame) or key is None else _sign_like(packed, frame, key)


def _sign_like(packed: bytes, model: bytes, key: SigningKey) -> bytes:
    """Return `packed` with the link id and timestamp of `model`'s signature."""
    end = codec.HEADER_LENGTH[codec.MAGIC_V2] + packed[1]
    head = packed[:2] + bytes((packed[2] | codec.INCOMPAT_SIGNED,)) + packed[3:end]
    crc = codec.frame_crc(head, CRC_EXTRA_BY_ID[codec.message_id(packed)])
    head += crc.to_bytes(codec.CRC_LENGTH, "little")
    head += model[-codec.SIGNATURE_LENGTH : -HASH_LENGTH]
    return head + key.signature_of(head)


NOT_A_RANGE = (math.nan, math.inf, -math.inf, 0.0, -12.5, 1e-42, 1e30)
NOT_A_BEARING = (math.nan, math.inf, -math.inf, 400.0, -1e9)
REPORTS = message_ids(
    "LOCAL_POSITION_NED GLOBAL_POSITION_INT ATTITUDE SYS_STATUS BATTERY_STATUS HOME_POSITION "
    "GPS_GLOBAL_ORIGIN GPS_RAW_INT ESTIMATOR_STATUS"
)
CLOCK_FIELDS = frozenset({"time_boot_ms", "time_usec"})
INTEGER_LIMITS = {f"uint{bits}_t": (0, 2**bits - 1) for bits in (8, 16, 32)}
INTEGER_LIMITS |= {f"int{bits}_t": (-(2**bits) // 2, 2**bits // 2 - 1) for bits in (8, 16, 32)}
ABSURD_FLOATS = (math.nan, math.inf, -math.inf, 1e30)


def _number_of(data: bytes) -> int | None:
    """Return the message id; None if the data are too short for a frame."""
    is_long = len(data) > codec.HEADER_LENGTH[codec.MAGIC_V2]
    return codec.message_id(data) if is_long else None


class ContentEffect(FaultEffect[G]):
    """A fault in frames with certain message ids, by default the radio's."""

    def _pass(self, data: bytes, due_s: float) -> list[Delivery]:
        self.watch(data)
        number = _number_of(data)
        is_meant = number is not None and self._is_about(number)
        return self._alter(data, due_s) if is_meant else [(due_s, data)]

    def _is_about(self, number: int) -> bool:
        match self.fault:
            case faults.StreamMute(message=name):
                return number == message_id(name)
            case faults.TelemetryNonsense():
                return number in REPORTS
        return number == RadioRanging.id

    def _alter(self, data: bytes, due_s: float) -> list[Delivery]:
        """Return the deliveries that replace a frame with an affected message id."""
        match self.fault:
            case faults.StreamMute() | faults.RangingDropout(missing="both"):
                return []
            case faults.RangingStale(age_s=age_s):
                return [(due_s + age_s, data)]
            case faults.RangingOutOfOrder(window_s=window_s):
                return [(due_s + float(self._rng.uniform(0.0, window_s)), data)]
            case faults.TelemetryNonsense(share=share) if not self._happens(share):
                return [(due_s, data)]
        return [(due_s, rewrite_frame(data, self._change, self._key))]

    def _change(self, message: Any) -> None:
        """Set the fields that are wrong."""
        match self.fault:
            case faults.TelemetryNonsense():
                kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
                names = [
                    name
                    for name in message.fieldnames
                    if name not in CLOCK_FIELDS and not isinstance(getattr(message, name), list)
                ]
                name = self._any_of(names)
                is_float = kinds[name] == "float"
                choices = ABSURD_FLOATS if is_float else INTEGER_LIMITS[kinds[name]]
                setattr(message, name, self._any_of(choices))
            case faults.RangingDropout(missing=name):
                setattr(message, name, math.nan)
            case faults.RangingWrongUnit(of=of, factor=factor):
                for name in ("range", "bearing"):
                    if of in (name, "both"):
                        setattr(message, name, getattr(message, name) * factor)
            case faults.RangingNan(share=share):
                if self._happens(share):
                    message.range = self._any_of(NOT_A_RANGE)
                if self._happens(share):
                    message.bearing = self._any_of(NOT_A_BEARING)


class _Freeze(ContentEffect[faults.RangingFreeze]):
    FIELDS = ("range", "range_std", "bearing", "bearing_std", "elevation", "elevation_std")
    _kept: dict[str, float] | None = None

    def _change(self, message: Any) -> None:
        if self._kept is None:
            self._kept = {name: getattr(message, name) for name in self.FIELDS}
        for name, value in self._kept.items():
            setattr(message, name, value)


class _Outliers(ContentEffect[faults.RangingOutliers]):
    SHORTEST_M = 0.1
    """Shortest range after a fault has shortened it, metres."""
    _left = 0
    """Remaining answers of the current burst."""

    def _change(self, message: Any) -> None:
        if self._left == 0 and self._happens(self.fault.share):
            self._left = self.fault.burst
        if self._left == 0:
            return
        self._left -= 1
        mean_m = self.fault.excess_m
        excess_m = math.copysign(float(self._rng.exponential(abs(mean_m))), mean_m)
        message.range = max(self.SHORTEST_M, message.range + excess_m)
        if self.fault.is_bearing_hit:
            message.bearing = float(self._rng.uniform(-math.pi, math.pi))


class _SecondEmitter(ContentEffect[faults.RangingSecondEmitter]):
    RANGE_SIGMA_M = 0.5
    BEARING_SIGMA_RAD = 0.03
    _vehicle_ned_m: tuple[float, float, float] | None = None

    def watch(self, data: bytes) -> None:
        """Track the vehicle's position from its own reports."""
        if _number_of(data) == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            rewrite_frame(data, self._note_position, self._key)

    def _note_position(self, message: Any) -> None:
        self._vehicle_ned_m = (message.x, message.y, message.z)

    def _alter(self, data: bytes, due_s: float) -> list[Delivery]:
        is_located = self._vehicle_ned_m is not None
        return [(due_s, data), *(super()._alter(data, due_s) if is_located else ())]

    def _change(self, message: Any) -> None:
        assert self._vehicle_ned_m is not None
        north, east, down = self._vehicle_ned_m
        to_east, to_north = self.fault.east_m - east, self.fault.north_m - north
        noise_m, noise_rad = self._rng.standard_normal(2).tolist()
        message.range = math.hypot(to_east, to_north, down) + self.RANGE_SIGMA_M * noise_m
        message.bearing = math.atan2(to_east, to_north) + self.BEARING_SIGMA_RAD * noise_rad
        message.flags = 0
        if self.fault.emitter_id is not None:
            message.emitter_id = self.fault.emitter_id


CONTENT_EFFECTS: dict[type[FaultRecord], type[FaultEffect[Any]]] = {
    faults.RangingFreeze: _Freeze,
    faults.RangingOutliers: _Outliers,
    faults.RangingSecondEmitter: _SecondEmitter,
}
"""Effects that remember something."""
