"""Missions flown in lockstep: companion and vehicle in memory, on a virtual clock."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from companion.io.log_files import read_tlog
from companion.mav.codec import message_id, sender_of
from companion.mav.dialect import MAVLink_radio_ranging_message as RadioRanging
from sim_link.autopilot.scenario import FlavourName
from sim_link.lab.mission.batch import MissionBatch, fly_task, with_autopilot
from sim_link.lab.mission.in_memory import fly_in_memory
from sim_link.lab.mission.results import MissionResult
from sim_link.lab.mission.script import Expectation, GrantStep, Mission
from sim_link.lab.mission.script_file import load_mission, parse_mission
from tests.planted_companions import FliesAway

LIBRARY = Path(__file__).parents[2] / "configs" / "missions"
CANONICAL = LIBRARY / "canonical.yaml"
SHORT = """\
name: short
steps: [connect, wait_ready, arm, {takeoff: {altitude_m: 6}}, engage, {wait: {for_s: 2}}, land]
"""


def failed_names(result: MissionResult) -> list[str]:
    return [verdict.name for verdict in result.failed]


@pytest.fixture(scope="module")
def canonical() -> MissionResult:
    return fly_in_memory(load_mission(CANONICAL), 1)


def test_the_canonical_mission_finds_the_emitter_and_comes_home(canonical: MissionResult) -> None:
    assert canonical.failed == []
    assert canonical.final_error_m is not None
    assert canonical.final_error_m < 1.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_event_log_to_the_byte(canonical: MissionResult) -> None:
    again = fly_in_memory(load_mission(CANONICAL), 1)
    assert again.event_log == canonical.event_log
    assert len(canonical.event_log) > 10_000
    other = fly_in_memory(load_mission(CANONICAL), 2)
    assert other.event_log != canonical.event_log


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_short_hop_on_both_autopilots(flavour: FlavourName) -> None:
    mission = parse_mission(SHORT, "short")
    result = fly_in_memory(with_autopilot(mission, flavour), 0)
    assert result.failed == []
    assert result.record.ended_s < 40.0


@pytest.mark.parametrize("flavour", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_the_checklist_of_the_first_flight_is_flown_as_it_stands(flavour: FlavourName) -> None:
    """Control is taken back once and given again by the switch alone, after `ready`."""
    page = (LIBRARY.parents[1] / "docs" / "first-flight.md").read_text()
    assert "configs/missions/first-flight.yaml" in page
    mission = load_mission(LIBRARY / "first-flight.yaml")
    assert not any(isinstance(step, GrantStep) for _, step in mission.named_steps)
    result = fly_in_memory(with_autopilot(mission, flavour), 0)
    assert result.failed == []


@pytest.mark.slow
def test_a_vehicle_that_errs_about_its_height_still_takes_off_as_its_operator_sees_it() -> None:
    wrong = "navigation: {sigma_m: 3.0, height_sigma_m: 20.0, time_constant_s: 1000.0}\n"
    result = fly_in_memory(parse_mission(SHORT + wrong, "short"), 1)
    assert result.failed == []
    truth = [position[2] for _, position in result.record.track]
    assert max(truth) == pytest.approx(6.0, abs=3.0)


@pytest.mark.slow
def test_a_mission_in_the_field_is_honest_on_the_earth() -> None:
    result = fly_in_memory(load_mission(LIBRARY / "field-uwb-two-axis.yaml"), 0)
    assert result.failed == []


BROKEN = {
    "final_error_m": {"at_most": 0},
    "error_over_r95": {"at_most": 0},
    "error_over_absolute_r95": {"at_most": 0},
    "reported_s": {"at_most": 0},
    "time_s": {"at_most": 1},
    "distance_m": {"at_most": 1},
    "appears": {"text": "never announced"},
    "never": {"message": "RADIO_RANGING"},
    "holds": "vehicle.is_armed",
    "always": "vehicle.height_m < 5",
}


@pytest.mark.slow
def test_every_expectation_that_is_broken_fails_by_its_name() -> None:
    script = msgspec.to_builtins(parse_mission(SHORT, "short"))
    script["expectations"] = [
        {"name": f"broken {kind}", kind: value} for kind, value in BROKEN.items()
    ]
    mission = msgspec.convert(script, Mission)
    result = fly_in_memory(mission, 0)
    assert failed_names(result) == [f"broken {kind}" for kind in BROKEN]


@pytest.mark.slow
def test_a_companion_that_leaves_the_fence_breaks_what_is_expected_of_the_invariants() -> None:
    script = msgspec.to_builtins(parse_mission(SHORT, "short"))
    script["expectations"] = [{"name": "broken violations", "violations": {}}]
    mission = msgspec.convert(script, Mission)
    result = fly_in_memory(mission, 0, make_companion=FliesAway)
    assert failed_names(result) == ["broken violations"]
    assert "I1" in {violated.invariant for violated in result.record.violations}


def test_every_kind_of_expectation_is_broken_by_a_flight_here() -> None:
    kinds = {field.name for field in msgspec.structs.fields(Expectation)} - {"name"}
    assert BROKEN.keys() | {"violations"} == kinds


def test_a_step_that_cannot_be_done_fails_the_flight() -> None:
    steps = "[connect, {wait_until: {condition: vehicle.is_armed, limit_s: 3}}]"
    result = fly_in_memory(parse_mission(f"name: m\nsteps: {steps}\n", "m"), 0)
    assert failed_names(result) == ["all steps"]
    assert "did not happen within 3 s" in result.failed[0].found


@pytest.mark.slow
def test_a_flights_report_is_written(tmp_path: Path) -> None:
    script = tmp_path / "short.yaml"
    script.write_text(SHORT)
    (task,) = MissionBatch([script], seeds=[5], reports=tmp_path).tasks()
    summary = fly_task(task)
    assert summary.is_passed
    assert Path(summary.report).name == "short-px4-lockstep-seed5.html"
    assert Path(summary.report).with_suffix(".jsonl").read_text().startswith('{"t_s":0.0,')
    frames = [record.frame for record in read_tlog(Path(summary.report).with_suffix(".tlog"))]
    assert {sender_of(frame)[1] for frame in frames} == {1, 158, 191}
    assert any(message_id(frame) == RadioRanging.id for frame in frames)
