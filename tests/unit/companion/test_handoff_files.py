"""The files that ground teams are handed: one position per emitter, the newest."""

import json
from xml.etree import ElementTree as ET

from companion.domain import EstimateState, TargetEstimate
from companion.guidance.commands import ReportResult
from companion.handoff import GEOJSON, KML, TEXT, HandoffFiles
from tests.unit.companion.handoff.handoff_helpers import ORIGIN, POSITION_ENU_M


def report(emitter_id: int | None, r95_m: float = 0.8, *, has_origin: bool = True) -> ReportResult:
    estimate = TargetEstimate(
        60.0, EstimateState.LOCALISED, POSITION_ENU_M, ((0.1, 0.0), (0.0, 0.1)), r95_m, 0.0, 0.0, 90
    )
    return ReportResult(estimate, 47.4, 8.54, emitter_id, ORIGIN if has_origin else None)


def test_every_emitter_has_its_place_and_the_newest_counts() -> None:
    files = HandoffFiles()
    files.files(report(1, 2.0), 1.8e9)
    files.files(report(2), 1.8e9)
    contents = files.files(report(1, 0.5), 1.8e9 + 60)
    lines = contents[TEXT].splitlines()
    assert [line.split(":")[0] for line in lines] == ["emitter 1", "emitter 2"]
    words = "R95 7.4 m absolute, 0.5 m relative (GNSS 3.00 m, assumed)"
    assert f"{words}, localised, 2027-01-15T08:01:00Z" in lines[0]
    assert len(json.loads(contents[GEOJSON])["features"]) == 4
    assert ET.fromstring(contents[KML]).tag.endswith("kml")


def test_an_emitter_without_an_id_is_unknown() -> None:
    assert HandoffFiles().files(report(None), 0.0)[TEXT].startswith("emitter unknown: 32T ")


def test_without_an_origin_there_is_nothing_to_hand_over() -> None:
    assert HandoffFiles().files(report(1, has_origin=False), 0.0) == {}


def test_the_grid_is_no_finer_than_others_find_it() -> None:
    """A metre for the vehicle, ten for a team with another receiver."""
    (line,) = HandoffFiles().files(report(1, 8.0), 0.0)[TEXT].splitlines()
    grid = line.split("  ")[0].split(": ")[1]
    assert [len(part) for part in grid.split()[2:]] == [4, 4]
