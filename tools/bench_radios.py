"""What a measurement of each radio costs, beside RADIO_RANGING, and how soon a setpoint follows it.

.venv/bin/python tools/bench_radios.py [--rounds N] [NAME ...]

At last a flight in lockstep: how long after a byte arrives a setpoint leaves that may know of it,
in the flight's time up to the next control tick, and in wall time for what both are worked out in.

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

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode, RangingMeasurement
from companion.entry import outlive_readers
from companion.flight_setup import build_endpoint
from companion.guidance.session_params import SessionParams
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from companion.link.radio_stage import RadioSettings, RadioSetup, RadioStage
from companion.link.ranging_sources import ranging_from_message
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message
from companion.mav.endpoint import Chunk
from companion.mav.ranging import message_from_ranging
from companion.radios.catalogue import radio_kind
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.emulators.catalogue import EMULATORS, make_emulator
from sim_link.emulators.emulator import Answer, Round
from sim_link.lab.lockstep.flight import Flight, Makers, MemoryJournal
from sim_link.lab.lockstep.observer import Lane, Observer
from sim_link.world.environment import ChannelParams, Emitter
from sim_link.world.field_radio import FieldRadio
from tools.console import OneLineParser, positive

REPEATS = 5
FAST_HZ, ANCHORS, SHARE_LIMIT = 200.0, 8, 0.03
"""The promise: NLink at that rate with so many anchors costs no more of a core."""
LATENCY_HZ, LEAST_HEIGHT_M = 33.0, 3.0
"""A rate that goes through all of a tick."""
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
    printed += [(emulator.say(each), each.told_s) for each in asked]

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


class Latencies(Observer):
    """A flight's radio, and how long after its bytes a setpoint leaves."""

    def __init__(self, flight: Flight, name: str) -> None:
        self.found_s: list[float] = []
        self._flight = flight
        self._emulator = make_emulator(name, 1)
        self._radio = FieldRadio(ChannelParams(), np.random.default_rng(1))
        self._emitter = Emitter(flight.scenario.emitter)
        self._due_s = 0.0
        self._waiting: list[tuple[float, float]] = []
        """When bytes came, and the wall time that it took to take them in."""
        flight.is_ranging_up = False
        flight.observers.append(self)
        companion = flight.companion
        receive, tick = companion.receive, companion.handle_timer

        def received(chunk: Chunk, now_s: float) -> None:
            began_s = time.perf_counter()
            receive(chunk, now_s)
            if chunk.link == 1:
                self._waiting.append((now_s, time.perf_counter() - began_s))

        def ticked(now_s: float) -> None:
            began_s = time.perf_counter()
            tick(now_s)
            took_s = time.perf_counter() - began_s
            if self.is_measured:
                self.found_s += [
                    now_s - came_s + cost_s + took_s for came_s, cost_s in self._waiting
                ]
            self._waiting.clear()

        companion.receive, companion.handle_timer = received, ticked  # type: ignore[method-assign]

    @property
    def is_measured(self) -> bool:
        """Whether the companion flies: on the ground nothing waits for it."""
        return self._flight.mode is FlightMode.OFFBOARD

    def stepped(self, vehicle: SimVehicle, now_s: float) -> None:
        """Measure, and print."""
        if now_s < self._due_s - 1e-9 or vehicle.body.height_m < LEAST_HEIGHT_M:
            return
        self._due_s = now_s + 1.0 / LATENCY_HZ
        heard = self._radio.measure(self._emitter, vehicle.body.position_enu_m, now_s)
        answer = Answer(self._emitter.emitter_id, heard)
        self._flight.post(self._emulator.say(Round(now_s, (answer,))), Lane.RANGING)


def latency_line(name: str, seconds: int) -> str:
    """Percentiles of a flight of so long."""
    mission = SessionParams(engage="auto")
    setup = RadioSetup(radio_kind(radio_of(name)), RadioSettings(), None)

    def make(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        return build_endpoint(config, journal, (*links, LinkSpec(LinkRole.RANGING, setup)))

    config = CompanionConfig(mission=mission)
    flight = Flight(config, Scenario(), 1, MemoryJournal(), makers=Makers(make))
    latencies = Latencies(flight, name)
    flight.run(float(seconds))
    if not latencies.found_s:
        return f"{name}: nothing was measured in {seconds} s"
    median_ms, p99_ms = (1e3 * np.percentile(latencies.found_s, (50, 99))).tolist()
    tick_ms = 1e3 / config.link.rate_hz
    return (
        f"{name}: byte in to setpoint out {median_ms:.1f} ms, p99 {p99_ms:.1f} ms, of "
        f"{len(latencies.found_s)} (limit {tick_ms + 2.0:g} ms: a tick and 2 ms)"
    )


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
        left = f"{measured} measurements after thinning"
        print(f"{said}: {share:.2%} of a core, {left} (limit {SHARE_LIMIT:.0%})")
    print(latency_line("nlink_node3", arguments.seconds))
    return 0


def parsed() -> Any:
    """What the command line says."""
    parser = OneLineParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", metavar="NAME", nargs="*", choices=[[], *EMULATORS])
    parser.add_argument("--rounds", type=positive, default=2000)
    parser.add_argument("--seconds", type=positive, default=60, help="of flight, for the latency")
    return parser.parse_args()


if __name__ == "__main__":
    outlive_readers()
    raise SystemExit(main())
