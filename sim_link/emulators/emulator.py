"""Base of all emulators: rounds of measurements in, bytes of a radio's own format out.

Theory of operation. A simulated radio asks its emitters in rounds. An emulator encodes a round as a
radio of one make prints it: in its own units and steps, with its own signs and clock, and with its
own output for missing measurements. Angles come as the antenna printed them, clockwise from its
boresight and upwards; which antenna that is, the scenario decides. It shares nothing with the
decoders: both are written from the same descriptions of the formats, and are compared in tests
only.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from companion.domain import RangingMeasurement
from sim_link.world.field_radio import Measures
from sim_link.world.radio_channel import AntennaKind

LIGHT_MPS = 299_792_458.0
U32 = 1 << 32
FLOOR_DBM, AT_ONE_METRE_DBM = -95.0, -45.0
"""Noise floor, and power received 1 m from an emitter, after the free-space law."""
LINE_END = "\r\n"
SIMULATION_BEGAN_S = 1_718_000_000.0
"""Unix time at the start of the simulation, for formats with wall-clock time."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Result of ranging one emitter."""

    emitter_id: int
    heard: RangingMeasurement | None = None
    """Angles in the antenna's frame as `bearing_body_rad` and `elevation_rad`; None: nothing."""

    @property
    def range_m(self) -> float | None:
        """Measured slant range, m; None: not measured."""
        return None if self.heard is None else self.heard.range_m

    @property
    def azimuth_rad(self) -> float | None:
        """Azimuth, clockwise from boresight; None: not measured."""
        return None if self.heard is None else self.heard.bearing_body_rad

    @property
    def elevation_rad(self) -> float | None:
        """Elevation, positive upwards; None: not measured."""
        return None if self.heard is None else self.heard.elevation_rad

    @property
    def quality(self) -> float:
        """Signal quality, 0 to 1; 1 where the radio reports none."""
        quality = None if self.heard is None else self.heard.quality
        return 1.0 if quality is None else quality

    @property
    def power_dbm(self) -> float:
        """Received power; by the free-space law, for the log only, if it was not measured."""
        if self.heard is not None and self.heard.power_dbm is not None:
            return self.heard.power_dbm
        distance_m = max(1.0, self.range_m or 30.0)
        return max(FLOOR_DBM, AT_ONE_METRE_DBM - 20.0 * math.log10(distance_m))


@dataclass(frozen=True, slots=True)
class Round:
    """All emitters that a radio asked at one time."""

    sent_at_s: float
    """Time of output on the vehicle's clock."""
    answers: tuple[Answer, ...]
    """One for each emitter that was asked, in the order of the scenario."""

    @property
    def heard(self) -> tuple[Answer, ...]:
        """Answers that carry a measurement."""
        return tuple(answer for answer in self.answers if answer.heard is not None)

    @property
    def lag_s(self) -> float:
        """Age of the oldest measurement at the time of output."""
        times = [answer.heard.measured_at_s for answer in self.answers if answer.heard is not None]
        return max(0.0, self.sent_at_s - min(times)) if times else 0.0


