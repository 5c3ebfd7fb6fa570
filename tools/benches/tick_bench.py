"""Processor time of the control tick, and of everything that may come between two of them.

A search in lockstep, by real bytes and an invented clock: 1 to 16 emitters at 10 Hz each, all
measured at the same moment or evenly over the period, in flight and on the ground. Every call of
the endpoint (a datagram, the control tick, estimation in between) is timed by the thread's own
time, so that other programs on the machine do not count. A setpoint can leave between two calls:
the longest call is the longest that a due setpoint waits.

Each case runs in a process of its own, with kernels that `companion warm-up` compiled, as a flight
does: `tools/benches/tick_bench.py EMITTERS PHASE STATE SECONDS` prints its figures as JSON. The
same file measures an earlier release in its own checkout (`--beside`).
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint, build_planner
from companion.guidance.commands import Severity
from companion.kernel import IS_COMPILED
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_radio_ranging_message
from companion.mav.endpoint import Chunk
from companion.warm_up import warm_up
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.world.environment import EmitterParams

try:
    from sim_link.lab.lockstep import Flight, Makers, MemoryJournal
    from sim_link.lab.observer import Lane
except ImportError:  # where 1.0.0rc1 has them
    for part in ("flight", "observer"):
        found = vars(import_module(f"sim_link.lab.lockstep.{part}"))
        globals().update({name: found[name] for name in found if name[0] != "_"})

ROOT = Path(__file__).resolve().parents[2]
AS_IN_FLIGHT = """
import contextlib, runpy, sys
with contextlib.suppress(ImportError):
    from companion import kernel_cache
    kernel_cache.forgoes_compiler = True
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Runs this file with kernels that were compiled ahead; 1.0.0rc1 compiles them in the process."""
EMITTERS = (1, 4, 8, 16)
PHASES = ("in step", "spread")
STATES = ("flying", "ground")
RATE_HZ = 10.0
LIMIT_MS = {"compiled": 10.0, "plain": 25.0}
SEED = 7


@dataclass(frozen=True, slots=True)
class TickCost:
    """Cost of one case, in milliseconds of the thread."""

    kernels: str
    tick_worst_ms: float
    tick_p99_ms: float
    stretch_worst_ms: float
    """The longest call of the endpoint, the control tick among them."""
    estimates: int
    """Number of fused measurements."""

    @property
    def limit_ms(self) -> float:
        """Limit of both figures, ms."""
        return LIMIT_MS[self.kernels]

    @property
    def figures(self) -> str:
        """The three figures in columns, ms."""
        return f"{self.tick_worst_ms:7.2f}{self.tick_p99_ms:7.2f}{self.stretch_worst_ms:8.2f}"

    @property
    def is_met(self) -> bool:
        """Return True if nothing took longer than the limit."""
        return self.stretch_worst_ms <= self.limit_ms


class SilentJournal(MemoryJournal):
    """Journal that keeps nothing, so that garbage collection costs the same as in a flight."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Drop an event."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Drop a text."""


class Spread:
    """Wire that delivers each emitter's measurements at a separate time."""

    def __init__(self, emitters: int) -> None:
        self._emitters = emitters
        self._reader = MavCodec(9, 9)

    def carry(self, data: bytes, lane: Lane, now_s: float) -> list[tuple[float, bytes]]:
        """Deliver now, or a measurement at its emitter's part of the period."""
        del lane
        for message in self._reader.decode(data):
            if isinstance(message, MAVLink_radio_ranging_message):
                part = message.emitter_id % self._emitters / self._emitters
                return [(now_s + part / RATE_HZ, data)]
        return [(now_s, data)]


