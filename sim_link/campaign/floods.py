"""An attacker floods a signed link: nothing that is not proved changes anything."""

from __future__ import annotations

import time
from collections.abc import Sequence

from companion.config.schema import CompanionConfig
from companion.guidance.session_params import SessionParams
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.trial import Outcome, Trial, findings_of, trial_seed
from sim_link.faults.host_kinds import ForgedFrames, ReplayedFrames, UnsignedFrames
from sim_link.faults.kinds import Fault
from sim_link.faults.schedule import Schedule
from sim_link.lockstep.observer import Frame, Observer

RATE_HZ = 20_000.0
FRAMES_PER_TRIAL = 50_000
STATUSTEXT = mavlink.MAVLINK_MSG_ID_STATUSTEXT
PAYLOAD = 10
SLOWEST_FRAME_S = 0.05
ENGAGED_S = 15.0


class Output(Observer):
    """All that the companion sent."""

    def __init__(self) -> None:
        self.acts: list[tuple[float, int, bytes]] = []
        """Time, message and payload; texts for the operator tell of the attack and are left out."""
        self.attacks = 0
        self.slowest_s = 0.0
        self._began_s = 0.0

    def sent(self, frame: Frame) -> None:
        """Keep it, without sequence number and signature."""
        if frame.number != STATUSTEXT:
            payload = frame.data[PAYLOAD : PAYLOAD + frame.data[1]]
            self.acts.append((frame.time_s, frame.number, payload))

    def heard(self, frame: Frame) -> None:
        """Begin to measure."""
        self.attacks += not frame.is_genuine
        self._began_s = time.thread_time()

    def read(self, frame: Frame) -> None:
        """How long an attacker's frame took."""
        if frame.is_genuine:
            return
        self.slowest_s = max(self.slowest_s, time.thread_time() - self._began_s)


class Floods:
    """The part of the campaign that forges, replays and leaves signatures out."""

    name = "forged"
    title = "forged, replayed and unsigned frames at 20,000 a second beside genuine traffic"

    def trials(self, amount: float, seed: int) -> Sequence[Trial]:
        """So many frames."""
        count = -(-round(amount) // FRAMES_PER_TRIAL)
        size = amount / count / FRAMES_PER_TRIAL
        return [Trial(self.name, trial_seed(seed, index), size) for index in range(count)]

    def cost(self, trial: Trial) -> float:
        """Seconds of one core."""
        return 1.5 + 3.0 * trial.size

    def run(self, trial: Trial) -> Outcome:
        """Fly twice, once in peace; what is sent must be the same, byte for byte."""
        duration_s = trial.size * FRAMES_PER_TRIAL / RATE_HZ
        kinds: tuple[Fault, ...] = (
            ForgedFrames(rate_hz=RATE_HZ, duration_s=duration_s),
            ReplayedFrames(rate_hz=RATE_HZ, duration_s=duration_s),
            UnsignedFrames(rate_hz=RATE_HZ, duration_s=duration_s),
        )
        fault = kinds[trial.seed % len(kinds)]
        attacked, output = _flown(trial.seed, fault, duration_s)
        _, peace = _flown(trial.seed, None, duration_s)
        findings = list(findings_of(attacked.monitor.violations))
        if output.acts != peace.acts:
            findings.append("the companion sent something else under attack")
        if output.slowest_s > SLOWEST_FRAME_S:
            findings.append(f"a frame took {output.slowest_s:.3f} s")
        return Outcome(
            trial,
            tuple(findings),
            sums={"attack_frames": float(output.attacks)},
            most={"attack_slowest_frame_s": output.slowest_s},
        )


def _flown(seed: int, fault: Fault | None, duration_s: float) -> tuple[Monitored, Output]:
    flavour: FlavourName = "px4" if seed % 2 else "ardupilot"
    config = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    around, output = monitored(config, scenario, seed, is_signed=True, is_spoofing=False), Output()
    around.flight.observers.append(output)
    around.flight.run(ENGAGED_S)
    if fault is not None:
        around.injector.inject(Schedule(faults=(fault,)))
    around.flight.run(duration_s + 1.0)
    return around, output
