"""The contract of a radio's decoder, checked in one call.

    check_radio(KIND, Path("stream.bin").read_bytes(), Path("golden.jsonl"))

The stream is an example of the radio's output: whole frames or lines, at best one of each kind,
about a hundred bytes, that mean the same when they are sent again. The golden file has a reading a
line, as `golden_lines` writes it. A broken rule raises `ContractError`, an AssertionError.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path

import msgspec
import numpy as np

from companion.domain import Params
from companion.radios.decoder import (
    MAX_KEPT_BYTES,
    MAX_REASONS,
    RadioDecoder,
    RadioKind,
    RadioReading,
)

NOISE_BYTES = 1_000_000
TORN_BYTES = 200_000
"""Bytes of torn pieces: they contain much to decode."""
MAX_NOISE_S = 1.0
"""Longest processor time for each kind of noise."""
PIECE_BYTES = 4096
SETTLED_BYTES = 8192
"""Length of a good stream after which earlier data no longer matter."""
GARBAGE_BYTES = 300
FLIPS = (0x01, 0x20, 0x80, 0xFF)
NAME = re.compile(r"[a-z][a-z0-9_]*")
FREE_TEXT = bytes(range(0x20, 0x7F))
_DEFAULTS = {field.name: field.default for field in fields(RadioReading)}


class ContractError(AssertionError):
    """A decoder breaks the contract of all radios."""


@dataclass(frozen=True, slots=True)
class ContractFigures:
    """Figures measured by the check."""

    readings: int
    slowest_noise_s: float
    """Processor time of the slowest kind of noise."""
    most_kept_bytes: int
    """Maximum memory kept between two calls, in the noise."""


def check_radio(
    kind: RadioKind,
    stream: bytes,
    expected: Sequence[RadioReading] | Path,
    *,
    options: Params | None = None,
    has_checksum: bool = False,
    repeats: bool = True,
) -> ContractFigures:
    """Check a radio's decoder with a stream and its readings (or the golden file).

    With `has_checksum` a flipped byte may lose readings, but never change one. Without `repeats`
    the decoder drops repeated readings itself.
    """
    readings = read_golden(expected) if isinstance(expected, Path) else list(expected)
    trial = _Trial(lambda: kind.decoder(options), stream, readings, repeats)
    if not NAME.fullmatch(kind.name):
        raise ContractError(f"name `{kind.name}`: lower case, digits and underscores")
    for name in ("title", "gives", "emitter", "transport"):
        if not getattr(kind, name):
            raise ContractError(f"{name} is empty")
    trial.check_splits()
    trial.check_flips(has_checksum)
    trial.check_garbage()
    slowest_s, kept = trial.check_noise()
    return ContractFigures(len(readings), slowest_s, kept)


def golden_lines(readings: Iterable[RadioReading]) -> str:
    """Return readings in the form of the golden file: JSON, without default values."""
    return "".join(f"{msgspec.json.encode(_values(reading)).decode()}\n" for reading in readings)


def read_golden(path: Path) -> list[RadioReading]:
    """Return the readings of a golden file."""
    lines = path.read_bytes().splitlines()
    return [msgspec.json.decode(line, type=RadioReading) for line in lines if line.strip()]


def fault_of(readings: object) -> str | None:
    """Return the fault in a decoder's result for any input; None without a fault."""
    if not isinstance(readings, list):
        return f"feed returned {type(readings).__name__}, not a list"
    for reading in readings:
        if not isinstance(reading, RadioReading):
            return f"feed returned a {type(reading).__name__} in its list"
        if isinstance(reading.emitter, bool) or not isinstance(reading.emitter, str | int | None):
            return f"an emitter is a {type(reading.emitter).__name__}"
        for name, value in _values(reading).items():
            if isinstance(value, float) and not math.isfinite(value):
                return f"{name} is {value}; what was not measured is None"
            if name.endswith("sigma_m") and isinstance(value, float) and value < 0.0:
                return f"{name} is negative"
    return None


def kept_bytes(decoder: RadioDecoder) -> int:
    """Return the memory of a decoder and all its references, without code and options."""
    total, seen, waiting = 0, {id(decoder.options)}, list(_parts(decoder))
    while waiting:
        part = waiting.pop()
        if id(part) in seen or isinstance(part, type | Enum) or callable(part):
            continue
        seen.add(id(part))
        total += sys.getsizeof(part)
        waiting += _parts(part)
    return total


