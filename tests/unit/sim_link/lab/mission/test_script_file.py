"""Mission files: what they may say, and where the error is when they say something else."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from companion.errors import ConfigError
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.faults.fault_models import LinkLoss
from sim_link.lab.mission.processes import check_faults, vehicle_fault_of
from sim_link.lab.mission.script import STEP_KINDS, ArmStep, Expectation, ReturnStep, TakeoffStep
from sim_link.lab.mission.script_file import flown_config, line_of, load_mission, parse_mission

BOW_TIE = [[0, 0], [10, 10], [10, 0], [0, 10]]
VAST = [[0, 0], [90_000, 0], [0, 90_000]]
FAR = [[900, 900], [910, 900], [910, 910]]
"""A position outside of the fence."""
SCRIPT = """\
name: two steps
about: A script for tests.

autopilot:
  flavour: ardupilot
emitter: {emitter_id: 7, position_enu_m: [20, 30]}
emitters:
  - {emitter_id: 8, position_enu_m: [40, 30]}
companion:
  mission: {altitude_m: 25}

steps:
  - connect
  - arm:
  - takeoff: {altitude_m: 20}
  - wait_until:
      condition: estimate.r95_m < 1
      limit_s: 60
  - inject: {kind: link_loss, share: 0.3, duration_s: 5}
  - search: {pattern: lawnmower, spacing_m: 15}
  - return

expectations:
  - name: close
    final_error_m: {at_most: 1, emitter: 8}
  - name: quiet
    never: {text: contradicted, from: companion}
