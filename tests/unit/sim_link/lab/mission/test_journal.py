"""The companion's events, read into record and situation."""

from __future__ import annotations

import pytest

from companion.domain import EstimateState, TargetEstimate
from companion.guidance.commands import ReportResult, Severity
from sim_link.lab.mission.flight_readers import EventReader
from sim_link.lab.mission.results import FlightRecord

ESTIMATE = {
    "state": "ambiguous",
    "position_enu_m": (48.0, 50.0),
    "r95_m": 3.0,
    "range_offset_m": 1.4,
    "bearing_offset_rad": 0.1,
    "range_innovation": 2.5,
}


class Read:
    """A reader with what it fills."""

    def __init__(self) -> None:
        self.record = FlightRecord()
        self.situation = self.record.situation
        emitters = {4: (50.0, 50.0), 5: (0.0, 0.0)}
        self.reader = EventReader(self.record, emitters, 4)


@pytest.fixture
def read() -> Read:
    return Read()


def test_an_estimate_is_compared_with_the_truth(read: Read) -> None:
    read.reader.record("estimate", ESTIMATE, 12.0)
    seen = read.situation.estimate
    assert (seen.emitter, seen.state, seen.r95_m, seen.error_m) == (4, "ambiguous", 3.0, 2.0)
    assert read.situation.companion.measurements == 1
    assert read.record.estimates[0].range_innovation_m == 2.5
    read.reader.record("estimate", ESTIMATE | {"emitter_id": 5}, 13.0)
    assert seen.error_m == pytest.approx(69.3, abs=0.1)
    read.reader.record("estimate", ESTIMATE | {"emitter_id": 99}, 13.0)
    assert seen.error_m is None


def test_ranging_grows_old(read: Read) -> None:
    read.reader.age(3.0)
    assert read.situation.companion.ranging_age_s is None
    read.reader.record("estimate", ESTIMATE, 12.0)
    read.reader.age(14.5)
    assert read.situation.companion.ranging_age_s == 2.5


def test_phases_say_who_is_in_control(read: Read) -> None:
    companion = read.situation.companion
    read.reader.record("bound", {"autopilot": "PX4", "system_id": 1}, 0.5)
    assert (companion.phase, companion.is_in_control) == ("waiting", False)
    read.reader.record("phase", {"old": "standby", "new": "normal", "trigger": "x"}, 9.0)
    assert companion.is_in_control
    read.reader.record("phase", {"old": "normal", "new": "yield", "trigger": "x"}, 20.0)
    assert not companion.is_in_control
    read.reader.record("phase", {"old": "standby", "new": "hold", "trigger": "x"}, 30.0)
    assert read.record.engaged_s == 9.0
    read.reader.restarted()
    assert companion.phase is None


def test_texts_waypoints_and_refusals_are_kept(read: Read) -> None:
    read.reader.text(Severity.NOTICE, "in control", 9.0)
    read.reader.record("refused", {"reason": "too long", "count": 3}, 9.1)
    fields = {"position_enu_m": (1, 2), "reason": "crossing", "detail": ""}
    read.reader.record("waypoint", fields, 9.2)
    read.reader.frame(b"", 9.3)
    assert read.situation.companion_texts == ["in control"]
    assert read.record.texts[0].source == "companion"
    assert read.situation.companion.refused == 3
    assert read.record.waypoints == [(9.2, (1.0, 2.0), "crossing")]
    assert [kind for _, kind, _ in read.record.events] == ["text", "refused", "waypoint"]


def test_a_report_is_about_the_emitter_that_is_looked_for(read: Read) -> None:
    read.reader.record("estimate", ESTIMATE, 12.0)
    estimate = TargetEstimate(
        12.0, EstimateState.LOCALISED, (48.0, 50.0), ((1.0, 0.0), (0.0, 1.0)), 0.9, 1.0, 0.0, 50
    )
    read.reader.result(ReportResult(estimate, None, None), 12.5)
    report = read.record.report_of(4)
    assert report is not None
    assert (report.time_s, report.emitter, report.r95_m) == (12.5, 4, 0.9)
    assert read.situation.companion.reported == 1
    assert read.record.report_of(5) is None
