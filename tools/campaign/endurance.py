"""Fuzzed frames and a day of flight: nothing may raise, grow or slow down.

Random frames have a valid checksum, and a signature if there is a key, and come from the
autopilot's own address: no other sender is accepted. In the day of flight the companion writes its
real journal to a real disk; the battery is endless.
"""

from __future__ import annotations

import gc
import itertools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.config.schema import CompanionConfig
from companion.diagnostics import process_use
from companion.guidance.commands import SessionParams
from companion.io.flight_recorder import FlightJournal
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from companion.mav.signing import Signing, timestamp_at
from sim_link.autopilot.scenario import AutopilotParams, BatteryParams, FlavourName, Scenario
from sim_link.lab.conformance.mavlink_oracle import FrameSpec, build_raw
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.faults.faulty_link import FaultyLink
from sim_link.lab.lockstep import VEHICLE_PEER, Flight
from sim_link.lab.mission.flight_readers import rules_of
from sim_link.lab.monitor.monitor import Monitor
from tests.protocol.frame_fuzzer import random_fields
from tools.campaign import flights
from tools.campaign.flights import STARTED_UNIX_S, Part, Trial, TrialOutcome

FRAMES_PER_TRIAL = 20_000
PER_TICK = 10
SLOWEST_FRAME_S = 0.05
MAX_GROWTH_MB = 24.0
SIGNED_LINK = 9
_BY_NAME = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
_ACTED_ON = (
    "HEARTBEAT LOCAL_POSITION_NED GLOBAL_POSITION_INT ATTITUDE SYS_STATUS BATTERY_STATUS "
    "EXTENDED_SYS_STATE HOME_POSITION GPS_GLOBAL_ORIGIN GPS_RAW_INT ESTIMATOR_STATUS "
    "COMMAND_ACK COMMAND_LONG COMMAND_INT STATUSTEXT TIMESYNC PARAM_VALUE MISSION_COUNT "
    "MISSION_ITEM_INT POSITION_TARGET_LOCAL_NED POSITION_TARGET_GLOBAL_INT RC_CHANNELS "
    "LANDING_TARGET RANGING_BEACON RADIO_RANGING"
)
HEARD = tuple(_BY_NAME[name] for name in _ACTED_ON.split())
"""Messages that a companion handles; some frames are of any message of the dialect."""
SPECIAL = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e30, -1.0, 1.0, 1e-42)


def random_frames(rng: np.random.Generator, signing: Signing | None) -> Iterator[bytes]:
    """Yield random frames of the autopilot, signed if there is a key."""
    every_kind = list(mavlink.mavlink_map.values())
    for number in itertools.count(1):
        kinds = HEARD if rng.random() < 0.85 else every_kind
        kind = kinds[int(rng.integers(len(kinds)))]
        payload = random_fields(int(kind.unpacker.size), rng, SPECIAL).rstrip(b"\0") or b"\0"
        frame = build_raw(int(kind.id), payload, kind.crc_extra, FrameSpec(1, 1, number % 256))
        yield frame if signing is None else signing.sign(frame, SIGNED_LINK, kind.crc_extra)


def fuzz(trial: Trial) -> TrialOutcome:
    """Feed a companion that restarts now and then, so that it is in every phase.

    Loaded modules are excluded from garbage collection, as the companion's own process does before
    it flies.
    """
    gc.collect()
    gc.freeze()
    try:
        return _fuzz(trial)
    finally:
        gc.unfreeze()


def _fuzz(trial: Trial) -> TrialOutcome:
    rng = np.random.default_rng((trial.seed, 0xF022))
    is_signed = bool(trial.seed % 2)
    signing = Signing(flights.KEY, timestamp_at(STARTED_UNIX_S)) if is_signed else None
    frames = random_frames(rng, signing)
    slowest_s, sent, reached, findings = 0.0, 0, 0, list[str]()
    settled_mb = 0.0
    while sent < trial.size * FRAMES_PER_TRIAL:
        flavour: FlavourName = "px4" if (trial.seed + sent) % 4 < 2 else "ardupilot"
        scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
        around = flights.monitored_flight(
            flights.ENDLESS, scenario, trial.seed + sent, is_signed=is_signed
        )
        flight = around.flight
        flight.run(float(rng.uniform(0.0, 20.0)))
        for _ in range(round(trial.size * FRAMES_PER_TRIAL / 4 / PER_TICK)):
            if signing is not None:
                signing.advance(STARTED_UNIX_S + flight.now_s)
            for _ in range(PER_TICK):
                chunk = Chunk(0, next(frames), VEHICLE_PEER)
                began_s = time.thread_time()
                flight.companion.receive(chunk, flight.now_s)
                slowest_s = max(slowest_s, time.thread_time() - began_s)
                sent += 1
            flight.run(0.05)
        findings += [str(v) for v in around.monitor.violations if v.invariant in JUDGED]
        reached += 1
        if reached == 2:
            settled_mb = process_use().resident_mb
    grown_mb = process_use().resident_mb - settled_mb
    if slowest_s > SLOWEST_FRAME_S:
        findings.append(f"a frame took {slowest_s:.3f} s")
    if grown_mb > MAX_GROWTH_MB:
        findings.append(f"memory grew by {grown_mb:.1f} MB")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={"fuzz_frames": float(sent)},
        most={"fuzz_slowest_frame_s": slowest_s, "fuzz_growth_mb": max(0.0, grown_mb)},
    )