"""


def test_a_script_is_a_scenario_with_steps_and_expectations() -> None:
    mission = parse_mission(SCRIPT, "m.yaml")
    assert mission.autopilot.flavour == "ardupilot"
    assert mission.config.mission.altitude_m == 25.0
    names = [name for name, _ in mission.named_steps]
    assert names == ["connect", "arm", "takeoff", "wait_until", "inject", "search", "return"]
    steps = [step for _, step in mission.named_steps]
    assert steps[1] == ArmStep()
    assert steps[2] == TakeoffStep(altitude_m=20.0)
    assert steps[4] == LinkLoss(share=0.3, duration_s=5.0)
    assert steps[6] == ReturnStep()
    assert type(mission.scenario) is Scenario
    assert mission.scenario.emitter.emitter_id == 7


def test_the_search_of_a_script_is_the_companions_search() -> None:
    planner = flown_config(parse_mission(SCRIPT, "m.yaml")).planner
    assert planner.search == "lawnmower"
    assert planner.pattern.spacing_m == 15.0
    without = parse_mission(
        SCRIPT.replace("  - search: {pattern: lawnmower, spacing_m: 15}\n", ""), "m"
    )
    assert flown_config(without) == without.config


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            "limit_s: 60",
            "limit_s: -3",
            "m.yaml:18: $.steps[3].wait_until.limit_s: expected a number",
        ),
        ("  - arm:", "  - arms:", "m.yaml:14: $.steps[1].arms: there is no step `arms`; did you m"),
        (
            "spacing_m: 15",
            "spacing_m: 0.5",
            "m.yaml:20: $.steps[5].search.spacing_m: expected a number",
        ),
        ("spacing_m: 15", "area_enu_m: [[0, 0], [1, 1]]", "m.yaml:20: $.steps[5].search: area"),
        ("spacing_m: 15", f"area_enu_m: {BOW_TIE}", "$.steps[5].search: area_enu_m has two edges"),
        ("spacing_m: 15", f"spacing_m: 1, area_enu_m: {VAST}", "more than 2000 lanes"),
        ("lawnmower, spacing_m: 15", "expanding_square, spacing_m: 500", "radius_m must not be le"),
        (
            "companion:",
            "companion:\n  emitters: {order: listed, listed: [9]}",
            "there is no emitter 9, only 7, 8",
        ),
        ("name: two steps", 'name: "two\\nsteps"', "m.yaml:1: $.name: must be one line"),
        ("name: quiet", 'name: "qu\\niet"', "$.expectations[1].name: must be one line"),
        ("name: two steps", 'name: "\\uD800"', "m.yaml:1: $.name: has characters that cannot"),
        ("estimate.r95_m <", "-" * 900 + "1 <", "$.steps[3].wait_until.condition: nested too dee"),
        (
            "at_most: 1,",
            "at_most: -1,",
            "$.expectations[0].final_error_m.at_most: expected a number",
        ),
        ("at_most: 1,", "at_most: 1, at_least: 2,", "they are swapped"),
        ("  - connect", "  - conect", "m.yaml:13: $.steps[0]: there is no step `conect`;"),
        ("  - connect", "  - conect", "did you mean connect?"),
        ("  - connect", "  - fly", "known are connect, wait_ready, arm,"),
        ("  - connect", "  - wait", "m.yaml:13: $.steps[0]: wait needs keys"),
        (
            "  - connect",
            "  - wait: {for_s: 1.0e+300}",
            "$.steps[0].wait.for_s: expected a number",
        ),
        ("  - connect", "  - hold: {for_s: 1.0e+9}", "$.steps[0].hold.for_s: expected a number"),
        ("name: two steps", "name: ''", "m.yaml:1: $.name: expected text of length >= 1"),
        ("estimate.r95_m <", "estimate.r95_m < 1e999 and 3 <", "a number in it is too large"),
        ("kind: link_loss", "kind: link_lost", "m.yaml:19: $.steps[4].inject.kind: there is no"),
        ("kind: link_loss", "kind: link_lost", "did you mean link_loss?"),
        ("share: 0.3", "share: 3", "m.yaml:19: $.steps[4].inject.share: expected a number"),
        ("  - arm:", "  - {arm: , land: }", "m.yaml:14: $.steps[1]: a step is exactly one"),
        ("  - arm:", "  - {}", "m.yaml:14: $.steps[1]: a step is exactly one of its kinds, not"),
        ("estimate.r95_m <", "estimate.r95 <", "m.yaml:17: $.steps[3].wait_until.condition: `est"),
        ("estimate.r95_m <", "estimate.r95 <", "did you mean estimate.r95_m?"),
        ("  - return\n", "  - search\n", "m.yaml:21: $.steps[6].search: a script has one search"),
        ("spacing_m: 15", f"area_enu_m: {FAR}", "$.steps: $.companion.planner.pattern.area"),
        ("altitude_m: 20}", "altitude_m: 90}", "m.yaml:15: $.steps[2].takeoff.altitude_m: 90 m is"),
        ("altitude_m: 25", "altitude_m: 99", "m.yaml:10: $.companion.mission.altitude_m: 99 m"),
        ("emitter_id: 8", "emitter_id: 7", "m.yaml:8: $.emitters[0].emitter_id: 7 is given twice"),
        ("emitter: 8", "emitter: 9", "m.yaml:25: $.expectations[0].final_error_m.emitter: there"),
        ("name: quiet", "name: close", "m.yaml:26: $.expectations[1].name: `close` is given twice"),
        ("at_most: 1", "at_mst: 1", "m.yaml:25: $.expectations[0].final_error_m.at_mst: unknown"),
        ("at_most: 1, ", "", "m.yaml:25: $.expectations[0].final_error_m: give at_most"),
        ("text: contradicted", "message: RADIO_RANGNG", "did you mean RADIO_RANGING?"),
        ("text: contradicted", "text: ''", "an empty text"),
        ("never:", "nver:", "m.yaml:27: $.expectations[1].nver: unknown key"),
        ("name: two steps\n", "", "m.yaml: $.name: required key is missing"),
        (
            "pattern: lawnmower",
            "pattern: spiral",
            "m.yaml:20: $.steps[5].search.pattern: spiral is none of",
        ),
        ("steps:", "steps: [", "m.yaml: line 13"),
    ],
)
def test_an_error_names_file_line_and_path(old: str, new: str, complaint: str) -> None:
    assert old in SCRIPT
    with pytest.raises(ConfigError) as caught:
        parse_mission(SCRIPT.replace(old, new, 1), "m.yaml")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [*STEP_KINDS, "inject"])
def test_an_error_in_any_step_is_refused_with_its_line(kind: str) -> None:
    text = f"name: x\nsteps:\n  - connect\n  - {kind}: {{limt_s: 1}}\n"
    with pytest.raises(ConfigError, match=rf"^m\.yaml:4: \$\.steps\[1\]\.{kind}"):
        parse_mission(text, "m.yaml")


@pytest.mark.parametrize(
    "kind", [field.name for field in msgspec.structs.fields(Expectation) if field.name != "name"]
)
def test_an_error_in_any_expectation_is_refused_with_its_line(kind: str) -> None:
    text = f"name: x\nsteps: [connect]\nexpectations:\n  - {{name: a, {kind}: [wrong]}}\n"
    with pytest.raises(ConfigError, match=rf"^m\.yaml:4: \$\.expectations\[0\]\.{kind}"):
        parse_mission(text, "m.yaml")


@pytest.mark.parametrize("invariants", [[], ["I12"], ["I10", "I12"]])
def test_invariants_that_no_flight_can_judge_are_no_expectation(invariants: list[str]) -> None:
    expectation = f"{{name: a, violations: {{invariants: {invariants}}}}}"
    with pytest.raises(ConfigError, match=r"violations\.invariants: none that a flight can judge"):
        parse_mission(f"name: x\nsteps: [connect]\nexpectations: [{expectation}]", "m.yaml")
    parse_mission(
        "name: x\nsteps: [connect]\nexpectations: [{name: a, violations: {invariants: [I1, I12]}}]",
        "m.yaml",
    )


def test_a_fault_that_cannot_be_injected_is_reported_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("name: x\nsteps:\n  - connect\n  - inject: {kind: forged_frames}\n")
    complaint = r"m\.yaml:4: \$\.steps\[1\]\.inject: only possible in lockstep"
    with pytest.raises(ConfigError, match=complaint):
        check_faults(load_mission(path), str(path))


def test_a_vehicle_of_others_is_not_flown_by_a_script_that_breaks_it() -> None:
    script = "name: x\nsteps:\n  - connect\n  - inject: {kind: %s}\n"
    reason = vehicle_fault_of(parse_mission(script % "battery", "m"))
    assert reason == "step 2 inject: a vehicle that is not ours cannot be broken"
    assert vehicle_fault_of(parse_mission(script % "link_loss", "m")) == ""


@pytest.mark.parametrize(
    ("autopilots", "reason"),
    [
        ("[px4]", "the script is for px4, and this is ardupilot"),
        ("[ardupilot]", ""),
        ("[px4, ardupilot]", ""),
        ("[]", ""),
    ],
)
def test_a_script_says_which_autopilots_it_fits(autopilots: str, reason: str) -> None:
    mission = parse_mission(f"name: x\nautopilots: {autopilots}\nsteps: [connect]\n", "m")
    assert mission.misfit("ardupilot") == reason


def test_a_companions_file_is_found_beside_the_script(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text("mission: {altitude_m: 31}\n")
    script = tmp_path / "mission.yaml"
    script.write_text("name: x\ncompanion: own.yaml\nsteps: [connect]\n")
    assert load_mission(script).config.mission.altitude_m == 31.0
    script.write_text("name: x\ncompanion: other.yaml\nsteps: [connect]\n")
    with pytest.raises(ConfigError, match=r"mission\.yaml:2: \$\.companion: .*no such file"):
        load_mission(script)


def test_a_search_before_a_search_is_refused() -> None:
    text = "name: x\ncompanion: {planner: {kind: survey, search: sector}}\nsteps: [search]\n"
    with pytest.raises(ConfigError, match="a survey already"):
        parse_mission(text, "m")


def test_only_a_lawnmower_has_an_area() -> None:
    text = """\
