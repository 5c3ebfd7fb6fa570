"""Hours of flight over a bad link: how long the vehicle hears nothing, what is said of the link.

A receiver that counts is all that is needed of the vehicle, so the flight is an endless hold: the
companion is in control and waits for ranging that never comes, and the vehicle obeys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from companion.config.schema import CompanionConfig
from companion.guidance.session_params import SessionParams
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import (
    AutopilotParams,
    BatteryParams,
    FlavourName,
    PayloadParams,
    Scenario,
)
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.trial import Outcome, Trial, trial_seed
from sim_link.faults.link_kinds import LinkLoss
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.observer import Frame, Observer

SETTLING_S = 30.0
"""The loss is known after this long."""
LOSSES = (0.1, 0.3, 0.5)
MOST_GAP_S = {0.1: 0.4, 0.3: 0.4, 0.5: 0.5}
"""At the receiver."""
HOUR_S = 3600.0
PIECE_H = 0.25
"""Hours of one trial."""
MOST_FALSE_LOSSES_PER_10_H = 1.0
SETPOINT = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED


class Gaps(Observer):
    """The setpoints that reach the vehicle, and what the companion says of its link."""

    def __init__(self) -> None:
        self.worst_s = 0.0
        self.over_half_s = 0
        self.false_losses = 0
        self.is_counting = False
        self._last_s: float | None = None

    def vehicle_heard(self, frame: Frame) -> None:
        """Measure from one setpoint to the next."""
        if frame.number != SETPOINT or not frame.is_readable:
            return
        if self._last_s is not None and self.is_counting:
            gap_s = frame.time_s - self._last_s
            self.worst_s = max(self.worst_s, gap_s)
            self.over_half_s += gap_s > 0.5
        self._last_s = frame.time_s

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:  # noqa: ARG002
        """Count links declared lost that never were."""
        if self.is_counting and kind == "text" and "link lost" in str(fields.get("text")):
            self.false_losses += 1


def pauses_of(gaps: Gaps, share: float) -> list[str]:
    """What is wrong with the stream at such a loss: that it paused for too long."""
    if gaps.worst_s <= MOST_GAP_S[share]:
        return []
    return [f"gap of {gaps.worst_s:.3f} s at {share:.0%} loss"]


class GapHours:
    """The part of the campaign that flies for hours."""

    name = "gaps"
    title = "hours over a link that loses 10, 30 and 50 %"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many hours at each loss, in quarters of an hour."""
        pieces = max(1, math.ceil(amount / PIECE_H))
        size = amount / pieces
        count = len(LOSSES) * pieces
        return [Trial(self.name, trial_seed(seed, index), size) for index in range(count)]

    def cost(self, trial: Trial) -> float:
        """Seconds of one core."""
        return 30.0 * trial.size / PIECE_H

    def run(self, trial: Trial) -> Outcome:
        """Fly for a while."""
        share = LOSSES[trial.seed % len(LOSSES)]
        around, gaps = flown(trial.seed, share, trial.size * HOUR_S)
        name = f"{share:.0%}".replace("%", "_pct")
        findings = pauses_of(gaps, share)
        if not math.isfinite(around.monitor.fence.closest_m):
            findings.append("the companion never was in control")
        return Outcome(
            trial,
            tuple(findings),
            sums={
                f"hours_{name}": trial.size,
                f"false_losses_{name}": float(gaps.false_losses),
                f"gaps_over_500_ms_{name}": float(gaps.over_half_s),
            },
            most={f"max_gap_s_{name}": gaps.worst_s, "max_gap_s": gaps.worst_s},
        )


def flown(seed: int, share: float, duration_s: float) -> tuple[Monitored, Gaps]:
    """A flight that holds over a link that loses so much, in both directions."""
    flavour: FlavourName = "px4" if seed % 2 else "ardupilot"
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour),
        battery=BatteryParams(endurance_s=1e6),
        payload=PayloadParams(max_range_m=0.001),
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    around, gaps = monitored(config, scenario, seed), Gaps()
    around.flight.observers.append(gaps)
    around.flight.run(SETTLING_S)
    around.injector.inject(Schedule(faults=(LinkLoss(share=share),)))
    around.flight.run(SETTLING_S)
    gaps.is_counting = True
    around.flight.run(duration_s)
    return around, gaps