JUDGED = ("I6", "I8", "I9", "I11")
"""Invariants that hold for any reports; the others need truthful reports."""


HOUR_S = 3600.0
SAMPLE_S = 300.0
SETTLED_H = 1.0
SLOPE_MB_PER_H = 0.1
LOG_CAP_BYTES = 20_000_000
LOG_SLACK = 1.1
"""The file that is being written, and the names of the others."""


@dataclass(slots=True)
class Usage:
    """Memory, descriptors and log size of a process, sample by sample."""

    hours: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    descriptors: list[int | None] = field(default_factory=list)
    log_bytes: int = 0

    def sample(self, now_s: float) -> None:
        """Take a sample of this process."""
        used = process_use()
        self.hours.append(now_s / HOUR_S)
        self.memory_mb.append(used.resident_mb)
        self.descriptors.append(used.descriptors)

    @property
    def slope_mb_per_h(self) -> float:
        """Growth of memory after it has settled, MB/h: the slope of a line through its samples."""
        hours, memory_mb = np.array(self.hours), np.array(self.memory_mb)
        chosen = hours >= min(SETTLED_H, 0.5 * hours[-1])
        if chosen.sum() < 2:
            return 0.0
        return float(np.polyfit(hours[chosen], memory_mb[chosen], 1)[0])

    def findings(self) -> list[str]:
        """Return the resources that grew; memory is judged only over enough hours."""
        findings = []
        if self.slope_mb_per_h > SLOPE_MB_PER_H and self.hours[-1] > 2.0 * SETTLED_H:
            findings.append(f"memory grows by {self.slope_mb_per_h:.3f} MB/h")
        if self.descriptors[-1] != self.descriptors[0]:
            findings.append(f"{self.descriptors[0]} descriptors became {self.descriptors[-1]}")
        if self.log_bytes > LOG_SLACK * LOG_CAP_BYTES:
            findings.append(f"the log has {self.log_bytes} bytes, its cap is {LOG_CAP_BYTES}")
        return findings


def soak(trial: Trial) -> TrialOutcome:
    """Fly for some hours and measure."""
    with tempfile.TemporaryDirectory(prefix="soak-", ignore_cleanup_errors=True) as folder:
        directory = Path(folder)
        flight, monitor, journal = _soak_flight(trial.seed, directory)
        usage = Usage()
        while flight.now_s < trial.size * HOUR_S:
            flight.run(min(SAMPLE_S, trial.size * HOUR_S - flight.now_s))
            usage.sample(flight.now_s)
        files = (path for path in directory.rglob("*") if path.is_file())
        usage.log_bytes = sum(path.stat().st_size for path in files)
        journal.close()
    return TrialOutcome(
        trial,
        (*map(str, monitor.violations), *usage.findings()),
        sums={"soak_hours": trial.size},
        most={
            "soak_slope_mb_per_h": usage.slope_mb_per_h,
            "soak_log_bytes": float(usage.log_bytes),
        },
    )


def _soak_flight(seed: int, directory: Path) -> tuple[Flight, Monitor, FlightJournal]:
    """Return an endless search over a mediocre link."""
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flights.flavour_of(seed)),
        battery=BatteryParams(endurance_s=1e7),
    )
    config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e9))
    bad = (
        faults.LinkLoss(share=0.05),
        faults.LinkJitter(jitter_s=0.05),
        faults.LinkBursts(mean_good_s=60.0, mean_bad_s=0.2),
    )
    link = FaultyLink(faults.Schedule(faults=bad), seed)
    journal = FlightJournal(directory, 1.795e9, LOG_CAP_BYTES)
    flight = Flight(config, scenario, seed, journal, wire=link)
    monitor = Monitor(
        rules_of(config),
        flight.sim.vehicle,
        estimate=lambda: flight.companion.session.estimate,
    )
    flight.observers.append(monitor)
    return flight, monitor, journal


FUZZING = Part(
    "fuzz",
    "random frames with valid checksum and signature",
    run=fuzz,
    cost_s=5.0,
    split=flights.frames_each(FRAMES_PER_TRIAL),
)
SOAK = Part(
    "soak",
    "24 simulated hours: memory, descriptors and log stay bounded",
    run=soak,
    cost_s=90.0,
    split=lambda hours: (1 if hours else 0, hours),
)
