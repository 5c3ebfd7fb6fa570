"""What a measurement of each radio costs, beside RADIO_RANGING, and how soon a setpoint follows it.

.venv/bin/python tools/bench_radios.py [--rounds N] [NAME ...]

A round is printed by the emulator beforehand; what is timed is its decoder and the common stage, in
processor time, the best of five runs. Ratios are of one run and therefore of one machine.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np

from companion.domain import RangingMeasurement
from companion.entry import outlive_readers
from companion.link.radio_stage import RadioSettings, RadioSetup, RadioStage
from companion.link.ranging_sources import ranging_from_message
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message
from companion.mav.ranging import message_from_ranging
from companion.radios.catalogue import radio_kind
from sim_link.emulators.catalogue import EMULATORS, make_emulator
from sim_link.emulators.emulator import Answer, Round
from tools.console import OneLineParser, positive

REPEATS = 5
FAST_HZ, ANCHORS, SHARE_LIMIT = 200.0, 8, 0.03
"""The promise: NLink at that rate with so many anchors costs no more of a core."""
PATTERN = r"(?P<emitter>[0-9A-F:]{17}),(?P<range_m>[\d.]+) m"
OPTIONS: dict[str, dict[str, object]] = {
    "lines": {"pattern": PATTERN},
    "srsran": {"loop_is_off": True},
}
RADIO_OF = {"esp32_arduino": "esp32_ftm"}

Bytes = Sequence[tuple[bytes, float]]
"""What was printed, and when."""
Take = Callable[[bytes, float], int]
"""Bytes and time to how many measurements they complete."""


def radio_of(name: str) -> str:
    """The decoder of an emulator."""
    return "nlink" if name.startswith("nlink_") else RADIO_OF.get(name, name)


def rounds_of(rounds: int, emitters: int, rate_hz: float) -> list[Round]:
    """Of a radio that all of them answer."""
    rng = np.random.default_rng(7)
    return [
        Round(
            1.0 + number / rate_hz,
            tuple(
                Answer(emitter_id, _drawn(rng, emitter_id, 1.0 + number / rate_hz))
                for emitter_id in range(emitters)
            ),
        )
        for number in range(rounds)
    ]


def _drawn(rng: np.random.Generator, emitter_id: int, told_s: float) -> RangingMeasurement:
    return RangingMeasurement(
        emitter_id,
        told_s,
        float(rng.uniform(3.0, 200.0)),
        1.0,
        bearing_body_rad=float(rng.uniform(-1.0, 1.0)),
        bearing_sigma_rad=0.1,
        elevation_rad=float(rng.uniform(-1.0, 1.0)),
        is_array_angle=True,
    )


def radio_case(name: str, asked: Sequence[Round]) -> tuple[Callable[[], Take], Bytes]:
    """A stage that is started anew, and what it reads."""
    kind = radio_kind(radio_of(name))
    options = msgspec.convert(OPTIONS.get(name, {}), kind.decoder.Options)
    settings: RadioSettings = msgspec.convert(dict(kind.defaults), RadioSettings)
    emulator = make_emulator(name, 1, 100.0)
    printed = [(emulator.boot() or b"\n", 0.5)]
    printed += [(emulator.tell(each), each.told_s) for each in asked]

    def start() -> Take:
        stage = RadioStage(RadioSetup(kind, settings, options))
        return lambda data, now_s: len(stage.receive(data, now_s))

    return start, [(data, now_s) for data, now_s in printed if data]


def mavlink_case(asked: Sequence[Round]) -> tuple[Callable[[], Take], Bytes]:
    """The same measurements as RADIO_RANGING: a frame each."""
    codec = MavCodec(1, 25)
    frames = [
        (codec.encode(message_from_ranging(answer.heard, round(1e6 * each.told_s))), each.told_s)
        for each in asked
        for answer in each.answers
        if answer.heard is not None
    ]

    def start() -> Take:
        reader = MavCodec(1, 191)

        def take(data: bytes, now_s: float) -> int:
            found = 0
            for message in reader.decode(data):
                if isinstance(message, MAVLink_radio_ranging_message):
                    found += ranging_from_message(message, now_s) is not None
            return found

        return take

    return start, frames


def cost_s(start: Callable[[], Take], printed: Bytes) -> tuple[float, int]:
    """Processor time of all of it, the best of some runs, and how much was measured."""
    best_s, measured = math.inf, 0
    for _ in range(REPEATS):
        take = start()
        began_s = time.process_time()
        measured = sum(take(data, now_s) for data, now_s in printed)
        best_s = min(best_s, time.process_time() - began_s)
    return best_s, measured


def main() -> int:
    """Measure, and print a line for each radio."""
    arguments = parsed()
    asked = rounds_of(arguments.rounds, 1, 10.0)
    start, frames = mavlink_case(asked)
    total_s, measured = cost_s(start, frames)
    mavlink_us = 1e6 * total_s / measured
    print(f"{'RADIO_RANGING':16s} {mavlink_us:7.1f} us a measurement")
    for name in arguments.names or sorted(EMULATORS):
        total_s, measured = cost_s(*radio_case(name, asked))
        each_us = 1e6 * total_s / max(1, measured)
        print(f"{name:16s} {each_us:7.1f} us a measurement, {each_us / mavlink_us:5.2f} times that")
    many = rounds_of(arguments.rounds, ANCHORS, FAST_HZ)
    for name in ("nlink_aoa", "nlink_node3"):
        total_s, measured = cost_s(*radio_case(name, many))
        share = total_s / arguments.rounds * FAST_HZ
        said = f"{name} at {FAST_HZ:g} Hz with {ANCHORS} anchors"
        print(f"{said}: {share:.2%} of a core, {measured} measurements (limit {SHARE_LIMIT:.0%})")
    return 0


def parsed() -> Any:
    """What the command line says."""
    parser = OneLineParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", metavar="NAME", nargs="*", choices=[[], *EMULATORS])
    parser.add_argument("--rounds", type=positive, default=2000)
    return parser.parse_args()


if __name__ == "__main__":
    outlive_readers()
    raise SystemExit(main())
