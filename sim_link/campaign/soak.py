"""A day of flight in minutes: memory, descriptors and queues stay as they are, the log in its cap.

The companion flies and writes its real journal to a real disk; landed by a low battery it would
end early, so the battery is endless. What grows is measured against invented time.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.config.schema import CompanionConfig
from companion.guidance.session_params import SessionParams
from companion.io.logs.flight_recorder import FlightJournal
from sim_link.autopilot.scenario import AutopilotParams, BatteryParams, Scenario
from sim_link.campaign.flights import rules_of
from sim_link.campaign.fuzz import resident_mb
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.faults.faulty_link import FaultyLink
from sim_link.faults.link_kinds import LinkBursts, LinkJitter, LinkLoss
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.flight import Flight
from sim_link.monitor.monitor import Monitor

HOUR_S = 3600.0
SAMPLE_S = 300.0
SETTLED_H = 1.0
"""The first hour may grow."""
SLOPE_MB_PER_H = 0.1
TOLD_FROM_H = 2.0
"""A flight of more than so many hours tells of each, because it takes minutes."""
LOG_CAP_BYTES = 20_000_000
LOG_SLACK = 1.1
"""The file that is being written, and the names of the others."""


class Soak:
    """The part of the campaign that flies for a day."""

    name = "soak"
    title = "24 simulated hours: memory, descriptors and log stay bounded"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """One flight of so many hours."""
        return [Trial(self.name, trial_seed(seed, 0), amount)] if amount else []

    def cost(self, trial: Trial) -> float:
        """Seconds of one core."""
        return 90.0 * trial.size

    def run(self, trial: Trial) -> Outcome:
        """Fly and measure."""
        directory = Path(tempfile.mkdtemp(prefix="soak-"))
        try:
            return _soaked(trial, directory)
        finally:
            shutil.rmtree(directory, ignore_errors=True)


@dataclass(slots=True)
class Usage:
    """What a process took of the machine, sample by sample."""

    hours: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)
    log_bytes: int = 0

    def sample(self, now_s: float) -> None:
        """Look at this process."""
        self.hours.append(now_s / HOUR_S)
        self.memory_mb.append(resident_mb())
        self.descriptors.append(len(os.listdir("/proc/self/fd")))

    @property
    def slope_mb_per_h(self) -> float:
        """How memory grew once it had settled."""
        settled_h = min(SETTLED_H, 0.5 * self.hours[-1])
        return slope_after(self.hours, self.memory_mb, settled_h)

    def findings(self) -> list[str]:
        """What grew; memory is judged where there are enough hours to tell."""
        findings = []
        if self.slope_mb_per_h > SLOPE_MB_PER_H and self.hours[-1] > 2.0 * SETTLED_H:
            findings.append(f"memory grows by {self.slope_mb_per_h:.3f} MB/h")
        if self.descriptors[-1] != self.descriptors[0]:
            findings.append(f"{self.descriptors[0]} descriptors became {self.descriptors[-1]}")
        if self.log_bytes > LOG_SLACK * LOG_CAP_BYTES:
            findings.append(f"the log has {self.log_bytes} bytes, its cap is {LOG_CAP_BYTES}")
        return findings


def _soaked(trial: Trial, directory: Path) -> Outcome:
    flight, monitor, journal = _flight(trial.seed, directory)
    usage = Usage()
    while flight.now_s < trial.size * HOUR_S:
        flight.run(min(SAMPLE_S, trial.size * HOUR_S - flight.now_s))
        usage.sample(flight.now_s)
        if trial.size > TOLD_FROM_H and len(usage.hours) % round(HOUR_S / SAMPLE_S) == 0:
            hours, memory_mb = usage.hours[-1], usage.memory_mb[-1]
            told = f"  soak: {hours:.0f} of {trial.size:g} h, {memory_mb:.1f} MB\n"
            sys.stderr.write(told)
            sys.stderr.flush()
    files = (path for path in directory.rglob("*") if path.is_file())
    usage.log_bytes = sum(path.stat().st_size for path in files)
    journal.close()
    return Outcome(
        trial,
        (*findings_of(monitor.violations), *usage.findings()),
        sums={"soak_hours": trial.size},
        most={
            "soak_slope_mb_per_h": usage.slope_mb_per_h,
            "soak_log_bytes": float(usage.log_bytes),
        },
    )


def slope_after(hours: Sequence[float], values: Sequence[float], since_h: float) -> float:
    """The slope of a straight line through the values from a time on, per hour."""
    chosen = [(h, v) for h, v in zip(hours, values, strict=True) if h >= since_h]
    if len(chosen) < 2:
        return 0.0
    times, wanted = zip(*chosen, strict=True)
    return float(np.polyfit(times, wanted, 1)[0])


def _flight(seed: int, directory: Path) -> tuple[Flight, Monitor, FlightJournal]:
    """An endless search over a mediocre link."""
    scenario = Scenario(
        autopilot=AutopilotParams(flavour="px4" if seed % 2 else "ardupilot"),
        battery=BatteryParams(endurance_s=1e7),
    )
    config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e9))
    faults = (
        LinkLoss(share=0.05),
        LinkJitter(jitter_s=0.05),
        LinkBursts(mean_good_s=60.0, mean_bad_s=0.2),
    )
    link = FaultyLink(Schedule(faults=faults), seed)
    journal = FlightJournal(directory, 1.795e9, LOG_CAP_BYTES)
    flight = Flight(config, scenario, seed, journal, wire=link)
    monitor = Monitor(
        rules_of(config),
        flight.sim.vehicle,
        estimate=lambda: flight.companion.session.estimate,
    )
    flight.observers.append(monitor)
    return flight, monitor, journal
