"""Trials of the process: kills, stops, damaged checkpoints and signals at random instants.

Kills and stops fly in lockstep; SIGTERM and SIGKILL reach real processes over UDP, judged by the
companion's event log and the simulator's own report.
"""

from __future__ import annotations

import json
import signal
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml

from companion.domain import FlightMode
from companion.errors import CompanionError
from companion.io.child_processes import HOST, ChildProcess, free_udp_ports
from companion.mav.dialect import mavlink
from sim_link.lab.mission.flight_readers import EventTail
from sim_link.lab.observer import Frame, Observer
from tools.campaign.checkpointing import MemoryStore
from tools.campaign.flights import Dice, Part, Trial, TrialOutcome, launched_flight, story_lines

KILL_EARLIEST_S, KILL_LATEST_S = 1.0, 45.0
KILL_AFTER_S = 12.0
LAUNCHED = 0x1C7
"""Salt of the generators' seeds, for kills and stops the same."""
AIRBORNE_M = 0.5
TAKES_CONTROL = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF)
HOLD_S, EXIT_S = 1.0, 2.0
"""Longest times after a stop until the autopilot's own hold is confirmed, and the process is
gone."""
CUTS_PER_TRIAL = 40
"""Damaged checkpoints that one trial starts from."""


class Taking(Observer):
    """Counts unprompted requests of the companion to take control."""

    def __init__(self) -> None:
        self.taken = 0

    def sent(self, frame: Frame) -> None:
        """Count requests."""
        message = frame.message
        if isinstance(message, mavlink.MAVLink_command_long_message):
            self.taken += message.command in TAKES_CONTROL


def kill(trial: Trial) -> TrialOutcome:
    """Kill, damage the checkpoint, restart, and check that nothing engages."""
    around, dice = launched_flight(trial.seed, LAUNCHED)
    flight, store = around.flight, around.checkpointing.store
    flight.run(dice.number(KILL_EARLIEST_S, KILL_LATEST_S))
    flight.kill_companion()
    was_airborne = flight.sim.vehicle.body.height_m > AIRBORNE_M
    damaged = damages(store, trial.seed)
    starts = _starts(store, damaged)
    flight.run(dice.number(0.1, 10.0))
    is_flying = was_airborne and flight.sim.vehicle.is_armed
    taking = Taking()
    flight.observers.append(taking)
    flight.start_companion()
    flight.run(KILL_AFTER_S)
    findings = around.findings
    if is_flying and taking.taken:
        findings.append(f"took the vehicle by itself after a restart ({taking.taken} requests)")
    sums = {"kills": 1.0, "damaged_checkpoints": float(len(damaged))}
    return TrialOutcome(trial, tuple(findings + starts), sums, story=around.story)


def _starts(store: MemoryStore, damaged: list[dict[int, bytes]]) -> list[str]:
    """Load a damaged store and return the faults found; there must be none."""
    findings = []
    for slots in damaged:
        store.slots = slots
        found = store.load()
        if found.checkpoint is not None and len(slots) == 1:
            findings.append("a damaged checkpoint was accepted")
        if slots and not found.has_files:
            findings.append("a damaged checkpoint counted as a missing one")
    return findings


def damages(store: MemoryStore, seed: int) -> list[dict[int, bytes]]:
    """Return damaged checkpoints: the larger one alone, cut or flipped at seeded offsets.

    Consecutive seeds take consecutive offsets, so that a campaign reaches every byte.
    """
    if not store.slots:
        return []
    rng = np.random.default_rng((seed, 0xDA))
    number, data = max(store.slots.items(), key=lambda item: len(item[1]))
    damaged = []
    for count in range(CUTS_PER_TRIAL):
        offset = (seed * CUTS_PER_TRIAL + count) % len(data)
        if count % 2:
            broken = data[:offset]
        else:
            flipped = data[offset] ^ 1 << int(rng.integers(8))
            broken = data[:offset] + bytes((flipped,)) + data[offset + 1 :]
        damaged.append({number: broken})
    return damaged


