"""Trials of the link: long losses, stale positions, and floods of frames.

For the gaps the flight is an endless hold: the companion is in control and waits for ranging that
never comes. The floods are an attacker's on a signed link: unauthenticated frames change nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

from companion.config.schema import CompanionConfig
from companion.domain import PositionEnu
from companion.guidance.commands import SessionParams
from companion.mav.dialect import mavlink
from sim_link.autopilot.incidents import FaultRecord
from sim_link.autopilot.scenario import AutopilotParams, BatteryParams, PayloadParams, Scenario
from sim_link.lab.faults import fault_models as faults
from sim_link.lab.observer import Frame, Observer
from tools.campaign import flights
from tools.campaign.flights import Monitored, Part, Trial, TrialOutcome

SETTLING_S = 30.0
"""The loss is known after this long."""
LOSSES = (0.1, 0.3, 0.5)
MAX_GAP_S = {0.1: 0.4, 0.3: 0.4, 0.5: 0.5}
HOUR_S = 3600.0
PIECE_H = 0.25
MAX_FALSE_LOSSES_PER_10_H = 1.0
SETPOINT = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED


class Gaps(Observer):
    """Setpoints that reach the vehicle, and link losses that the companion reports."""

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
        """Count false reports of a lost link."""
        if self.is_counting and kind == "text" and "link lost" in str(fields.get("text")):
            self.false_losses += 1


def pauses_of(gaps: Gaps, share: float) -> list[str]:
    """Return a finding if the stream paused for too long at such a loss."""
    if gaps.worst_s <= MAX_GAP_S[share]:
        return []
    return [f"gap of {gaps.worst_s:.3f} s at {share:.0%} loss"]


def gap_pieces(amount_h: float) -> tuple[int, float]:
    """Return the hours at each loss, in quarters of an hour."""
    pieces = max(1, math.ceil(amount_h / PIECE_H))
    return len(LOSSES) * pieces, amount_h / pieces


def hold_for_hours(trial: Trial) -> TrialOutcome:
    """Hold for a while over a link that loses frames."""
    share = LOSSES[trial.seed % len(LOSSES)]
    around, gaps = hold_over(trial.seed, share, trial.size * HOUR_S)
    name = f"{share:.0%}".replace("%", "_pct")
    findings = pauses_of(gaps, share)
    if not math.isfinite(around.monitor.fence.closest_m):
        findings.append("the companion never was in control")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={
            f"hours_{name}": trial.size,
            f"false_losses_{name}": float(gaps.false_losses),
            f"gaps_over_500_ms_{name}": float(gaps.over_half_s),
        },
        most={f"max_gap_s_{name}": gaps.worst_s, "max_gap_s": gaps.worst_s},
    )


def hold_over(seed: int, share: float, duration_s: float) -> tuple[Monitored, Gaps]:
    """Fly a position hold over a link with losses in both directions."""
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flights.flavour_of(seed)),
        battery=BatteryParams(endurance_s=1e6),
        payload=PayloadParams(max_range_m=0.001),
    )
    config = CompanionConfig(mission=SessionParams(engage="auto"))
    around, gaps = flights.monitored_flight(config, scenario, seed), Gaps()
    around.flight.observers.append(gaps)
    around.flight.run(SETTLING_S)
    around.injector.add(faults.LinkLoss(share=share))
    around.flight.run(SETTLING_S)
    gaps.is_counting = True
    around.flight.run(duration_s)
    return around, gaps


POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
STALE_S, LOST_S, TICK_S = 0.5, 1.0, 0.05
"""Age above which a position is not flown on, silence after which a link is lost, and the tick that
decides both, s."""
STILL_M = 0.02
BLIND_S = 3.0
REACTION_ENGAGED_S = 14.0


class ReactionWatch(Observer):
    """Times of the last position, message, moving setpoint and of the text about a lost link."""

    def __init__(self) -> None:
        self.position_s = 0.0
        self.heard_s = 0.0
        self.moved_s = 0.0
        self.lost_s: float | None = None
        self._position: PositionEnu | None = None

    def heard(self, frame: Frame) -> None:
        """Note a frame of the autopilot."""
        if frame.sender[1] != 1:
            return
        self.heard_s = frame.time_s
        if frame.number == POSITION:
            self.position_s = frame.time_s

    def sent(self, frame: Frame) -> None:
        """Note a setpoint, and whether it moved."""
        message = frame.message
        if not isinstance(message, mavlink.MAVLink_set_position_target_local_ned_message):
            return
        position = (message.x, message.y, message.z)
        if self._position is not None:
            step = max(abs(a - b) for a, b in zip(position, self._position, strict=True))
            if step > STILL_M:
                self.moved_s = frame.time_s
        self._position = position

    def noted(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Take a journal entry of the companion."""
        if kind == "text" and "link lost" in str(fields.get("text")) and self.lost_s is None:
            self.lost_s = now_s


