"""Consequences of the autopilot's parameters for a flight."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.config.schema import CompanionConfig, LimitsConfig
from companion.doctor.autopilot_settings import RENAMED, check_parameters, needed_parameters
from companion.doctor.findings import AutopilotFacts, CheckResult, Level
from companion.domain import Autopilot
from tests.unit.companion.doctor.examples import ARDUPILOT_PARAMETERS, PX4, PX4_PARAMETERS

ARDUPILOT = replace(PX4, autopilot=Autopilot.ARDUPILOT, parameters=ARDUPILOT_PARAMETERS)


def with_value(facts: AutopilotFacts, name: str, value: float | None) -> AutopilotFacts:
    assert name in facts.parameters
    return replace(facts, parameters={**facts.parameters, name: value})


def findings_about(name: str, facts: AutopilotFacts) -> list[CheckResult]:
    return [f for f in check_parameters(facts, CompanionConfig()) if f.subject == name]


@pytest.mark.parametrize("facts", [PX4, ARDUPILOT])
def test_good_parameters_need_no_mending(facts: AutopilotFacts) -> None:
    findings = list(check_parameters(facts, CompanionConfig()))
    assert findings
    assert {finding.level for finding in findings} == {Level.OK}
    assert set(needed_parameters(facts.autopilot)) - set(RENAMED.values()) == set(facts.parameters)


@pytest.mark.parametrize(
    ("name", "value", "has_rc", "level", "text"),
    [
        ("COM_OF_LOSS_T", 0.2, True, Level.FAIL, "a few lost packets"),
        ("COM_OF_LOSS_T", 0.5, True, Level.OK, "0.5 s"),
        ("COM_OF_LOSS_T", 20.0, True, Level.WARN, "keeps flying"),
        ("COM_OBL_RC_ACT", 0, False, Level.WARN, "sinks and drifts"),
        ("COM_OBL_RC_ACT", 0, None, Level.WARN, "sinks and drifts"),
        ("COM_OBL_RC_ACT", 0, True, Level.WARN, "the pilot must take over"),
        ("COM_OBL_RC_ACT", 3, False, Level.OK, "3 (Return)"),
        ("COM_OBL_RC_ACT", 7, True, Level.FAIL, "7 (Disarm)"),
        ("COM_OBL_RC_ACT", 99, True, Level.FAIL, "99 (unknown)"),
        ("COM_RC_OVERRIDE", 3, True, Level.OK, "sticks take over"),
        ("COM_RC_OVERRIDE", 1, True, Level.OK, "sticks do not"),
        ("GF_ACTION", 0, True, Level.WARN, "geofence is off"),
        ("GF_MAX_HOR_DIST", 20.0, True, Level.WARN, "20 m around home, but"),
        ("GF_MAX_HOR_DIST", 300.0, True, Level.OK, "300 m around home"),
        ("GF_MAX_VER_DIST", 10.0, True, Level.WARN, "limits.altitude_max_m is 60"),
        ("GF_MAX_VER_DIST", 60.0, True, Level.OK, "60 m above home"),
        ("MPC_XY_VEL_MAX", 3.0, True, Level.WARN, "slower than limits.speed_mps (5)"),
        ("MPC_XY_VEL_MAX", None, True, Level.WARN, "does not report"),
    ],
)
def test_px4(name: str, value: float | None, has_rc: bool | None, level: Level, text: str) -> None:
    facts = replace(with_value(PX4, name, value), has_rc=has_rc)
    (finding,) = findings_about(name, facts)
    assert finding.level is level
    assert text in finding.text
    assert bool(finding.fix) is (level is not Level.OK)


@pytest.mark.parametrize(
    ("name", "value", "level", "text"),
    [
        ("GUID_TIMEOUT", 3.0, Level.OK, "for velocities only"),
        ("GUID_TIMEOUT", 0.1, Level.WARN, "a few lost packets"),
        ("FENCE_RADIUS", 30.0, Level.WARN, "30 m around home, but the companion may fly"),
        ("FENCE_ALT_MAX", 10.0, Level.WARN, "10 m above home, but limits.altitude_max_m is 60"),
        ("SYSID_MYGCS", 1, Level.FAIL, "would count as the ground station"),
        ("FS_GCS_ENABLE", 0, Level.WARN, "no reaction to a lost ground station"),
        ("FS_THR_ENABLE", 0, Level.WARN, "no reaction to a lost transmitter"),
        ("FENCE_ENABLE", 0, Level.WARN, "own fence is off"),
        ("FENCE_ACTION", 0, Level.WARN, "only reports"),
        ("WPNAV_SPEED", 300.0, Level.WARN, "3 m/s: slower"),
        ("FS_GCS_TIMEOUT", None, Level.WARN, "does not report"),
    ],
)
def test_ardupilot(name: str, value: float | None, level: Level, text: str) -> None:
    (finding,) = findings_about(name, with_value(ARDUPILOT, name, value))
    assert finding.level is level
    assert text in finding.text
    assert bool(finding.fix) is (level is not Level.OK)


@pytest.mark.parametrize(
    ("name", "value", "level", "text"),
    [
        ("MAV_GCS_SYSID", 1, Level.FAIL, "would count as the ground station"),
        ("FS_GCS_ENABLE", 0, Level.WARN, "no reaction to a lost ground station"),
        ("WP_SPD", 3.0, Level.WARN, "3 m/s: slower"),
        ("WP_SPD", 10.0, Level.OK, "10 m/s"),
    ],
)
def test_ardupilot_from_4_7_on_has_other_names(
    name: str, value: float, level: Level, text: str
) -> None:
    renamed = {RENAMED.get(old, old): value for old, value in ARDUPILOT_PARAMETERS.items()}
    renamed |= {"SYSID_MYGCS": None, "WPNAV_SPEED": None, "WP_SPD": 10.0}
    facts = replace(ARDUPILOT, parameters=renamed)
    assert {f.level for f in check_parameters(facts, CompanionConfig())} == {Level.OK}
    (finding,) = findings_about(name, with_value(facts, name, value))
    assert finding.level is level
    assert text in finding.text
    assert not set(finding.fix.split()) & set(RENAMED)


@pytest.mark.parametrize(("value", "text"), [(1.0, "1 1/s: sticks that move"), (-1.0, "do not")])
def test_px4_from_1_18_on_has_a_speed_of_the_sticks(value: float, text: str) -> None:
    others = {"COM_RC_OVERRIDE": None, "MAN_OVERRIDE_SPD": value}
    facts = replace(PX4, parameters=PX4_PARAMETERS | others)
    assert {f.level for f in check_parameters(facts, CompanionConfig())} == {Level.OK}
    (finding,) = findings_about("MAN_OVERRIDE_SPD", facts)
    assert text in finding.text


@pytest.mark.parametrize("name", RENAMED)
def test_a_parameter_reported_under_neither_name_is_missed_once(name: str) -> None:
    facts = with_value(PX4 if name in PX4_PARAMETERS else ARDUPILOT, name, None)
    assert len(list(f for f in check_parameters(facts, CompanionConfig()) if f.fix)) == 1


@pytest.mark.parametrize("off", [("FENCE_ENABLE", 0), ("FENCE_ACTION", 0), ("FENCE_TYPE", 4)])
def test_a_small_circle_that_does_not_act_is_no_finding(off: tuple[str, float]) -> None:
    facts = with_value(with_value(ARDUPILOT, "FENCE_RADIUS", 30.0), *off)
    assert findings_about("FENCE_RADIUS", facts) == []


@pytest.mark.parametrize("action", [0, 1])
def test_a_low_ceiling_that_only_warns_is_no_finding(action: int) -> None:
    facts = with_value(with_value(PX4, "GF_MAX_VER_DIST", 10.0), "GF_ACTION", action)
    assert findings_about("GF_MAX_VER_DIST", facts) == []


def test_a_small_circle_is_fine_for_a_companion_that_stays_near() -> None:
    config = CompanionConfig(limits=LimitsConfig(distance_home_m=25.0))
    facts = with_value(ARDUPILOT, "FENCE_RADIUS", 30.0)
    assert all(finding.level is Level.OK for finding in check_parameters(facts, config))


def test_a_parameter_that_several_rules_need_is_missed_once() -> None:
    assert len(findings_about("GF_ACTION", with_value(PX4, "GF_ACTION", None))) == 1


def test_without_a_transmitter_its_failsafe_does_not_matter() -> None:
    facts = replace(with_value(ARDUPILOT, "FS_THR_ENABLE", 0), has_rc=False)
    assert findings_about("FS_THR_ENABLE", facts) == []


def test_a_slow_mission_is_fine_on_a_slow_vehicle() -> None:
    config = CompanionConfig(limits=LimitsConfig(speed_mps=2.0))
    facts = with_value(PX4, "MPC_XY_VEL_MAX", 3.0)
    assert all(finding.level is Level.OK for finding in check_parameters(facts, config))


def test_an_unknown_autopilot_is_asked_for_nothing() -> None:
    assert needed_parameters(Autopilot.OTHER) == ()
    facts = replace(PX4, autopilot=Autopilot.OTHER, parameters=PX4_PARAMETERS)
    assert list(check_parameters(facts, CompanionConfig())) == []