class Timed:
    """Wraps the calls of an endpoint, and keeps the duration of each."""

    def __init__(self, endpoint: Any) -> None:
        self.ticks_s: list[float] = []
        self.others_s: list[float] = []
        self._endpoint = endpoint
        self._receive, self._handle = endpoint.receive, endpoint.handle_timer
        endpoint.receive, endpoint.handle_timer = self.receive, self.handle_timer

    def receive(self, chunk: Chunk, now_s: float) -> None:
        """Time a datagram."""
        began_ns = time.thread_time_ns()
        self._receive(chunk, now_s)
        self.others_s.append(1e-9 * (time.thread_time_ns() - began_ns))

    def handle_timer(self, now_s: float) -> None:
        """Time the control tick, or the task after it."""
        ticks = getattr(self._endpoint, "ticks", None)  # 1.0.0rc1 has none, and no other task
        began_ns = time.thread_time_ns()
        self._handle(now_s)
        took_s = 1e-9 * (time.thread_time_ns() - began_ns)
        is_tick = ticks is None or self._endpoint.ticks > ticks
        (self.ticks_s if is_tick else self.others_s).append(took_s)


def measure(emitters: int, phase: str, state: str, seconds: float) -> TickCost:
    """Fly one case in this process."""
    is_flying = state == "flying"
    several = tuple(
        EmitterParams(
            emitter_id=7 + n, position_enu_m=(25.0 + 20.0 * (n % 4), 30.0 + 55.0 * (n // 4) / 3.0)
        )
        for n in range(emitters if emitters > 1 else 0)
    )
    ids = tuple(each.emitter_id for each in several)
    payload = PayloadParams(rate_hz=RATE_HZ, min_altitude_m=3.0 if is_flying else 0.0)
    scenario = Scenario(payload=payload, emitters=several)
    config = CompanionConfig()
    mission, queue = type(config.mission), type(config.emitters)
    most = {"most": emitters} if "most" in queue.__struct_fields__ else {}  # in 1.0.0rc1
    launch: Any = {"engage": "auto"} if is_flying else {}
    config = CompanionConfig(
        mission=mission(stop_confirm_s=1000.0, settle_s=None, **launch),
        emitters=queue(order="listed", listed=ids, **most) if ids else queue(),
    )
    if IS_COMPILED:
        # 1.0.0rc1 has the tracker's parameters there
        tracking: Any = getattr(config, "tracking", config.estimation)
        warm_up(tracking, build_planner(config))
    wire = Spread(emitters) if phase == "spread" else None
    flight = Flight(
        config, scenario, SEED, SilentJournal(), wire=wire, makers=Makers(build_endpoint)
    )
    timed = Timed(flight.companion)
    gc.freeze()  # as a flight does
    flight.run(seconds)
    ticks_ms = sorted(1e3 * took_s for took_s in timed.ticks_s)
    accepted = sum(t.accepted for t in flight.companion.session.context.emitters.trackers)
    return TickCost(
        "compiled" if IS_COMPILED else "plain",
        round(ticks_ms[-1], 2),
        round(ticks_ms[int(0.99 * len(ticks_ms))], 2),
        round(max(ticks_ms[-1], 1e3 * max(timed.others_s)), 2),
        accepted,
    )


@dataclass(frozen=True, slots=True)
class TickCase:
    """Number of emitters, timing, state of flight and kernels of a case."""

    kernels: str
    state: str
    emitters: int
    phase: str

    @property
    def title(self) -> str:
        """Text of the case."""
        return f"{self.kernels}, {self.state}, {self.emitters} {self.phase}"

    def measured(self, root: Path, seconds: float) -> TickCost:
        """Fly it in a separate process, with the code of a checkout."""
        environment = {**os.environ, "PYTHONPATH": str(root)}
        environment["NUMBA_DISABLE_JIT"] = "0" if self.kernels == "compiled" else "1"
        words = (str(self.emitters), self.phase, self.state, str(seconds))
        command = [sys.executable, "-P", "-c", AS_IN_FLIGHT, __file__, *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"bench: tick: {done.stderr.strip().splitlines()[-1]}")
        return msgspec.json.decode(done.stdout, type=TickCost)


def tick_cases(kinds: Sequence[str], counts: Sequence[int]) -> Iterator[TickCase]:
    """Yield every case, those with the same kernels together."""
    for kernels in kinds:
        for state in STATES:
            for emitters in counts:
                for phase in PHASES if emitters > 1 else PHASES[:1]:
                    yield TickCase(kernels, state, emitters, phase)


if __name__ == "__main__":
    flown = measure(int(sys.argv[1]), sys.argv[2], sys.argv[3], float(sys.argv[4]))
    print(msgspec.json.encode(flown).decode())
