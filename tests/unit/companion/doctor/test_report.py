"""The findings as people and programs read them."""

from __future__ import annotations

import json

from companion.doctor.findings import as_json, as_lines, fail, ok, warn

FINDINGS = [
    ok("autopilot", "PX4, system 1"),
    warn("GF_ACTION", "0: does nothing", "set GF_ACTION to 2"),
    fail("link", "50.0 % lost", "check the radio"),
]


def test_each_finding_has_a_line_and_what_mends_it_another() -> None:
    assert as_lines(FINDINGS) == [
        "OK    autopilot                PX4, system 1",
        "WARN  GF_ACTION                0: does nothing",
        "                               -> set GF_ACTION to 2",
        "FAIL  link                     50.0 % lost",
        "                               -> check the radio",
        "do not fly: 1 ok, 1 warnings, 1 failures",
    ]
    assert as_lines(FINDINGS[:2])[-1] == "fit to fly: 1 ok, 1 warnings, 0 failures"


def test_programs_get_the_same() -> None:
    value = json.loads(json.dumps(as_json(FINDINGS)))
    assert value["is_fit"] is False
    assert value["findings"][1] == {
        "level": "WARN",
        "subject": "GF_ACTION",
        "text": "0: does nothing",
        "fix": "set GF_ACTION to 2",
    }
    assert as_json(FINDINGS[:2])["is_fit"] is True
