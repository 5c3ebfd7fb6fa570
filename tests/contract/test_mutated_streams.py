"""Every radio's decoder keeps its guarantees on mutated streams.

A mutated stream is an example of the radio's with a few bytes changed, dropped, inserted, moved or
doubled. It is fed whole and once more in random pieces. Faults are an exception, an invalid reading
(NaN, a wrong type), different readings for a different cut, and a value that was never sent in a
frame whose checksum is wrong. A checksum of 8 bits is right by chance in one of 256 broken frames;
those are not faults.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from companion.radios.decoder import BUILT_IN, RadioDecoder, RadioReading, radio_kind
from companion.testing.radio_contract import fault_of, golden_lines
from tests.contract.radio_streams import CHECKSUMMED, OPTIONS, STREAMS

MAX_CHANGES = 4
LONGEST_FRAME = 2048
Make = Callable[[], RadioDecoder]


def mutated(stream: bytes, rng: np.random.Generator) -> bytes:
    """Return a stream with one to a few changes."""
    data = bytearray(stream)
    for _ in range(rng.integers(1, MAX_CHANGES + 1)):
        at, other = (int(index) for index in rng.integers(0, len(data), 2))
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
    cuts = sorted(rng.integers(0, len(data) + 1, 5).tolist())
    return [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]


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


def readings_of(make: Make, data: bytes, rng: np.random.Generator) -> list[RadioReading]:
    """The readings of a stream, the same fed whole and in pieces."""
    readings = make().feed(data, 0.0)
    decoder = make()
    others = [reading for piece in cut(data, rng) for reading in decoder.feed(piece, 0.0)]
    assert fault_of(readings) is None
    assert readings == others, "another list by another cut"
    return readings


@pytest.mark.parametrize(
    "streams", [20, pytest.param(3_000, marks=pytest.mark.campaign)], ids=["some", "many"]
)
@pytest.mark.parametrize("name", BUILT_IN)
def test_mutated_streams_give_readings_that_were_sent(name: str, streams: int) -> None:
    rng = np.random.default_rng((1, *name.encode()))
    kind, options = radio_kind(name), OPTIONS.get(name)
    stream = (STREAMS / f"{name}.bin").read_bytes()

    def make() -> RadioDecoder:
        return kind.decoder(options)

    sent = lines_of(make().feed(stream, 0.0))
    for _ in range(streams):
        data = mutated(stream, rng)
        try:
            wrong = {line for line in lines_of(readings_of(make, data, rng)) if line not in sent}
        except Exception as error:
            pytest.fail(f"{error!r} of {data.hex()}")
        if name in CHECKSUMMED and wrong:
            lucky = [r for frame in right_sums(data) for r in make().feed(frame, 0.0)]
            assert wrong <= set(lines_of(lucky)), f"past the checksum: {data.hex()}"
