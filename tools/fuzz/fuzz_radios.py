"""Feeds every radio's decoder mutated streams; exit 1 if one breaks its guarantees.

A mutated stream is an example of the radio's with a few bytes changed, dropped, inserted, moved or
doubled. It is fed whole and once more in random pieces. Faults are an exception, an invalid reading
(NaN, a wrong type), different readings for a different cut, and a value that was never sent in a
frame whose checksum is wrong. A checksum of 8 bits is right by chance in one of 256 broken frames;
those are counted separately.

.venv/bin/python -m tools.fuzz.fuzz_radios [--streams 100000] [--seed 1] [--only nlink]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.entry import ignore_broken_pipe
from companion.radios.catalogue import BUILT_IN, radio_kind
from companion.radios.decoder import RadioDecoder, RadioReading
from companion.testing.radio_contract import fault_of, golden_lines, kept_bytes, noises, pieces
from tests.contract.radio_streams import CHECKSUMMED, OPTIONS, STREAMS

HEADER = (
    "radio         streams  exceptions  no readings  other by cut  past checksum  by chance"
    "  noise s  kept bytes"
)
MOST_CHANGES = 4
LONGEST_FRAME = 2048
Make = Callable[[], RadioDecoder]


@dataclass(slots=True)
class Findings:
    """Findings of one radio."""

    streams: int = 0
    exceptions: int = 0
    no_readings: int = 0
    other_by_cut: int = 0
    past_checksum: int = 0
    by_chance: int = 0
    noise_s: float = 0.0
    kept: int = 0

    @property
    def faults(self) -> int:
        """Number of faults."""
        return self.exceptions + self.no_readings + self.other_by_cut + self.past_checksum


def mutated(stream: bytes, rng: np.random.Generator) -> bytes:
    """Return a stream with one to a few changes."""
    data = bytearray(stream)
    for _ in range(rng.integers(1, MOST_CHANGES + 1)):
        at, other = (int(place) for place in rng.integers(0, len(data), 2))
        part = bytes(data[at : at + int(rng.integers(1, 40))])
        change = int(rng.integers(0, 6))
        if change == 0:
            data[at] ^= 1 << int(rng.integers(0, 8))
        elif change == 1:
            data[at] = int(rng.integers(0, 256))
        elif change == 2 and len(part) < len(data):
            del data[at : at + len(part)]
        elif change == 3:
            data[at:at] = rng.bytes(len(part))
        elif change == 4:
            data[other:other] = part
        else:
            data[other] = data[at]
    return bytes(data)


def cut(data: bytes, rng: np.random.Generator) -> list[bytes]:
    """Return the data in up to six pieces."""
    places = sorted(rng.integers(0, len(data) + 1, 5).tolist())
    return [data[a:b] for a, b in zip([0, *places], [*places, len(data)], strict=True)]


def right_sums(data: bytes) -> list[bytes]:
    """Return everything that could be an NLink frame by its first byte, length and sum."""
    frames = []
    for at in range(len(data) - 4):
        if data[at] not in (0x55, 0x6A):
            continue
        size = (
            128
            if data[at : at + 2] == b"\x55\x01"
            else int.from_bytes(data[at + 2 : at + 4], "little")
        )
        frame = data[at : at + size]
        if (
            5 <= size <= LONGEST_FRAME
            and len(frame) == size
            and sum(frame[:-1]) & 0xFF == frame[-1]
        ):
            frames.append(frame)
    return frames


def lines_of(readings: list[RadioReading]) -> Counter[str]:
    """Return readings that can be counted."""
    return Counter(golden_lines(readings).splitlines())


def try_one(
    make: Make, data: bytes, rng: np.random.Generator, found: Findings
) -> list[RadioReading]:
    """Feed a stream whole and in pieces; return its readings."""
    found.streams += 1
    try:
        readings = make().feed(data, 0.0)
        decoder = make()
        others = [reading for piece in cut(data, rng) for reading in decoder.feed(piece, 0.0)]
    except Exception as error:
        found.exceptions += 1
        print(f"{error!r} of {data.hex()}", file=sys.stderr)
        return []
    complaint = fault_of(readings)
    if complaint is not None:
        found.no_readings += 1
        print(f"{complaint} of {data.hex()}", file=sys.stderr)
        return []
    if readings != others:
        found.other_by_cut += 1
        print(f"another list by another cut of {data.hex()}", file=sys.stderr)
    return readings


def fuzz(name: str, streams: int, seed: int) -> Findings:
    """Test one radio."""
    rng = np.random.default_rng((seed, *name.encode()))
    kind, options = radio_kind(name), OPTIONS.get(name)
    stream = (STREAMS / f"{name}.bin").read_bytes()

    def make() -> RadioDecoder:
        return kind.decoder(options)

    found, sent = Findings(), lines_of(make().feed(stream, 0.0))
    for _ in range(streams):
        data = mutated(stream, rng)
        readings = try_one(make, data, rng, found)
        wrong = {line for line in lines_of(readings) if line not in sent}
        if name in CHECKSUMMED and wrong:
            lucky = [r for frame in right_sums(data) for r in make().feed(frame, 0.0)]
            past = wrong - set(lines_of(lucky))
            found.past_checksum += len(past)
            found.by_chance += len(wrong) - len(past)
    for noise in noises(stream, rng).values():
        decoder, began_s = make(), time.process_time()
        for piece in pieces(noise):
            decoder.feed(piece, 0.0)
        found.noise_s = max(found.noise_s, time.process_time() - began_s)
        found.kept = max(found.kept, kept_bytes(decoder))
    return found


def main() -> int:
    """Test all radios, print a line of each; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--streams", type=int, default=100_000, help="over all radios together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=sorted(BUILT_IN), help="one radio")
    args = parser.parse_args()
    names = [args.only] if args.only else list(BUILT_IN)
    each = -(-args.streams // len(names))
    print(HEADER)
    total = Findings()
    for name in names:
        f = fuzz(name, each, args.seed)
        past = f.past_checksum if name in CHECKSUMMED else "-"
        print(
            f"{name:12s} {f.streams:8d} {f.exceptions:11d} {f.no_readings:12d}"
            f" {f.other_by_cut:13d} {past:>14} {f.by_chance:10d} {f.noise_s:8.3f} {f.kept:11d}",
            flush=True,
        )
        total.streams += f.streams
        total.exceptions += f.faults
    print(f"{total.streams} streams, {total.exceptions} faults")
    return 1 if total.exceptions else 0


if __name__ == "__main__":
    ignore_broken_pipe()
    sys.exit(main())
