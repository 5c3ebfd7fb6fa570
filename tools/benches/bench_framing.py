"""Frames per second that one core splits, verifies, refuses and decodes, beside pymavlink's parser.

.venv/bin/python tools/benches/bench_framing.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

from companion.entry import ignore_broken_pipe
from companion.mav.codec import CRC_EXTRA_BY_ID, MavCodec
from companion.mav.dialect import mavlink
from companion.mav.framing import FrameSplitter
from companion.mav.signing import LinkSigning, Signing, SigningKey

FRAMES = 20_000
REPEATS = 5
KEY, OTHER_KEY = SigningKey(bytes(range(1, 33))), SigningKey(bytes(range(2, 34)))
NOW = 10**13
MESSAGES = [
    mavlink.MAVLink_local_position_ned_message(n, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0) for n in range(200)
]

Take = Callable[[bytes], object]


def frames_of(codec: MavCodec) -> list[bytes]:
    """Return the messages as bytes."""
    return [codec.encode(message) for message in MESSAGES]


def rate(make: Callable[[], Take], frames: list[bytes]) -> float:
    """Return the best of a few runs, frames per second of processor time."""
    best = 0.0
    for _ in range(REPEATS):
        take = make()
        began_s = time.process_time()
        for number in range(FRAMES):
            take(frames[number % len(frames)])
        best = max(best, FRAMES / (time.process_time() - began_s))
    return best


def splitting() -> Take:
    """Return the splitter alone: length, checksum."""
    splitter = FrameSplitter(CRC_EXTRA_BY_ID)
    return lambda data: splitter.split(data, is_datagram=True)


def decoding(key: SigningKey | None) -> Take:
    """Return the project's codec, with or without a key."""
    signing = None if key is None else LinkSigning(Signing(key, NOW), 0)
    return MavCodec(1, 191, signing).decode


def pymavlink(key: SigningKey | None) -> Take:
    """Return pymavlink's parser, with or without a key."""
    mav = mavlink.MAVLink(None)
    mav.robust_parsing = True
    if key is not None:
        mav.signing.secret_key = key.secret
        mav.signing.allow_unsigned_callback = lambda *_: False
    return lambda data: mav.parse_char(data)


def main() -> None:
    """Measure every case on the same bytes, and print a line for each."""
    plain = frames_of(MavCodec(1, 1))
    forged = frames_of(MavCodec(1, 1, LinkSigning(Signing(OTHER_KEY, NOW), 0)))
    cases: list[tuple[str, Callable[[], Take], list[bytes]]] = [
        ("cut and CRC", splitting, plain),
        ("cut, CRC, forged signature refused", lambda: decoding(KEY), forged),
        ("cut, CRC, unsigned refused", lambda: decoding(KEY), plain),
        ("cut, CRC, decoded", lambda: decoding(None), plain),
        ("pymavlink, decoded", lambda: pymavlink(None), plain),
        ("pymavlink, forged signature refused", lambda: pymavlink(KEY), forged),
    ]
    for name, make, frames in cases:
        print(f"{name:36s} {rate(make, frames):9.0f} frames/s")


if __name__ == "__main__":
    ignore_broken_pipe()
    main()
