"""`companion radio calibrate`, as it is typed."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from companion.cli import main
from companion.config.schema import load_config
from companion.geometry.coordinates import LocalOrigin
from companion.link.interface import RadioSettings
from companion.radio_tools.calibration import CalibrationRun
from tests.unit.companion.radio_tools.simulated_radio import (
    POINT,
    Course,
    Truth,
    all_tests,
    at,
    record,
    simulated,
)

TRUTH = Truth(
    offset_m=27.3, lag_s=0.31, sign=-1, mount_rad=math.radians(12.0), nlos_share=0.1, between_m=0.05
)
POINT_ENU = ",".join(f"{value}" for value in POINT)


def whole_run(truth: Truth = TRUTH) -> CalibrationRun:
    course, blocked = all_tests()
    return simulated(truth, np.random.default_rng(4), course, blocked)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "field.radio"
    record(whole_run(), path)
    return path


def typed(*words: str | Path) -> int:
    return main(["radio", "calibrate", *map(str, words)])


def pasted(output: str) -> tuple[dict[str, object], dict[str, object]]:
    """The two blocks of YAML, without the verdict above them."""
    stage, estimator = output.split("# input stage\n")[1].split("# estimator\n")
    return yaml.safe_load(stage), yaml.safe_load(estimator)


def test_a_recording_becomes_a_verdict_and_a_configuration_that_loads(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed(recording, "--point-enu", POINT_ENU, "--json", tmp_path / "out.json") == 0
    output = capsys.readouterr().out
    assert "radio ndjson, emitter 7:" in output
    assert "tests found: turn" in output
    assert "usable: yes" in output
    stage, estimator = pasted(output)
    config = {
        "radios": [{"name": "ndjson", "url": "stdin:", "settings": stage}],
        "estimation": {"filter": estimator},
    }
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(config))
    loaded = load_config(tmp_path / "own.yaml")
    settings = loaded.radios[0].settings
    assert set(settings) <= set(RadioSettings.__struct_fields__)
    assert settings["range_offset_m"] == pytest.approx(27.3, abs=0.1)
    assert settings["lag_s"] == pytest.approx(0.31, abs=0.02)
    assert settings["bearing_sign"] == -1
    assert settings["bearing_mount_deg"] == pytest.approx(12.0, abs=1.5)
    assert loaded.estimation.filter.range_sigma_m == pytest.approx(0.11, rel=0.35)
    assert loaded.estimation.filter.use_reported_sigma is False
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["range"]["offset_m"]["low"] < 27.3 < written["range"]["offset_m"]["high"]
    assert written["usable_ranges"] is True


def test_two_antennas_become_an_antenna_of_the_estimator(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(whole_run(replace(TRUTH, is_folded=True)), tmp_path / "field.radio")
    assert typed(tmp_path / "field.radio", "--point-enu", POINT_ENU) == 0
    stage, estimator = pasted(capsys.readouterr().out)
    assert "bearing_mount_deg" not in stage
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"estimation": {"filter": estimator}}))
    antenna = load_config(tmp_path / "own.yaml").estimation.filter.antenna
    assert antenna.kind == "line"
    assert antenna.mount_deg[2] == pytest.approx(12.0, abs=1.5)


def test_the_point_may_be_reported_in_degrees(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    position = LocalOrigin(47.0, 8.0, 400.0).geodetic_from_enu(POINT)
    assert typed(recording, "--point", ",".join(f"{value:.9f}" for value in position)) == 0
    stage, _ = pasted(capsys.readouterr().out)
    assert stage["range_offset_m"] == pytest.approx(27.3, abs=0.1)


def test_what_is_in_the_recording_may_be_reported(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed(recording, "--point-enu", POINT_ENU, "--test", "turn@0-90") == 0
    output = capsys.readouterr().out
    assert "bearing_sign: -1" in output
    assert "range_offset_m" not in output


def test_a_refusal_is_exit_code_1_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    course = Course([at(10.0)], [0.3])
    course.stay(20.0)
    record(simulated(TRUTH, np.random.default_rng(1), course), tmp_path / "stay.radio")
    assert typed(tmp_path / "stay.radio", "--point-enu", POINT_ENU) == 1
    output = capsys.readouterr().out
    assert "refused: only 1 distances (10.0 m)" in output
    assert "usable: no" in output
    assert "# input stage" not in output


def test_a_turn_of_a_radio_without_bearings_is_refused_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    course = Course([at(10.0)], [0.3])
    course.stay(20.0)
    run = simulated(TRUTH, np.random.default_rng(1), course)
    ranges = [replace(m, bearing_body_rad=None, bearing_sigma_rad=None) for m in run.measurements]
    record(replace(run, measurements=ranges), tmp_path / "ranges.radio")
    words = ("--point-enu", POINT_ENU, "--test", "turn@0-20")
    assert typed(tmp_path / "ranges.radio", *words) == 1
    assert "refused: turn needs bearings, which this radio does not measure" in (
        capsys.readouterr().out
    )


def walk(path: Path, columns: tuple[str, ...]) -> Path:
    rng = np.random.default_rng(2)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        way = [*np.linspace(4.0, 60.0, 400), *np.linspace(60.0, 4.0, 400)]
        for step, distance in enumerate(way):
            row = {"t_s": 0.2 * step, "agent_x_m": distance, "agent_y_m": 5.0, "target_id": "tag"}
            row |= {"target_x_m": 0.0, "target_y_m": 5.0}
            row |= {"range_m": distance + 2.0 + 0.1 * rng.standard_normal()}
            row |= {"bearing_rad": math.remainder(math.pi + 0.1 * rng.standard_normal(), 6.2831853)}
            writer.writerow(row)
    return path


WALK = ("t_s", "agent_x_m", "agent_y_m", "target_id", "range_m", "target_x_m", "target_y_m")


def test_an_old_walk_is_enough_for_ranges(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed("--from-csv", walk(tmp_path / "walk.csv", WALK), "--emitter", "tag") == 0
    stage, estimator = pasted(capsys.readouterr().out)
    assert stage["range_offset_m"] == pytest.approx(2.0, abs=0.1)
    assert estimator["range_sigma_m"] == pytest.approx(0.1, rel=0.4)


def test_bearings_of_a_walk_are_counter_clockwise_from_east(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed("--from-csv", walk(tmp_path / "walk.csv", (*WALK, "bearing_rad"))) == 0
    output = capsys.readouterr().out
    assert "offset from north" in output
    stage, estimator = pasted(output)
    assert "bearing_sign" not in stage
    assert estimator["bearing_sigma_deg"] == pytest.approx(5.7, rel=0.25)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "give a FILE"),
        (["FILE"], "specify the emitter's position"),
        (["FILE", "--point-enu", "1,2"], "give E,N,U as numbers"),
        (["FILE", "--point", "95,8"], "no such latitude"),
        (["FILE", "--point-enu", "nan,0,0"], "give E,N,U as numbers"),
        (["FILE", "--point-enu", "0,0,0", "--emitter", "9"], "--emitter 9:"),
        (["FILE", "--point-enu", "0,0,0", "--test", "dance"], "--test dance: give turn, line"),
        (["FILE", "--point-enu", "0,0,0", "--test", "turn@9-2"], "ends before it begins"),
        (["absent.radio", "--point-enu", "0,0,0"], "cannot be read"),
        (["FILE", "--point-enu", "0,0,0", "--radio", "ndjson@udp:14777"], "needs --connect"),
        (["FILE", "--from-csv", "walk.csv"], "omit FILE and --radio"),
        (["--from-csv", "absent.csv"], "cannot be read"),
    ],
)
def test_bad_input_is_exit_code_2_and_one_line(
    recording: Path, words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(recording) if word == "FILE" else word for word in words]
    assert typed(*given) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1


def test_a_walk_without_the_truth_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = walk(tmp_path / "walk.csv", WALK[:5])
    assert typed("--from-csv", path) == 2
    assert "target_x_m and target_y_m" in capsys.readouterr().err


def test_a_recording_without_poses_or_with_two_emitters_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = whole_run()
    record(replace(run, poses=[]), tmp_path / "blind.radio")
    assert typed(tmp_path / "blind.radio", "--point-enu", POINT_ENU) == 2
    assert "has no poses" in capsys.readouterr().err
    two = [replace(m, emitter_id=7 + (i % 2)) for i, m in enumerate(run.measurements)]
    record(replace(run, measurements=two), tmp_path / "two.radio")
    assert typed(tmp_path / "two.radio", "--point-enu", POINT_ENU) == 2
    assert "several emitters; give --emitter ID" in capsys.readouterr().err
    assert typed(tmp_path / "two.radio", "--point-enu", POINT_ENU, "--emitter", "8") == 0
