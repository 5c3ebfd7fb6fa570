"""The process is killed or told to stop at random instants, and its checkpoints are damaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.session_params import SessionParams
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.draws import Dice
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.lockstep.checkpoints import MemoryStore
from sim_link.lockstep.observer import Frame, Observer

EARLIEST_S, LATEST_S = 1.0, 45.0
AFTER_S = 12.0
AIRBORNE_M = 0.5
TAKES_CONTROL = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF)
HOLD_S, EXIT_S = 1.0, 2.0
"""After a stop: the autopilot's own hold is confirmed, and the process is gone."""
CUTS_PER_TRIAL = 40
"""Damaged checkpoints that one trial starts from."""


class Taking(Observer):
    """What a companion does to take a vehicle by itself."""

    def __init__(self) -> None:
        self.taken = 0
        self.setpoints = 0

    def sent(self, frame: Frame) -> None:
        """Count requests and setpoints."""
        message = frame.message
        if isinstance(message, mavlink.MAVLink_set_position_target_local_ned_message):
            self.setpoints += 1
        if not isinstance(message, mavlink.MAVLink_command_long_message):
            return
        if message.command in TAKES_CONTROL:
            self.taken += 1


def flight_of(seed: int) -> tuple[Monitored, Dice]:
    """A flight with checkpoints, either autopilot, launched by the companion."""
    dice = Dice(np.random.default_rng((seed, 0x1C7)))
    flavour: FlavourName = "px4" if dice.happens(0.5) else "ardupilot"
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
    around = monitored(config, scenario, seed)
    return around, dice


class Kills:
    """The part of the campaign that kills, damages and starts again."""

    name = "kill"
    title = "SIGKILL at random instants, checkpoints cut or flipped at every byte"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many kills."""
        return [Trial(self.name, trial_seed(seed, index)) for index in range(round(amount))]

    def cost(self, trial: Trial) -> float:  # noqa: ARG002
        """Seconds of one core."""
        return 1.0

    def run(self, trial: Trial) -> Outcome:
        """Kill, damage, start again, and watch who engages."""
        around, dice = flight_of(trial.seed)
        flight = around.flight
        flight.run(dice.number(EARLIEST_S, LATEST_S))
        flight.kill_companion()
        was_airborne = flight.sim.vehicle.body.height_m > AIRBORNE_M
        damaged = damages(around.checkpointing.store, trial.seed)
        starts = self._starts(around.checkpointing.store, damaged)
        flight.run(dice.number(0.1, 10.0))
        is_flying = was_airborne and flight.sim.vehicle.is_armed
        taking = Taking()
        flight.observers.append(taking)
        flight.start_companion()
        flight.run(AFTER_S)
        findings = list(findings_of(around.monitor.violations))
        if is_flying and taking.taken:
            findings.append(f"took the vehicle by itself after a restart ({taking.taken} requests)")
        return Outcome(
            trial,
            tuple(findings + starts),
            sums={"kills": 1.0, "damaged_checkpoints": float(len(damaged))},
            story=tuple(f"{t:8.2f} s  {text}" for t, text in around.notes.texts),
        )

    def _starts(self, store: MemoryStore, damaged: list[dict[int, bytes]]) -> list[str]:
        """What goes wrong when a store is read that was damaged; nothing may."""
        findings = []
        whole = dict(store.slots)
        for slots in damaged:
            store.slots = slots
            found = store.load()
            if found.checkpoint is not None and len(slots) == 1:
                findings.append("a damaged checkpoint was believed")
            if slots and not found.has_files:
                findings.append("a damaged checkpoint was taken for no checkpoint at all")
        store.slots = damaged[-1] if damaged else whole
        return findings


def damages(store: MemoryStore, seed: int) -> list[dict[int, bytes]]:
    """The larger checkpoint, alone, cut or flipped at places that go on from seed to seed.

    Consecutive seeds take consecutive places, so that a campaign reaches every byte.
    """
    if not store.slots:
        return []
    rng = np.random.default_rng((seed, 0xDA))
    number, data = max(store.slots.items(), key=lambda item: len(item[1]))
    damaged = []
    for count in range(CUTS_PER_TRIAL):
        place = (seed * CUTS_PER_TRIAL + count) % len(data)
        if count % 2:
            broken = data[:place]
        else:
            flipped = data[place] ^ 1 << int(rng.integers(8))
            broken = data[:place] + bytes((flipped,)) + data[place + 1 :]
        damaged.append({number: broken})
    return damaged


class Stops:
    """The part of the campaign that tells the process to stop."""

    name = "stop"
    title = "SIGTERM at random instants: hold confirmed in 1 s, gone in 2 s"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many stops."""
        return [Trial(self.name, trial_seed(seed, index)) for index in range(round(amount))]

    def cost(self, trial: Trial) -> float:  # noqa: ARG002
        """Seconds of one core."""
        return 0.8

    def run(self, trial: Trial) -> Outcome:
        """Stop, and watch the mode and the process."""
        around, dice = flight_of(trial.seed)
        flight = around.flight
        flight.run(dice.number(EARLIEST_S, LATEST_S))
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
        findings = list(findings_of(around.monitor.violations))
        if was_ours and (hold_s is None or hold_s > HOLD_S):
            findings.append(f"hold not confirmed within {HOLD_S:g} s of a stop")
        if gone_s is None or gone_s > EXIT_S:
            findings.append(f"not gone within {EXIT_S:g} s of a stop")
        return Outcome(
            trial,
            tuple(findings),
            sums={"stops": 1.0, "stops_in_control": float(was_ours)},
            most={
                "stop_hold_s": hold_s or 0.0 if was_ours else 0.0,
                "stop_exit_s": gone_s if gone_s is not None else EXIT_S + 1.0,
            },
            story=tuple(f"{t:8.2f} s  {text}" for t, text in around.notes.texts),
        )