def stop(trial: Trial) -> TrialOutcome:
    """Stop, and watch the mode and the process."""
    around, dice = launched_flight(trial.seed, LAUNCHED)
    flight = around.flight
    flight.run(dice.number(KILL_EARLIEST_S, KILL_LATEST_S))
    was_ours = flight.mode is FlightMode.OFFBOARD and flight.sim.vehicle.is_armed
    stopped_s = flight.now_s
    flight.stop_companion()
    hold_s = gone_s = None
    while flight.now_s - stopped_s < EXIT_S + 1.0 and (hold_s is None or gone_s is None):
        if hold_s is None and flight.mode is not FlightMode.OFFBOARD:
            hold_s = flight.now_s - stopped_s
        if gone_s is None and not flight.is_companion_up:
            gone_s = flight.now_s - stopped_s
        flight.step()
    findings = around.findings
    if was_ours and (hold_s is None or hold_s > HOLD_S):
        findings.append(f"hold not confirmed within {HOLD_S:g} s of a stop")
    if gone_s is None or gone_s > EXIT_S:
        findings.append(f"not gone within {EXIT_S:g} s of a stop")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={"stops": 1.0, "stops_in_control": float(was_ours)},
        most={
            "stop_hold_s": hold_s or 0.0 if was_ours else 0.0,
            "stop_exit_s": gone_s if gone_s is not None else EXIT_S + 1.0,
        },
        story=around.story,
    )


SPEED = 3.0
SIGNAL_EARLIEST_S, SIGNAL_LATEST_S = 0.5, 36.0
"""Instants, in seconds of the flight."""
DOWN_S = (0.1, 1.0)
"""Time between a kill and the next start."""
SIGNAL_AFTER_S = 6.0
"""Time for which the next one is watched, in seconds of the flight."""
START_S = 60.0
"""Real time that a process may take to start on a busy machine."""


def signal_process(trial: Trial) -> TrialOutcome:
    """Fly, signal, and read the logs; a size below 1 signals earlier, both signals alternately."""
    dice = Dice(np.random.default_rng((trial.seed, 0x516)))
    flavour = dice.one(("px4", "ardupilot"))
    span_s = trial.size * (SIGNAL_LATEST_S - SIGNAL_EARLIEST_S)
    instant_s = dice.number(SIGNAL_EARLIEST_S, SIGNAL_EARLIEST_S + span_s)
    with tempfile.TemporaryDirectory(prefix="signal-") as folder:
        flight = ProcessFlight(Path(folder), flavour, SPEED)
        try:
            companion = flight.start_companion()
            time.sleep(instant_s / SPEED)
            if trial.seed % 2:
                return _stop(trial, flight, companion)
            return _kill(trial, flight, companion, dice.number(*DOWN_S))
        finally:
            flight.close()


class ProcessFlight:
    """A simulator and companions in a folder; both end with this process.

    Args:
        values: Keys of the configuration and the scenario that differ from their defaults.
        options: Options of the simulator, after those that every flight has.
    """

    def __init__(
        self,
        folder: Path,
        flavour: str,
        speed: float,
        values: Mapping[str, object] = MappingProxyType({}),
        scenario: Mapping[str, object] = MappingProxyType({}),
        options: Sequence[str] = (),
    ) -> None:
        self._folder, self._speed = folder, speed
        self.port, listen = free_udp_ports(2)
        self._config = folder / "companion.yaml"
        own = {
            "mission": {"engage": "auto", "stop_confirm_s": 3600.0, "settle_s": None},
            "log": {"directory": str(folder / "flights")},
            "process": {"state_directory": str(folder / "state")},
        }
        self._config.write_text(yaml.safe_dump(own | dict(values)))
        (folder / "scenario.yaml").write_text(yaml.safe_dump(dict(scenario)))
        self.events = EventTail(folder / "flights")
        self._companions: list[ChildProcess] = []
        arguments = ["sim_link", "--stop-on-eof", "--quiet", "--autopilot", flavour]
        arguments += ["--speed", f"{speed:g}", "--report", str(folder / "truth.json")]
        arguments += ["--scenario", str(folder / "scenario.yaml"), *options]
        arguments += ["--listen", f"{HOST}:{listen}", "--send-to", f"{HOST}:{self.port}"]
        self._simulator = self._start("sim-link", arguments)

    def _start(self, name: str, arguments: list[str]) -> ChildProcess:
        env = {"NUMBA_DISABLE_JIT": "1"}
        child = ChildProcess(name, ["-m", *arguments], self._folder / f"{name}.log", env)
        child.start()
        return child

    def start_companion(self) -> ChildProcess:
        """Start a companion; returns once its flight has begun, or raises a CompanionError."""
        arguments = ["sim_link.lab.supervised_companion", "--config", str(self._config)]
        arguments += ["--connect", f"udp:{HOST}:{self.port}", "--speed", f"{self._speed:g}"]
        child = self._start(f"companion{len(self._companions)}", arguments)
        self._companions.append(child)
        deadline_s = time.monotonic() + START_S
        while not self.events.look_for_flight():
            if not child.is_alive or time.monotonic() > deadline_s:
                raise CompanionError(f"the companion did not start: {child.last_words}")
            time.sleep(0.01)
        return child

    def land(self) -> dict[str, Any]:
        """End the simulator and return its report."""
        self._simulator.stop(START_S)
        report: dict[str, Any] = json.loads((self._folder / "truth.json").read_text())
        return report

    def close(self) -> None:
        """End all processes that still run."""
        for child in (*self._companions, self._simulator):
            child.signal(signal.SIGKILL)
            child.stop()