class Emulator(ABC):
    """One radio in operation.

    `clock_s` is its clock at the vehicle's second 0; `rng` is for invented values only.
    """

    name: ClassVar[str]
    """Name as in `sim-link radio --as NAME`."""
    title: ClassVar[str]
    antenna: ClassVar[AntennaKind] = "ideal"
    """Antenna of the real radio, emulated unless the scenario has another."""
    measures: ClassVar[Measures] = "range"
    rate_hz: ClassVar[float] = 10.0
    """Usual rate of the real radio."""
    names: ClassVar[str] = "{0}"
    """Template of an emitter's name, by its id (0) or address; empty if the format has no names."""
    first: ClassVar[int] = 0
    """Id in the format of emitter 0."""
    ids: ClassVar[range] = range(1 << 16)
    """Ids of the emitters that the format can name."""
    most: ClassVar[int] = 64
    """Emitters in a round."""
    reports_north: ClassVar[bool] = False
    """True if the format can carry a bearing from north."""
    request: ClassVar[bytes] = b""
    """Poll that each round needs; empty if the radio sends unprompted."""
    document: ClassVar[str | None] = None
    """Path that is polled by HTTP; None if the radio sends unprompted."""
    socket: ClassVar[str | None] = None
    """Path of a web socket; its bytes are frames of RFC 6455 then. None if it has none."""
    epoch_s: ClassVar[float] = 0.0
    """Epoch of its clock; 0 is power-on."""
    banner: ClassVar[bytes] = b""
    """Text that it prints at power-on."""

    def __init__(self, clock_s: float, rng: np.random.Generator) -> None:
        self._clock_s = clock_s
        self._rng = rng
        self._count = -1

    @abstractmethod
    def encode(self, asked: Round) -> bytes:
        """Encode one round as the radio prints it."""

    def hear(self, data: bytes) -> bytes:  # noqa: ARG002  most do not listen
        """Return the immediate answer to received bytes."""
        return b""

    def say(self, asked: Round) -> bytes:
        """Encode one round, and answer one poll if the radio must be polled."""
        return self.encode(asked) + self.hear(self.request)

    @classmethod
    def name_on_wire(cls, emitter_id: int) -> str:
        """Return the name of an emitter in this format; empty if the format has no names."""
        mac = mac_of(emitter_id)
        return cls.names.format(cls.first + emitter_id, mac=mac, mac_capitals=mac.upper())

    def device_s(self, sent_at_s: float) -> float:
        """Return the reading of the radio's clock."""
        return self.epoch_s + self._clock_s + sent_at_s

    def device_ms(self, sent_at_s: float) -> int:
        """Return the same in whole milliseconds."""
        return round(1e3 * self.device_s(sent_at_s))

    def next_number(self, modulus: int = U32) -> int:
        """Return the number of the round, which wraps to 0."""
        self._count = (self._count + 1) % modulus
        return self._count


class LineEmulator(Emulator):
    """A radio that prints lines for each emitter by itself: those that answered, or all."""

    prints_silence: ClassVar[bool] = False
    """True if an emitter that did not answer has a line, too."""

    def encode(self, asked: Round) -> bytes:
        """Return the lines of each emitter, in order."""
        answers = asked.answers if self.prints_silence else asked.heard
        return lines([text for each in answers for text in self.lines_of(each, asked)])

    @abstractmethod
    def lines_of(self, answer: Answer, asked: Round) -> Sequence[str]:
        """Return the lines of one emitter of a round."""


class RangeLines(LineEmulator):
    """A radio that prints a line, or several, for each range."""

    prints_silence = True
    silence: ClassVar[tuple[str, ...]] = ()
    """Lines for an emitter without a range."""
    line: ClassVar[str] = ""
    """Template of the line: `id` or `name`, `range_m` or the whole `mm`, `m` or `rtt_ns`, `ms` of
    the radio's clock, `dbm`, `percent` of the quality."""

    def lines_of(self, answer: Answer, asked: Round) -> Sequence[str]:
        """Return those of the range, or those of silence."""
        range_m, clock_ms = answer.range_m, self.device_ms(asked.sent_at_s)
        return self.silence if range_m is None else self.lines_at(range_m, answer, clock_ms)

    def lines_at(self, range_m: float, answer: Answer, clock_ms: int) -> Sequence[str]:
        """Return the lines of a range; by default the template's."""
        text = self.line.format(
            id=answer.emitter_id,
            name=self.name_on_wire(answer.emitter_id),
            range_m=range_m,
            mm=round(1e3 * range_m),
            m=round(range_m),
            rtt_ns=round(1e9 * round_trip_s(range_m)),
            ms=clock_ms % U32,
            dbm=round(answer.power_dbm),
            percent=round(100.0 * answer.quality),
        )
        return [text]


def lines(texts: Sequence[str]) -> bytes:
    """Return text as bytes with the line endings of a serial port."""
    return "".join(text + LINE_END for text in texts).encode("ascii")


def round_trip_s(range_m: float) -> float:
    """Return the round-trip time, s."""
    return 2.0 * range_m / LIGHT_MPS


def mac_of(emitter_id: int) -> str:
    """Return a locally administered address."""
    return f"02:00:00:00:{emitter_id >> 8:02x}:{emitter_id & 0xFF:02x}"


def clamped(value: float, low: int, high: int) -> int:
    """Return the nearest whole number that a field holds."""
    return max(low, min(high, round(value)))
