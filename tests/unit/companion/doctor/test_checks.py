"""Results of the doctor's checks for given facts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.config.schema import CompanionConfig, LogConfig
from companion.doctor.examination import examine, exit_code
from companion.doctor.findings import CheckResult, Facts, FolderFacts, Level, StreamRate
from companion.domain import Autopilot
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.readiness import FENCE_MESSAGE, REQUIREMENTS
from companion.link.autopilot_fence import NO_ANSWER
from companion.link.interface import VehicleParams
from tests.unit.companion.doctor.examples import FIT, HOST, LINK, PX4

CONFIG = CompanionConfig()


def finding_about(subject: str, facts: Facts, config: CompanionConfig = CONFIG) -> CheckResult:
    (found,) = [finding for finding in examine(facts, config) if finding.subject == subject]
    return found


def host_with(**changes: Any) -> Facts:
    return replace(FIT, host=replace(HOST, **changes))


def link_with(**changes: Any) -> Facts:
    return replace(FIT, link=replace(LINK, **changes))


def autopilot_with(**changes: Any) -> Facts:
    return link_with(autopilot=replace(PX4, **changes))


def test_a_vehicle_that_is_fit_has_nothing_to_mend() -> None:
    findings = examine(FIT, CONFIG)
    assert {finding.level for finding in findings} == {Level.OK}
    assert exit_code(findings) == 0


FOLDER = FolderFacts("flights", None, 20_000.0, 0.02)
HOST_CASES = [
    ("log.directory", host_with(logs=FolderFacts("flights", "Read-only file system")), Level.FAIL),
    ("log.directory", host_with(logs=replace(FOLDER, free_mb=20.0)), Level.FAIL),
    ("log.directory", host_with(logs=replace(FOLDER, free_mb=500.0)), Level.WARN),
    ("log.directory", host_with(logs=replace(FOLDER, synced_write_s=3.0)), Level.WARN),
    ("process.state_directory", host_with(state=FolderFacts("s", "Permission denied")), Level.WARN),
    ("signing key", host_with(has_key=False), Level.WARN),
    ("signing key", host_with(key_problem="k: open to others (mode 0644)"), Level.FAIL),
    ("clock", host_with(unix_s=3600.0, has_key=False), Level.WARN),
    ("clock", host_with(unix_s=3600.0), Level.FAIL),
    ("kernels", host_with(can_compile_kernels=True), Level.WARN),
    ("clock", host_with(is_clock_synchronised=False), Level.WARN),
    ("clock", host_with(is_clock_synchronised=None), Level.OK),
    ("priority", host_with(priority=None), Level.WARN),
    ("priority", host_with(priority="nice -10"), Level.OK),
]


@pytest.mark.parametrize(("subject", "facts", "level"), HOST_CASES)
def test_what_is_wrong_with_the_computer_is_named(subject: str, facts: Facts, level: Level) -> None:
    finding = finding_about(subject, facts)
    assert finding.level is level
    assert bool(finding.fix) is (level is not Level.OK)


def test_less_room_than_a_flight_may_take_is_fine_if_it_may_take_less() -> None:
    facts = host_with(logs=replace(FOLDER, free_mb=500.0))
    config = CompanionConfig(log=LogConfig(max_mb=100.0))
    assert finding_about("log.directory", facts, config).level is Level.OK


def without(message: str) -> Facts:
    """An ArduPilot that does not send one message, although everything is needed."""
    heard = PX4.heard - {message}
    return autopilot_with(autopilot=Autopilot.ARDUPILOT, heard=heard)


UNANSWERED = autopilot_with(
    round_trip_s=None,
    parameters=dict.fromkeys(PX4.parameters),
    fence=AutopilotFenceRead(0.0, problem=NO_ANSWER),
)
"""ArduCopter that wants signatures, asked without a key: its streams came all the same."""

LINK_CASES = [
    ("link", UNANSWERED, Level.FAIL, "answers no request"),
    ("companion", link_with(other_companions=(1,)), Level.WARN, "another component 191"),
    ("vehicle.system_id", link_with(other_autopilots=(2, 3)), Level.FAIL, "system 2, 3"),
    ("link", autopilot_with(loss=0.1), Level.WARN, "10.0 % lost"),
    ("link", autopilot_with(loss=0.5), Level.FAIL, "50.0 % lost"),
    ("link", link_with(bad_frames=3), Level.WARN, "3 bad frames"),
    ("autopilot", autopilot_with(autopilot=Autopilot.OTHER), Level.FAIL, "unknown autopilot"),
    ("time", autopilot_with(round_trip_s=None), Level.WARN, "TIMESYNC"),
    ("time", autopilot_with(clock_offset_s=None), Level.WARN, "TIMESYNC"),
    ("time", autopilot_with(round_trip_s=0.2), Level.WARN, "200.0 ms"),
    ("time", autopilot_with(round_trip_s=0.9), Level.FAIL, "900.0 ms"),
    *(
        ("position", without(row.message), Level.WARN, f"missing: {row.text}")
        for row in REQUIREMENTS
        if row.message != FENCE_MESSAGE and row.text != "the flight mode"
    ),
    ("GPS", autopilot_with(gps_fix=1), Level.WARN, "no 3D fix"),
    ("battery", autopilot_with(battery_pct=12), Level.WARN, "12 %"),
    ("RC", autopilot_with(has_rc=None), Level.OK, "does not report"),
]


@pytest.mark.parametrize(("subject", "facts", "level", "text"), LINK_CASES)
def test_what_is_wrong_with_the_link_is_named(
    subject: str, facts: Facts, level: Level, text: str
) -> None:
    finding = finding_about(subject, facts)
    assert finding.level is level
    assert text in finding.text
    assert bool(finding.fix) is (level is not Level.OK)


NO_POSITION = tuple(replace(rate, count=0) for rate in PX4.rates)


@pytest.mark.parametrize(
    ("flags", "lacks"),
    [
        (0, "no attitude, no horizontal velocity, no horizontal position, no height"),
        (1 | 2 | 4 | 32 | 128, "no horizontal position"),
        (None, "no position"),
    ],
)
def test_an_estimator_that_is_not_ready_is_named_before_the_streams_that_need_it(
    flags: int | None, lacks: str
) -> None:
    facts = autopilot_with(estimator_flags=flags, heard=frozenset(), origin=None, rates=NO_POSITION)
    findings = examine(facts, CONFIG)
    subjects = [finding.subject for finding in findings]
    assert finding_about("estimator", facts).level is Level.FAIL
    assert finding_about("estimator", facts).text == f"not ready: {lacks}"
    assert subjects.index("estimator") < subjects.index("LOCAL_POSITION_NED")
    needs_it = finding_about("LOCAL_POSITION_NED", facts)
    assert needs_it.text == "none: it needs the estimator"
    assert exit_code(findings) == 1


def test_a_stream_that_is_missing_though_the_estimator_is_ready_is_the_links_fault() -> None:
    found = finding_about("LOCAL_POSITION_NED", autopilot_with(rates=NO_POSITION))
    assert "raise the link's rate" in found.fix


def test_several_vehicles_are_fine_where_one_is_chosen() -> None:
    config = CompanionConfig(vehicle=VehicleParams(system_id=1))
    findings = examine(link_with(other_autopilots=(2,)), config)
    assert exit_code(findings) == 0


def test_a_companion_of_another_vehicle_is_none_of_ours() -> None:
    assert exit_code(examine(link_with(other_companions=(7,)), CONFIG)) == 0


@pytest.mark.parametrize(
    ("rate", "level"),
    [
        (StreamRate("LOCAL_POSITION_NED", 20.0, 100, 5.0), Level.OK),
        (StreamRate("LOCAL_POSITION_NED", 20.0, 79, 5.0), Level.OK),
        (StreamRate("LOCAL_POSITION_NED", 20.0, 50, 5.0), Level.WARN),
        (StreamRate("LOCAL_POSITION_NED", 20.0, 15, 5.0), Level.FAIL),
        (StreamRate("LOCAL_POSITION_NED", 20.0, 0, 5.0), Level.FAIL),
        (StreamRate("ATTITUDE", 10.0, 0, 5.0), Level.FAIL),
        (StreamRate("BATTERY_STATUS", 0.5, 1, 5.0), Level.OK),
        (StreamRate("BATTERY_STATUS", 0.5, 0, 5.0), Level.WARN),
        (StreamRate("HEARTBEAT", 1.0, 4, 5.0), Level.OK),
    ],
)
def test_a_stream_is_judged_by_what_is_flown_on_and_what_was_asked_for(
    rate: StreamRate, level: Level
) -> None:
    assert finding_about(rate.name, autopilot_with(rates=(rate,))).level is level


@pytest.mark.parametrize(
    ("changes", "text", "fix"),
    [
        ({"bytes_received": 0}, "no autopilot heard in 8 s", "and the port"),
        ({}, "50000 bytes that are not MAVLink", "check the protocol"),
        ({"unproved_frames": 40}, "40 frames not signed with our key", "the same signing key"),
        ({"other_autopilots": (7,)}, "systems 7 are autopilots", "set it to yours"),
        (
            {"non_autopilots": ("1/154 (gimbal)",)},
            "but 1/154 (gimbal)",
            "none of these is an autopilot",
        ),
    ],
)
def test_an_autopilot_that_is_not_there_keeps_from_flying(
    changes: dict[str, Any], text: str, fix: str
) -> None:
    findings = examine(link_with(autopilot=None, **changes), CONFIG)
    assert exit_code(findings) == 1
    assert text in findings[-1].text
    assert fix in findings[-1].fix


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("EKF_STATUS_REPORT", {}),
        ("ESTIMATOR_STATUS", {"autopilot": Autopilot.ARDUPILOT}),
        ("POSITION_TARGET_LOCAL_NED", {}),
        (
            "POSITION_TARGET_LOCAL_NED",
            {"autopilot": Autopilot.ARDUPILOT, "is_armed": True, "mode": "BRAKE"},
        ),
        ("RC_CHANNELS", {"has_rc": False}),
    ],
)
def test_a_stream_that_this_autopilot_does_not_send_now_is_not_missed(
    name: str, changes: dict[str, Any]
) -> None:
    silent = StreamRate(name, 5.0, 0, 5.0)
    findings = examine(autopilot_with(rates=(*PX4.rates, silent), **changes), CONFIG)
    assert name not in {finding.subject for finding in findings}
    slow = StreamRate(name, 5.0, 2, 5.0)
    assert finding_about(name, autopilot_with(rates=(slow,), **changes)).level is Level.WARN


def test_memory_and_processor_time_are_reported() -> None:
    facts = link_with(resident_mb=66.2, processor_pct=3.14)
    assert finding_about("process", facts).text == "66 MB, 3.1 % of one core for these streams"


def test_kernels_compiled_ahead_need_no_warm_up() -> None:
    facts = host_with(can_compile_kernels=True, are_kernels_compiled=True)
    assert finding_about("python", facts).text.endswith("kernels compiled ahead")
