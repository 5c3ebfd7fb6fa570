"""The pilot takes over at a random instant: nothing may follow the frame that shows it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import FlightMode
from companion.guidance.session_params import SessionParams
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.draws import Dice
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.faults.kinds import Fault
from sim_link.faults.link_kinds import LinkJitter, LinkLoss
from sim_link.faults.schedule import Schedule
from sim_link.faults.vehicle_kinds import PilotMode

LOSSES = (0.0, 0.1, 0.3)
MODES = (FlightMode.HOLD, FlightMode.RETURN, FlightMode.LAND)
BEFORE_S, OVER_S, AFTER_S = 14.0, 12.0, 4.0
"""Boot and take-off; the time in which the pilot acts; how long silence is watched."""
AGAIN = 10
"""Take-overs in one flight: the operator gives control back in between."""
GIVE_BACK_S = 3.0


class Overrides:
    """The part of the campaign that takes over."""

    name = "override"
    title = "pilot take-overs at random instants, 0, 10 and 30 % loss"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many take-overs, ten in a flight."""
        return [Trial(self.name, trial_seed(seed, i)) for i in range(-(-round(amount) // AGAIN))]

    def cost(self, trial: Trial) -> float:  # noqa: ARG002
        """Seconds of one core."""
        return 1.5

    def run(self, trial: Trial) -> Outcome:
        """Ten take-overs in one flight."""
        rng = np.random.default_rng((trial.seed, 0x0E7))
        dice = Dice(rng)
        around = _flight(trial.seed, dice)
        flight = around.flight
        flight.run(BEFORE_S)
        shown = 0
        for _ in range(AGAIN):
            if not _give_back(around):
                continue
            flight.run(dice.number(0.0, OVER_S / AGAIN * 2.0))
            mode = dice.one(MODES)
            around.injector.inject(Schedule(faults=(PilotMode(mode=mode),)))
            flight.run(AFTER_S)
            shown += 1
        late = around.monitor.authority.late
        return Outcome(
            trial,
            findings_of(around.monitor.violations),
            sums={"overrides": float(shown), "override_late_frames": float(late)},
            most={"override_worst_late_s": around.monitor.authority.worst_late_s},
            story=tuple(f"{t:8.2f} s  {text}" for t, text in around.notes.texts),
        )


def _flight(seed: int, dice: Dice) -> Monitored:
    flavour: FlavourName = "px4" if dice.happens(0.5) else "ardupilot"
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    mission = SessionParams(engage="auto", stop_confirm_s=1e6)
    around = monitored(CompanionConfig(mission=mission), scenario, seed)
    faults: list[Fault] = []
    share = dice.one(LOSSES)
    if share:
        faults.append(LinkLoss(share=share))
    if dice.happens(0.3):
        faults.append(LinkJitter(jitter_s=0.15))
    around.injector.inject(Schedule(faults=tuple(faults)))
    return around


def _give_back(around: Monitored) -> bool:
    """Whether the vehicle obeys the companion, if need be after the operator gave it back."""
    flight = around.flight
    for _ in range(4):
        if flight.mode is FlightMode.OFFBOARD and around.monitor.scene.told.is_ours:
            return True
        around.operator.grant()
        flight.run(GIVE_BACK_S)
        around.operator.choose(FlightMode.OFFBOARD)
        flight.run(0.5)
    return flight.mode is FlightMode.OFFBOARD