def noises(stream: bytes, rng: np.random.Generator) -> dict[str, bytes]:
    """Return random bytes and endless text, a megabyte each, and torn pieces of the stream."""
    cuts = rng.integers(0, len(stream) + 1, (4 * TORN_BYTES // len(stream), 2))
    torn = b"".join(stream[min(pair) : max(pair)] for pair in cuts.tolist())
    letters = rng.integers(0, len(FREE_TEXT), NOISE_BYTES)
    return {
        "any bytes": rng.bytes(NOISE_BYTES),
        "text without end": np.frombuffer(FREE_TEXT, np.uint8)[letters].tobytes(),
        "torn pieces": torn[:TORN_BYTES],
    }


def pieces(data: bytes, size: int = PIECE_BYTES) -> Iterator[bytes]:
    """Yield data in pieces, as it arrives on a line."""
    return (data[at : at + size] for at in range(0, len(data), size))


class _Trial:
    """One decoder, one stream, and its expected readings."""

    def __init__(
        self,
        make: Callable[[], RadioDecoder],
        stream: bytes,
        expected: list[RadioReading],
        repeats: bool,
    ) -> None:
        self.make = make
        self.stream = stream
        self.expected = expected
        self.repeats = repeats
        self.rng = np.random.default_rng(len(stream))
        if not stream or not expected:
            raise ContractError("there must be a stream, and readings in it")

    def feed(
        self, what: str, *parts: bytes, decoder: RadioDecoder | None = None
    ) -> list[RadioReading]:
        """Return the readings of parts that are fed one by one."""
        decoder = decoder or self.make()
        readings: list[RadioReading] = []
        for number, part in enumerate(parts):
            try:
                found = decoder.feed(part, float(number))
            except Exception as error:
                raise ContractError(f"{what}: feed raised {error!r}") from error
            complaint = fault_of(found)
            if complaint is not None:
                raise ContractError(f"{what}: {complaint}")
            readings += found
        if len(decoder.counts.refused) > MAX_REASONS + 1:
            raise ContractError(f"{what}: refused by too many reasons; use counts.refuse")
        return readings

    def check_splits(self) -> None:
        """Check the whole, byte by byte, cut in two at every byte, and restarted at every byte."""
        stream = self.stream
        decoder = self.make()
        self._same("the stream", self.feed("the stream", stream, decoder=decoder))
        if decoder.counts.readings != len(self.expected):
            raise ContractError(f"counts.readings is {decoder.counts.readings}")
        self._same("byte by byte", self.feed("byte by byte", *pieces(stream, 1)))
        for at in range(len(stream) + 1):
            what = f"cut at byte {at}"
            self._same(what, self.feed(what, stream[:at], b"", stream[at:]))
            what = f"line lost at byte {at}"
            decoder = self.make()
            self.feed(what, stream[:at], decoder=decoder)
            decoder.reset()
            self._again(what, self.feed(what, stream, decoder=decoder))

    def check_flips(self, has_checksum: bool) -> None:
        """Check one byte flipped at each position, in every way where no value may come of it."""
        there = Counter(golden_lines(self.expected).splitlines())
        for at in range(len(self.stream)):
            for flip in FLIPS if has_checksum else (FLIPS[at % len(FLIPS)],):
                what = f"byte {at} flipped by 0x{flip:02x}"
                flipped = bytes([self.stream[at] ^ flip])
                found = self.feed(what, self.stream[:at] + flipped + self.stream[at + 1 :])
                wrong = Counter(golden_lines(found).splitlines()) - there
                if has_checksum and wrong:
                    raise ContractError(f"{what}: read {next(iter(wrong))}")

    def check_garbage(self) -> None:
        """Check that garbage before loses only the beginning, and garbage after loses nothing."""
        good = self.stream * (1 + -(-SETTLED_BYTES // len(self.stream)))
        for number in range(10):
            what = f"garbage {number}"
            garbage = self.rng.bytes(GARBAGE_BYTES)
            found = self.feed(f"{what} before", garbage, good)[-len(self.expected) :]
            self._again(f"{what} before", found)
            found = self.feed(f"{what} after", self.stream, garbage)[: len(self.expected)]
            self._same(f"{what} after", found)

    def check_noise(self) -> tuple[float, int]:
        """Return the seconds of the slowest noise, and the most bytes kept."""
        slowest_s, most = 0.0, 0
        for what, noise in noises(self.stream, self.rng).items():
            decoder = self.make()
            empty = kept_bytes(decoder)
            begun_s = time.process_time()
            for piece in pieces(noise):
                self.feed(what, piece, decoder=decoder)
            spent_s = time.process_time() - begun_s
            kept = kept_bytes(decoder) - empty
            slowest_s, most = max(slowest_s, spent_s), max(most, kept)
            if spent_s > MAX_NOISE_S:
                raise ContractError(f"{len(noise)} bytes of {what} take {spent_s:.1f} s")
            if kept > MAX_KEPT_BYTES:
                raise ContractError(f"{kept} bytes are kept of {what}")
            decoder.reset()
            self._again(f"after {what}", self.feed(f"after {what}", self.stream, decoder=decoder))
        return slowest_s, most

    def _again(self, what: str, found: list[RadioReading]) -> None:
        """Check for the same readings, or for new ones in their order."""
        rest = iter(self.expected)
        if self.repeats or not all(reading in rest for reading in found):
            self._same(what, found)

    def _same(self, what: str, found: list[RadioReading]) -> None:
        if found == self.expected:
            return
        lines, wanted = (golden_lines(each).splitlines() for each in (found, self.expected))
        for number, (line, other) in enumerate(zip(lines, wanted, strict=False), start=1):
            if line != other:
                raise ContractError(f"{what}: reading {number} is {line}, not {other}")
        raise ContractError(f"{what}: {len(lines)} readings, not {len(wanted)}")


def _values(reading: RadioReading) -> dict[str, object]:
    """Return the fields of a reading that differ from their default."""
    values = {name: getattr(reading, name) for name in _DEFAULTS}
    return {name: value for name, value in values.items() if value != _DEFAULTS[name]}


def _parts(value: object) -> list[object]:
    """Return the values that a value refers to."""
    if isinstance(value, dict):
        return [*value, *value.values()]
    if isinstance(value, list | tuple | set | frozenset | deque):
        return list(value)
    if isinstance(value, str | bytes | bytearray | int | float | None):
        return []
    slots = [getattr(value, name, None) for name in getattr(type(value), "__slots__", ())]
    return [*vars(value).values(), *slots] if hasattr(value, "__dict__") else slots