def react(trial: Trial) -> TrialOutcome:
    """Cut the link, and measure."""
    around, dice = flights.launched_flight(trial.seed, 0x2EAC)
    flight, watch = around.flight, ReactionWatch()
    flight.observers.append(watch)
    flight.run(REACTION_ENGAGED_S + dice.number(0.0, 10.0))
    is_mute = dice.happens(0.5)
    cut = faults.StreamMute if is_mute else faults.LinkBlackout
    around.injector.add(cut(duration_s=BLIND_S))
    watch.lost_s = None
    flight.run(BLIND_S - TICK_S)
    hold_s = max(0.0, watch.moved_s - watch.position_s)
    findings = around.findings
    most = {"hold_after_stale_s": hold_s}
    if hold_s > STALE_S + TICK_S:
        findings.append(f"moved {hold_s:.3f} s after the last position")
    if not is_mute:
        lost_s = flight.now_s if watch.lost_s is None else watch.lost_s
        silent_s = most["link_lost_s"] = lost_s - watch.heard_s
        if not LOST_S <= silent_s <= LOST_S + 2.0 * TICK_S:
            findings.append(f"link declared lost {silent_s:.3f} s after silence began")
    return TrialOutcome(trial, tuple(findings), sums={"cuts": 1.0}, most=most)


RATE_HZ = 20_000.0
FRAMES_PER_TRIAL = 50_000
STATUSTEXT = mavlink.MAVLINK_MSG_ID_STATUSTEXT
PAYLOAD = 10
SLOWEST_FRAME_S = 0.05
FLOOD_ENGAGED_S = 15.0


class Output(Observer):
    """Everything that the companion sent."""

    def __init__(self) -> None:
        self.acts: list[tuple[float, int, bytes]] = []
        """Time, message and payload; texts for the operator mention the attack and are left out."""
        self.attacks = 0
        self.slowest_s = 0.0
        self._began_s = 0.0

    def sent(self, frame: Frame) -> None:
        """Keep a frame, without sequence number and signature."""
        if frame.number != STATUSTEXT:
            payload = frame.data[PAYLOAD : PAYLOAD + frame.data[1]]
            self.acts.append((frame.time_s, frame.number, payload))

    def heard(self, frame: Frame) -> None:
        """Start measuring."""
        self.attacks += not frame.is_genuine
        self._began_s = time.thread_time()

    def read(self, frame: Frame) -> None:
        """Measure the time to reject an attacker's frame."""
        if frame.is_genuine:
            return
        self.slowest_s = max(self.slowest_s, time.thread_time() - self._began_s)


ATTACKS = (faults.ForgedFrames, faults.ReplayedFrames, faults.UnsignedFrames)


def flood(trial: Trial) -> TrialOutcome:
    """Fly twice, once undisturbed; the output must be the same, byte for byte."""
    duration_s = trial.size * FRAMES_PER_TRIAL / RATE_HZ
    fault = ATTACKS[trial.seed % len(ATTACKS)](rate_hz=RATE_HZ, duration_s=duration_s)
    attacked, output = _fly(trial.seed, fault, duration_s)
    _, peace = _fly(trial.seed, None, duration_s)
    findings = attacked.findings
    if output.acts != peace.acts:
        findings.append("the companion sent something else under attack")
    if output.slowest_s > SLOWEST_FRAME_S:
        findings.append(f"a frame took {output.slowest_s:.3f} s")
    return TrialOutcome(
        trial,
        tuple(findings),
        sums={"attack_frames": float(output.attacks)},
        most={"attack_slowest_frame_s": output.slowest_s},
    )


def _fly(seed: int, fault: FaultRecord | None, duration_s: float) -> tuple[Monitored, Output]:
    scenario = Scenario(autopilot=AutopilotParams(flavour=flights.flavour_of(seed)))
    around = flights.monitored_flight(
        flights.ENDLESS, scenario, seed, is_signed=True, is_spoofing=False
    )
    output = Output()
    around.flight.observers.append(output)
    around.flight.run(FLOOD_ENGAGED_S)
    if fault is not None:
        around.injector.add(fault)
    around.flight.run(duration_s + 1.0)
    return around, output


GAPS = Part(
    "gaps",
    "hours over a link that loses 10, 30 and 50 %",
    run=hold_for_hours,
    cost_s=30.0 / PIECE_H,
    split=gap_pieces,
)
REACTIONS = Part(
    "reaction", "hold within 0.5 s of a stale position, link lost at 1.0 s", run=react, cost_s=0.5
)
FLOODS = Part(
    "forged",
    "forged, replayed and unsigned frames at 20,000 a second among genuine traffic",
    run=flood,
    cost_s=3.0,
    base_cost_s=1.5,
    split=flights.frames_each(FRAMES_PER_TRIAL),
)
