"""How soon the companion holds on a stale position, and declares a link lost that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from companion.config.schema import CompanionConfig
from companion.domain import PositionEnu
from companion.guidance.session_params import SessionParams
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.draws import Dice
from sim_link.campaign.flights import monitored
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.faults.content_kinds import StreamMute
from sim_link.faults.link_kinds import LinkBlackout
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.observer import Frame, Observer

POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
STALE_S, LOST_S, TICK_S = 0.5, 1.0, 0.05
"""A position this old is not flown on; a link this silent is lost; a tick decides both."""
STILL_M = 0.02
BLIND_S = 3.0
ENGAGED_S = 14.0


class Watch(Observer):
    """When a position, anything, a moving setpoint and the word of a lost link came last."""

    def __init__(self) -> None:
        self.position_s = 0.0
        self.heard_s = 0.0
        self.moved_s = 0.0
        self.lost_s: float | None = None
        self._place: PositionEnu | None = None

    def heard(self, frame: Frame) -> None:
        """A frame of the autopilot."""
        if frame.sender[1] != 1:
            return
        self.heard_s = frame.time_s
        if frame.number == POSITION:
            self.position_s = frame.time_s

    def sent(self, frame: Frame) -> None:
        """A setpoint, and whether it moved."""
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_set_position_target_local_ned_message):
            return
        place = (message.x, message.y, message.z)
        if self._place is not None:
            step = max(abs(a - b) for a, b in zip(place, self._place, strict=True))
            if step > STILL_M:
                self.moved_s = frame.time_s
        self._place = place

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """What the companion says."""
        if kind == "text" and "link lost" in str(fields.get("text")) and self.lost_s is None:
            self.lost_s = now_s


class Reactions:
    """The part of the campaign that cuts at random instants."""

    name = "reaction"
    title = "hold within 0.5 s of a stale position, link lost at 1.0 s"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many cuts."""
        return [Trial(self.name, trial_seed(seed, index)) for index in range(round(amount))]

    def cost(self, trial: Trial) -> float:  # noqa: ARG002
        """Seconds of one core."""
        return 0.5

    def run(self, trial: Trial) -> Outcome:
        """Cut, and measure."""
        dice = Dice(np.random.default_rng((trial.seed, 0x2EAC)))
        flavour: FlavourName = "px4" if dice.happens(0.5) else "ardupilot"
        config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
        around = monitored(config, Scenario(autopilot=AutopilotParams(flavour=flavour)), trial.seed)
        flight, watch = around.flight, Watch()
        flight.observers.append(watch)
        flight.run(ENGAGED_S + dice.number(0.0, 10.0))
        is_mute = dice.happens(0.5)
        fault = StreamMute(duration_s=BLIND_S) if is_mute else LinkBlackout(duration_s=BLIND_S)
        around.injector.inject(Schedule(faults=(fault,)))
        watch.lost_s = None
        flight.run(BLIND_S - TICK_S)
        hold_s = max(0.0, watch.moved_s - watch.position_s)
        findings = list(findings_of(around.monitor.violations))
        most = {"hold_after_stale_s": hold_s}
        if hold_s > STALE_S + TICK_S:
            findings.append(f"moved {hold_s:.3f} s after the last position")
        if not is_mute:
            lost_s = flight.now_s if watch.lost_s is None else watch.lost_s
            most["link_lost_s"] = lost_s - watch.heard_s
            if not LOST_S <= most["link_lost_s"] <= LOST_S + 2.0 * TICK_S:
                findings.append(
                    f"link declared lost {most['link_lost_s']:.3f} s after silence began"
                )
        return Outcome(trial, tuple(findings), sums={"cuts": 1.0}, most=most)