def _end(child: ChildProcess) -> tuple[int | None, float, list[str]]:
    """Send SIGTERM; return the exit code, the seconds it took, and whether that is too long."""
    began_s = time.monotonic()
    code = child.end(EXIT_S + 2.0)
    took_s = time.monotonic() - began_s
    return code, took_s, [] if took_s <= EXIT_S else [f"gone {took_s:.2f} s after SIGTERM"]


def _stop(trial: Trial, flight: ProcessFlight, companion: ChildProcess) -> TrialOutcome:
    code, took_s, findings = _end(companion)
    events, modes = flight.events.take(), [each["mode"] for each in flight.land()["mode_changes"]]
    if code != 0:
        findings.append(f"exit code {code} after SIGTERM")
    # the hand-back began then; before arming there is nothing to hand back
    is_asked = any(e["kind"] == "text" and e["text"].startswith("stopping: ") for e in events)
    asked_s = _time_of(events, "phase", new="handback") if is_asked else None
    hold_s = 0.0
    if asked_s is not None:
        answered_s = _time_of(events, "answer", outcome="accepted", since_s=asked_s)
        hold_s = took_s if answered_s is None else (answered_s - asked_s) / SPEED
        if answered_s is None or hold_s > HOLD_S:
            findings.append(f"hold not confirmed within {HOLD_S:g} s of SIGTERM")
        if modes and modes[-1] != "hold":  # none: it was asked to hold before it left its hold
            findings.append(f"stopped in control, and the vehicle is in {modes[-1]}")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={"signals": 1.0, "signals_in_control": float(asked_s is not None)},
        most={"signal_exit_s": took_s, "signal_hold_s": hold_s},
        story=story_of(events),
    )


def _kill(
    trial: Trial, flight: ProcessFlight, companion: ChildProcess, down_s: float
) -> TrialOutcome:
    companion.signal(signal.SIGKILL)
    companion.stop()
    before = flight.events.take()
    had_begun = _time_of(before, "phase", new="launching") is not None
    time.sleep(down_s)
    began_s = time.monotonic()
    companion = flight.start_companion()
    started_s = time.monotonic() - began_s
    time.sleep(SIGNAL_AFTER_S / SPEED)
    _, took_s, findings = _end(companion)
    after = flight.events.take()
    asked = [event for event in after if event["kind"] == "answer"]
    if had_begun and asked:
        findings.append(f"took the vehicle by itself after a kill ({len(asked)} requests)")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={"signals": 1.0, "signals_in_control": float(had_begun)},
        most={"signal_exit_s": took_s, "signal_start_s": started_s},
        story=(*story_of(before), "SIGKILL", *story_of(after)),
    )


def _time_of(
    events: Sequence[dict[str, Any]], kind: str, since_s: float = 0.0, **fields: object
) -> float | None:
    """Return the time of the first such event, s, or None."""
    for event in events:
        is_it = all(event.get(name) == value for name, value in fields.items())
        if event["kind"] == kind and event["t_s"] >= since_s and is_it:
            return float(event["t_s"])
    return None


def story_of(events: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Return the texts to the operator, with their times."""
    return story_lines((e["t_s"], e["text"]) for e in events if e["kind"] == "text")


KILLS = Part(
    "kill", "SIGKILL at random instants, checkpoints cut or flipped at every byte", run=kill
)
STOPS = Part(
    "stop", "SIGTERM at random instants: hold confirmed in 1 s, gone in 2 s", run=stop, cost_s=0.8
)
SIGNALS = Part(
    "signal",
    "real processes: SIGTERM and SIGKILL at random instants, and started again",
    run=signal_process,
    cost_s=12.0,
)
