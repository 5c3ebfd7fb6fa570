"""One short flight per kind of fault, on both autopilots in turn: no invariant breaks."""

from __future__ import annotations

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.session import SessionParams
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, RcParams, Scenario
from sim_link.campaign.flights import Monitored, monitored
from sim_link.campaign.missions import Missions
from sim_link.campaign.runner import run_one
from sim_link.campaign.trial import Trial
from sim_link.faults.kinds import KINDS, Fault
from sim_link.faults.schedule import Schedule, fault_from

AUTO = CompanionConfig(mission=SessionParams(engage="auto", stop_confirm_s=1e6))
ENGAGED_S, FAULT_S, AFTER_S = 13.0, 3.0, 4.0
SIGNED = ("forged_frames", "replayed_frames", "unsigned_frames")
NAMES = sorted(KINDS)
MISSIONS = (1, 5, 9, 14)


def flown(kind: str) -> Monitored:
    """A search in which this goes wrong for a while."""
    flavour: FlavourName = "px4" if NAMES.index(kind) % 2 else "ardupilot"
    scenario = Scenario(
        autopilot=AutopilotParams(flavour=flavour), rc=RcParams(is_present=kind == "pilot_sticks")
    )
    around = monitored(AUTO, scenario, 3, is_signed=kind in SIGNED)
    around.flight.run(ENGAGED_S)
    fault: Fault = fault_from({"kind": kind, "start_s": 1.0})
    around.injector.inject(Schedule(faults=(msgspec.structs.replace(fault, duration_s=FAULT_S),)))
    around.flight.run(1.0 + FAULT_S + AFTER_S)
    return around


@pytest.mark.parametrize("kind", NAMES)
def test_no_invariant_breaks_while_this_goes_wrong(kind: str) -> None:
    monitor = flown(kind).monitor
    assert [str(violation) for violation in monitor.violations] == []
    assert monitor.fence.closest_m > 0.0


@pytest.mark.parametrize("seed", MISSIONS)
def test_random_missions_with_several_faults_break_none(seed: int) -> None:
    assert run_one(Trial(Missions.name, seed)).findings == ()
