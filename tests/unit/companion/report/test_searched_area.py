from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from companion.area_handoff import area_files
from companion.cli import main
from companion.config.loader import parse_yaml
from companion.config.schema import CompanionConfig
from companion.flight_setup import FlightFacts, write_facts
from companion.geometry.coordinates import LocalOrigin
from companion.io.files import EVENTS
from companion.report.page import write_report
from companion.search.detection_model import DetectionModel
from companion.search.search_grid import WeightedArea, grid_over
from companion.search.searched_area import LearntReach, SearchState
from companion.search.searched_flight import SearchedFlight, StoredGrid

SQUARE = ((0.0, 0.0), (200.0, 0.0), (200.0, 200.0), (0.0, 200.0))
GRID = grid_over([WeightedArea(SQUARE)], 20.0)
SENTENCE = (
    "Nothing heard. 50 % of the planned area searched at 80 % or more; POS 45 %; gaps: N side."
)


def flight_in(
    folder: Path, *, detection: DetectionModel | None = None, learnt: LearntReach | None = None
) -> Path:
    """A flight's folder with what it searched."""
    folder.mkdir()
    facts = FlightFacts(started_unix_s=1.8e9, links=1, config=CompanionConfig())
    write_facts(folder, facts)
    (folder / EVENTS).write_text(json.dumps({"t_s": 9.0, "kind": "link", "refused": {}}) + "\n")
    flight = SearchedFlight(
        began_unix_s=1.8e9,
        ended_unix_s=1.8e9 + 60.0,
        listened_s=60.0,
        is_radio_heard=True,
        origin=LocalOrigin(47.0, 8.0, 400.0),
        detection=detection,
        learnt=learnt,
        grid=None if detection is None else StoredGrid.of(GRID),
        looks=[(20.0 * k, 50.0, 20.0, 5.0) for k in range(10)],
    )
    pod = np.where(GRID.centres_enu_m[:, 1] < 100.0, 0.9, 0.0)
    state = None if detection is None else SearchState(GRID, pod)
    for name, content in area_files(flight, state).items():
        (folder / name).write_bytes(content)
    return folder


def test_the_report_says_what_was_searched(tmp_path: Path) -> None:
    folder = flight_in(tmp_path / "flight", detection=DetectionModel(reach_m=40.0))
    page = write_report(folder).read_text()
    assert page.count(SENTENCE) == 3  # title, verdict, and above the map
    assert "data:image/png;base64," in page
    assert "never heard" not in page


def test_the_report_of_a_flight_without_a_reach_has_no_map(tmp_path: Path) -> None:
    page = write_report(flight_in(tmp_path / "flight")).read_text()
    assert "reach is unknown" in page
    assert "data:image/png;base64," not in page


def test_the_reach_that_a_contact_showed_is_printed_to_paste(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    learnt = LearntReach(41.0, 2.5)
    folder = flight_in(tmp_path / "it", detection=DetectionModel(reach_m=40.0), learnt=learnt)
    assert main(["area", "show", str(folder)]) == 0
    (line,) = [each for each in capsys.readouterr().out.splitlines() if "to paste: " in each]
    config = parse_yaml(line.partition("to paste: ")[2], CompanionConfig, "pasted")
    assert config.detection == DetectionModel(reach_m=41.0, reach_sigma_db=2.5)


def test_flights_are_shown_and_combined(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = flight_in(tmp_path / "flight", detection=DetectionModel(reach_m=40.0))
    assert main(["area", "show", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Nothing heard. ")
    assert all(line.startswith("gap: ") for line in lines[1:])
    assert main(["area", "show", str(folder / "searched_area.json"), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["state"] == "not_found"
    out = tmp_path / "out" / "both"
    assert main(["area", "merge", str(folder), str(folder), "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith("2 flights: Nothing heard. ")
    features = json.loads((out / "searched_area.geojson").read_text())["features"]
    assert {feature["properties"]["kind"] for feature in features} >= {"pod"}
    assert not (out / "searched_area.json").exists()


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (b"{}", "not a record of a searched area: $.began_unix_s: required key is missing"),
        (b"\xff", "not a record of a searched area"),
        (None, "has no searched_area.json"),
    ],
)
def test_what_is_missing_or_damaged_is_one_line(
    damage: bytes | None, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = flight_in(tmp_path / "flight", detection=DetectionModel(reach_m=40.0))
    path = folder / "searched_area.json"
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage)
    assert main(["area", "show", str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert problem in line


def test_a_flight_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["show"], ["merge", "--out", str(tmp_path / "out")]):
        assert main(["area", *command, str(tmp_path / "nowhere")]) == 2
        assert capsys.readouterr().err == (
            f"companion: {tmp_path / 'nowhere'}: there is no such file or folder\n"
        )


def test_a_grid_whose_rows_differ_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = flight_in(tmp_path / "flight", detection=DetectionModel(reach_m=40.0))
    path = folder / "searched_area.json"
    record = json.loads(path.read_text())
    record["grid"]["poa"] = [[0.5], [0.25, 0.25]]
    path.write_text(json.dumps(record))
    assert main(["area", "show", str(folder)]) == 2
    assert str(folder) in capsys.readouterr().err


def test_flights_without_a_reach_cannot_be_combined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = flight_in(tmp_path / "flight")
    assert main(["area", "merge", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "nothing can be combined" in capsys.readouterr().err


def test_a_record_survives_its_file(tmp_path: Path) -> None:
    folder = flight_in(tmp_path / "flight", detection=DetectionModel(reach_m=40.0))
    data = (folder / "searched_area.json").read_bytes()
    read = msgspec.json.decode(data, type=SearchedFlight)
    assert read.grid is not None
    np.testing.assert_allclose(read.grid.grid().poa, GRID.poa)
