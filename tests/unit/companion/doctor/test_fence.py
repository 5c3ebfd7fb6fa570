"""The doctor compares the autopilot's fence with the one that would be kept in flight."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.config.schema import DEFAULT_FENCE, CompanionConfig, LimitsConfig
from companion.doctor.examination import examine, exit_code
from companion.doctor.findings import AutopilotFacts, CheckResult, Facts, Level
from companion.guidance.events import AutopilotFenceRead
from companion.mav.dialect import mavlink
from companion.mav.endpoint import Chunk
from sim_link.autopilot.endpoint import SimEndpoint
from tests.unit.companion.doctor.examples import FIT, HOST, LINK, ORIGIN, PX4, fence_about
from tests.unit.companion.doctor.test_probe import PEER, Practice

WIDER = ((-150.0, -150.0), (180.0, -150.0), (180.0, 150.0), (-150.0, 150.0))
NONE, SILENT = AutopilotFenceRead(0.0), AutopilotFenceRead(0.0, problem="no answer")
OTHER = AutopilotFenceRead(0.0, fence_about(ORIGIN, WIDER))
FENCE = mavlink.MAV_MISSION_TYPE_FENCE


def finding_about_fence(
    autopilot: AutopilotFacts, policy: str = "compare"
) -> tuple[CheckResult, list[CheckResult]]:
    limits = LimitsConfig(autopilot_fence=policy)  # type: ignore[arg-type]
    facts = replace(FIT, link=replace(LINK, autopilot=autopilot))
    findings = examine(facts, CompanionConfig(limits=limits))
    (found,) = [finding for finding in findings if finding.subject == "fence"]
    return found, findings


@pytest.mark.parametrize(
    ("fence", "policy", "level", "text"),
    [
        (PX4.fence, "compare", Level.OK, "4 corners, 0 keep-outs, margin 3.0 m; the autopilot's"),
        (PX4.fence, "require", Level.OK, "the autopilot's is the same"),
        (PX4.fence, "use", Level.OK, "the autopilot's own"),
        (PX4.fence, "ignore", Level.OK, "not checked"),
        (OTHER, "compare", Level.FAIL, "borders up to 30.0 m apart"),
        (OTHER, "require", Level.FAIL, "borders up to 30.0 m apart"),
        (NONE, "compare", Level.WARN, "autopilot has no fence"),
        (NONE, "require", Level.FAIL, "requires one"),
        (NONE, "use", Level.FAIL, "no fence to use"),
        (SILENT, "compare", Level.WARN, "no answer"),
        (None, "compare", Level.WARN, "the autopilot's fence is not known yet"),
    ],
)
def test_a_fence_is_judged_as_in_flight(
    fence: AutopilotFenceRead | None, policy: str, level: Level, text: str
) -> None:
    finding, findings = finding_about_fence(replace(PX4, fence=fence), policy)
    assert finding.level is level
    assert text in finding.text
    assert bool(finding.fix) is (level is not Level.OK)
    assert exit_code(findings) == int(level is Level.FAIL)


def test_without_an_origin_there_is_nothing_to_compare() -> None:
    finding, _ = finding_about_fence(replace(PX4, origin=None))
    assert finding.level is Level.WARN
    assert "the origin is not known yet" in finding.text


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
@pytest.mark.parametrize(("corners", "level"), [(DEFAULT_FENCE, Level.OK), (WIDER, Level.FAIL)])
def test_the_fence_is_read_from_the_autopilot(
    flavour: str, corners: tuple[tuple[float, float], ...], level: Level
) -> None:
    practice = Practice(flavour, 0.5)
    assert practice.sim is not None
    upload(practice.sim, corners)
    facts = Facts(HOST, practice.run())
    (finding,) = [f for f in examine(facts, CompanionConfig()) if f.subject == "fence"]
    assert finding.level is level, finding


def upload(sim: SimEndpoint, corners: tuple[tuple[float, float], ...]) -> None:
    """A ground station gives the autopilot a fence."""
    origin = sim.vehicle.origin
    positions = [origin.geodetic_from_enu((east, north, 0.0))[:2] for east, north in corners]
    count = mavlink.MAVLink_mission_count_message(1, 1, len(positions), FENCE)
    items = [
        mavlink.MAVLink_mission_item_int_message(
            *(1, 1, seq, 0, 5001, 0, 1, float(len(positions)), 0.0, 0.0, 0.0),
            *(round(lat * 1e7), round(lon * 1e7), 0.0, FENCE),
        )
        for seq, (lat, lon) in enumerate(positions)
    ]
    station = mavlink.MAVLink(None, 255, 190)
    for message in (count, *items):
        sim.receive(Chunk(0, bytes(message.pack(station)), PEER), 0.0)
        sim.take_output()