name: x
steps:
  - search: {pattern: sector, area_enu_m: [[0, 0], [9, 0], [9, 9]]}
"""
    with pytest.raises(ConfigError, match="only a lawnmower has an area"):
        parse_mission(text, "m")


@pytest.mark.parametrize(
    ("path", "line"),
    [("$", None), ("$.name", 1), ("$.steps[1]", 14), ("$.steps[99]", 12), ("$.nothing", None)],
)
def test_the_line_of_a_path(path: str, line: int | None) -> None:
    assert line_of(SCRIPT, path) == line


def test_a_script_may_take_its_scenario_from_a_file_and_replace_keys(tmp_path: Path) -> None:
    scenario = "name: elsewhere\nemitter: {height_m: 3.0}\nwind: {east_mps: 4.0}\n"
    (tmp_path / "site.yaml").write_text(scenario)
    script = "name: m\nscenario: site.yaml\nwind: {north_mps: 1.0}\nsteps: [connect]\n"
    mission = parse_mission(script, "m", tmp_path)
    assert mission.name == "m"
    assert mission.emitter.height_m == 3.0
    assert (mission.wind.east_mps, mission.wind.north_mps) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ("nowhere.yaml", r"nowhere\.yaml: no such file"),
        ("wrong.yaml", r"wrong\.yaml: \$\.wnid: unknown key"),
        ("[a, b]", r"m:2: \$\.scenario: unknown key"),
    ],
)
def test_a_scenario_file_that_is_wrong_is_named(tmp_path: Path, value: str, what: str) -> None:
    (tmp_path / "wrong.yaml").write_text("wnid: {east_mps: 4.0}\n")
    with pytest.raises(ConfigError, match=what):
        parse_mission(f"name: m\nscenario: {value}\nsteps: [connect]\n", "m", tmp_path)
