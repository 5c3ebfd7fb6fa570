"""`companion replay`: recorded walks through the flying estimator."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from companion.cli import main
from companion.config.schema import load_config
from companion.errors import EXIT_BAD_INPUT, ConfigError
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.window_map import WindowParams
from companion.replay.walk_replay import TargetResult, read_walk, replay_walk

RADIOS = ["AP1", "AP2", "AP5", "AP6", "AP7", "AP8"]
ROOT = Path(__file__).parents[4]
MALL = ROOT / "tests/data/rtt_mall_w9_p1.csv"
WIFI = ROOT / "configs/companion/wifi_rtt.yaml"


def errors_m(results: list[TargetResult]) -> list[float]:
    return [result.error_m for result in results if result.error_m is not None]


@pytest.mark.slow
def test_recorded_wifi_walk_is_localised_within_its_claimed_radius_by_the_window() -> None:
    """All six radios that were recorded there."""
    params = load_config(WIFI).tracking
    results = replay_walk(MALL, params)
    assert [r.target_id for r in results] == RADIOS
    assert sum(r.rows for r in results) == 7872
    assert float(np.median(errors_m(results))) <= 0.8
    assert max(errors_m(results)) <= 1.1
    covered = [
        r.error_m is not None and r.estimate is not None and r.error_m <= r.estimate.r95_m
        for r in results
    ]
    assert all(covered)
    without = TrackerParams(filter=params.filter, window=WindowParams(enabled=False))
    alone = errors_m(replay_walk(MALL, without))
    assert float(np.median(errors_m(results))) < 0.7 * float(np.median(alone))


def write_walk(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def circle(count: int = 120) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for index in range(count):
        phi = 2.0 * math.pi * index / count
        east, north = 10.0 * math.cos(phi), 10.0 * math.sin(phi)
        rows.append(
            {
                "t_s": 0.5 * index,
                "agent_x_m": east,
                "agent_y_m": north,
                "target_id": "tag",
                "range_m": math.dist((east, north), (4.0, 3.0)) + 0.5,
                "bearing_rad": math.atan2(3.0 - north, 4.0 - east),
            }
        )
    return rows


def test_in_a_walk_with_heights_the_height_of_the_target_is_estimated(tmp_path: Path) -> None:
    rows, target = circle(), (4.0, 3.0, 2.5)
    for index, row in enumerate(rows):
        position = (float(str(row["agent_x_m"])), float(str(row["agent_y_m"])), 0.05 * index)
        row |= {"agent_z_m": position[2], "range_m": math.dist(position, target)}
        row |= {"target_x_m": target[0], "target_y_m": target[1]}
    (found,) = replay_walk(write_walk(tmp_path / "walk.csv", rows), TrackerParams())
    assert found.estimate is not None
    assert found.estimate.height_sigma_m is not None
    assert found.estimate.height_m == pytest.approx(target[2], abs=0.5)
    (flat,) = replay_walk(write_walk(tmp_path / "flat.csv", circle()), TrackerParams())
    assert flat.estimate is not None
    assert flat.estimate.height_sigma_m is None
    stated = TrackerParams(filter=FilterParams(target_height_m=2.4, target_height_sigma_m=0.01))
    (known,) = replay_walk(tmp_path / "walk.csv", stated)
    assert known.estimate is not None
    assert known.estimate.height_m == pytest.approx(2.4, abs=0.02)


def test_truth_columns_are_optional(tmp_path: Path) -> None:
    (result,) = replay_walk(write_walk(tmp_path / "walk.csv", circle()), TrackerParams())
    assert result.error_m is None
    assert result.estimate is not None
    assert result.estimate.position_enu_m == pytest.approx((4.0, 3.0), abs=0.2)


@pytest.mark.slow
def test_bearings_alone_and_ranges_alone_are_legal(tmp_path: Path) -> None:
    for column in ("range_m", "bearing_rad"):
        rows = [{k: v for k, v in row.items() if k != column} for row in circle()]
        (result,) = replay_walk(write_walk(tmp_path / f"{column}.csv", rows), TrackerParams())
        assert result.estimate is not None
        assert result.estimate.position_enu_m == pytest.approx((4.0, 3.0), abs=1.0)


def test_absurd_cells_are_refused_and_counted(tmp_path: Path) -> None:
    rows = circle()
    for index, value in ((5, "nan"), (6, -3.0), (7, 1e9), (8, "inf")):
        rows[index] |= {"range_m": value, "bearing_rad": ""}
    rows[9] |= {"range_m": "", "bearing_rad": ""}
    (result,) = replay_walk(write_walk(tmp_path / "walk.csv", rows), TrackerParams())
    assert result.rows == 120
    assert result.accepted == 115
    assert dict(result.refused) == {
        "nothing measured": 2,
        "not finite": 1,
        "range not positive": 1,
        "range impossible in m": 1,
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "line 1: missing column t_s"),
        ("t_s,agent_x_m,agent_y_m,target_id\n", "line 1: missing column range_m or bearing"),
        ("\nsep=;\n# no header\n", "line 1: missing column t_s"),
        ("# of Monday\n\nt_s,agent_x_m\n", "line 3: missing column agent_y_m"),
        ("sep=;\n\nt_s;agent_x_m;agent_y_m;range_m\n0;1;x;3\n", "line 4: agent_y_m is not"),
        (
            "time,lat,lon,target_id,range_ft\n0,47.1,8.2,A,3\n",
            r"agent_y_m, range_m or .*; range_m = range_ft \* 0.3048; from degrees, .*cos\(lat0",
        ),
        ("t_s,x_ft,y_ft,target_id,bearing_deg\n", r"= bearing_deg \* pi / 180$"),
        ("t_s,x_ft,y_ft,target_id,range_m\n", r"; agent_x_m = x_ft \* 0.3048; agent_y_m = y_ft"),
        ("t_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,x,A,3\n", "line 2: agent_y_m is not"),
        ("t_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,2,,3\n", "line 2: target_id is empty"),
        ("t_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,2,A,3\nnan,1,2,A,3\n", "line 3: t_s must"),
        ("t_s,agent_x_m,agent_y_m,target_id,range_m\n0,1\n", "line 2: target_id is empty"),
        (
            "t_s,agent_x_m,agent_y_m,target_id,range_m,range_m\n0,1,2,A,3,\n",
            "line 1: more than one column range_m",
        ),
        (
            "t_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,2,A,3,\n1,1,2,A,9,54\n",
            "line 3: more cells than columns",
        ),
        (
            't_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,2,"A,3\n1,1,2,A,4\n',
            "line 2: a quote is not closed",
        ),
        (
            't_s,agent_x_m,agent_y_m,target_id,range_m\n0,1,2,"A,3\n1,1,2,A",4\n',
            "line 2: a quote is not closed",
        ),
    ],
)
def test_broken_file_names_the_line(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "walk.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem):
        list(read_walk(path))


def test_a_walk_about_one_emitter_needs_no_names(tmp_path: Path) -> None:
    path = tmp_path / "cellar.csv"
    path.write_text("t_s,agent_x_m,agent_y_m,range_m\n0,1,2,3\n,,,\n1,2,2,3\n")
    assert [row.target_id for row in read_walk(path)] == ["cellar", "cellar"]


@pytest.mark.parametrize(
    "text",
    [
        "t_s;agent_x_m;agent_y_m;target_id;range_m\n0,5;1,5;2;a.1,b;3,25\n",
        "t_s\tagent_x_m\tagent_y_m\ttarget_id\trange_m\n0.5\t1.5\t2\ta.1,b\t3.25\n",
        't_s, agent_x_m, agent_y_m , target_id, range_m\r\n0.5, 1.5, 2,"a.1,b" ,3.25\r\n',
        '\ufefft_s,agent_x_m,agent_y_m,target_id,range_m\n0.5,1.5,2,"a.1,b",3.25\n,,,,\n',
        "sep=;\r\nt_s;agent_x_m;agent_y_m;target_id;range_m\r\n0,5;1,5;2;a.1,b;3,25\r\n",
        "\ufeffsep=|\nt_s|agent_x_m|agent_y_m|target_id|range_m\n0.5|1.5|2|a.1,b|3.25\n",
        '\n,,\n# t_s, GPS\nt_s,agent_x_m,agent_y_m,target_id,range_m\n0.5,1.5,2,"a.1,b",3.25\n',
        '# t_s,agent_x_m,agent_y_m,target_id,range_m\n0.5,1.5,2,"a.1,b",3.25\n',
    ],
)
def test_separators_and_spaces_of_other_programs_are_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "walk.csv"
    path.write_text(text, encoding="utf-8")
    (row,) = read_walk(path)
    assert row.target_id == "a.1,b"
    assert row.agent_enu_m == (1.5, 2.0, 0.0)
    assert (row.measurement.measured_at_s, row.measurement.range_m) == (0.5, 3.25)


def test_rows_in_any_order_are_read_by_time(tmp_path: Path) -> None:
    ordered = write_walk(tmp_path / "ordered.csv", circle())
    backwards = write_walk(tmp_path / "backwards.csv", circle()[::-1])
    assert read_walk(backwards) == read_walk(ordered)


def test_coordinates_of_a_national_grid_are_localised_as_those_of_a_local_frame(
    tmp_path: Path,
) -> None:
    rows = circle()
    for row in rows:
        for name, false_m in (("agent_x_m", 691_000.0), ("agent_y_m", 5_334_000.0)):
            row[name] = false_m + float(str(row[name]))
    (near,) = replay_walk(write_walk(tmp_path / "near.csv", circle()), TrackerParams())
    (far,) = replay_walk(write_walk(tmp_path / "far.csv", rows), TrackerParams())
    assert near.estimate is not None
    assert far.estimate is not None
    assert far.state == near.state == "localised"
    assert far.estimate.r95_m == pytest.approx(near.estimate.r95_m, rel=0.2)
    assert far.estimate.position_enu_m == pytest.approx((691_004.0, 5_334_003.0), abs=0.2)


def test_nan_beside_a_bearing_is_a_range_that_was_not_measured(tmp_path: Path) -> None:
    rows = [row | {"range_m": "nan", "target_x_m": "nan", "target_y_m": "nan"} for row in circle()]
    for row in read_walk(write_walk(tmp_path / "walk.csv", rows)):
        assert row.measurement.range_m is None
        assert row.measurement.bearing_enu_rad is not None
        assert row.truth_enu_m is None


def test_reasons_of_refusals_stand_below_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = circle()
    for index, value in ((5, -3.0), (6, -3.0), (7, 1e9)):
        rows[index] |= {"range_m": value, "bearing_rad": ""}
    assert main(["replay", str(write_walk(tmp_path / "walk.csv", rows))]) == 0
    assert "refused: range not positive 2, range impossible in m 1\n" in capsys.readouterr().out


def test_a_radius_above_the_limit_for_localised_is_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The state is decided without the drift of the vehicle position, which R95 contains."""
    walk = write_walk(tmp_path / "walk.csv", circle())
    assert main(["replay", str(walk), "--own-sigma", "9"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^tag .* localised ", printed, re.MULTILINE)
    assert re.search(
        r"^localised: measurements place tag to [0-9.]+ m; R95 adds the drift",
        printed,
        re.MULTILINE,
    )


def test_command_prints_a_table_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = write_walk(tmp_path / "walk.csv", circle())
    assert main(["replay", str(walk), "--json", str(tmp_path / "out.json")]) == 0
    assert "tag" in capsys.readouterr().out
    (target,) = json.loads((tmp_path / "out.json").read_text())["targets"]
    assert target["target_id"] == "tag"
    assert target["n"] == 120
    assert target["state"] == "localised"
    assert target["east_m"] == pytest.approx(4.0, abs=0.2)
    assert target["r95_m"] > 0.0
    assert target["error_m"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", "no-such-file.csv"],
        ["replay", str(ROOT)],
        ["replay", str(MALL), "--config", "no-such-file.yaml"],
        ["replay"],
        [],
        ["--connect", "udp:127.0.0.1"],
        ["--connect", "udp:127.0.0.1:14550", "--speed", "nan"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("companion: ")


def test_a_walk_whose_every_row_is_refused_is_reported_and_no_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "walk.csv"
    rows = "".join(f"{t},{t}.0,0.0,7,-1.0\n" for t in range(5))
    path.write_text(f"t_s,agent_x_m,agent_y_m,target_id,range_m\n{rows}")
    assert main(["replay", str(path)]) == 0
    assert re.search(r"^7 +5 +5 +searching", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("value", ["inf", "nan", "-1e300"])
def test_a_place_that_is_not_on_the_earth_is_refused_by_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    path = tmp_path / "walk.csv"
    path.write_text(
        f"t_s,agent_x_m,agent_y_m,agent_z_m,target_id,range_m\n0.0,0.0,0.0,{value},7,5.0\n"
    )
    assert main(["replay", str(path)]) == EXIT_BAD_INPUT
    assert "line 2: agent_x_m, agent_y_m, agent_z_m" in capsys.readouterr().err


def test_what_is_stated_of_the_positions_narrows_the_radius(tmp_path: Path) -> None:
    """By column, by the JSON object next to the walk, by the caller, who has the last word."""
    params = load_config(ROOT / "configs/companion/uwb.yaml").tracking
    silent = write_walk(tmp_path / "silent.csv", circle())
    column = write_walk(tmp_path / "column.csv", [{**row, "own_sigma_m": 0.05} for row in circle()])
    beside = write_walk(tmp_path / "beside.csv", circle())
    (tmp_path / "beside.json").write_text('{"own_sigma_m": 0.05, "radio": "any"}')

    def r95_m(path: Path, own_sigma_m: float | None = None) -> float:
        (result,) = replay_walk(path, params, own_sigma_m=own_sigma_m)
        assert result.estimate is not None
        return result.estimate.absolute_r95_m

    stated_m = r95_m(column)
    assert stated_m == r95_m(beside) == r95_m(silent, 0.05)
    assert stated_m < 0.2 * r95_m(silent)
    assert r95_m(column, 1.0) > stated_m


def test_a_yaw_of_unknown_quality_makes_bearings_count_less(tmp_path: Path) -> None:
    rows = circle()
    sure = write_walk(tmp_path / "sure.csv", rows)
    vague = write_walk(tmp_path / "vague.csv", [{**row, "own_yaw_sigma_rad": 0.3} for row in rows])
    radii_m = []
    for path in (sure, vague):
        (result,) = replay_walk(path, load_config(None).tracking, own_sigma_m=0.0)
        assert result.estimate is not None
        radii_m.append(result.estimate.r95_m)
    assert radii_m[0] < radii_m[1]


@pytest.mark.parametrize(
    ("value", "words"),
    [("-1", "own_sigma_m must be finite"), ("inf", "own_sigma_m must be finite"), ("x", "own_")],
)
def test_no_standard_deviation_is_refused_by_its_line(
    tmp_path: Path, value: str, words: str
) -> None:
    path = write_walk(tmp_path / "w.csv", [{**row, "own_sigma_m": value} for row in circle(3)])
    with pytest.raises(ConfigError, match=f"line 2: {words}"):
        list(read_walk(path))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"own_sigma_m": -1}', r"\$\.own_sigma_m: expected a number >= 0.0"),
        ('{"own_sigma_m": "1"}', r"\$\.own_sigma_m: expected a number or null, got text"),
        ("[]", "expected an object, got a list"),
        ("{", "Input data was truncated"),
    ],
)
def test_a_file_beside_that_says_nonsense_is_named(tmp_path: Path, text: str, problem: str) -> None:
    path = write_walk(tmp_path / "w.csv", circle(3))
    (tmp_path / "w.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"w\.json: beside the walk: {problem}$"):
        list(read_walk(path))


def test_results_never_replace_what_describes_the_walk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_walk(tmp_path / "w.csv", circle(20))
    beside = tmp_path / "w.json"
    beside.write_text('{"own_sigma_m": 0.1}')
    assert main(["replay", str(path), "--json", str(beside)]) == EXIT_BAD_INPUT
    assert "describes the walk" in capsys.readouterr().err
    walk = path.read_bytes()
    assert main(["replay", str(path), "--json", str(path)]) == EXIT_BAD_INPUT
    assert "is the walk; choose another file" in capsys.readouterr().err
    assert path.read_bytes() == walk
    assert beside.read_text() == '{"own_sigma_m": 0.1}'
    assert main(["replay", "w.tlog", "--own-sigma", "1"]) == EXIT_BAD_INPUT
    assert "--own-sigma" in capsys.readouterr().err


def test_the_budget_leads_from_thermal_noise_to_the_absolute_radius(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_walk(tmp_path / "walk.csv", circle())
    json_path = tmp_path / "out.json"
    assert main(["replay", str(path), "--explain", "--json", str(json_path)]) == 0
    printed = capsys.readouterr().out
    (target,) = json.loads(json_path.read_text())["targets"]
    budget = target["r95_budget_m"]
    assert next(iter(budget)) == "thermal noise"
    assert budget["thermal noise"] < budget["offsets that are estimated"]
    assert budget["rival places"] == target["settled_r95_m"]
    assert budget["vehicle position during the search"] == target["r95_m"]
    assert budget["vehicle position on the Earth"] == target["absolute_r95_m"]
    assert all(f"m  {term}" in printed for term in budget)
    assert main(["replay", "w.tlog", "--explain"]) == EXIT_BAD_INPUT
    assert "--explain" in capsys.readouterr().err


def test_errors_that_repeat_are_named_in_the_budget(tmp_path: Path) -> None:
    """A slow wave of the ranges' error widens that term, and not the thermal one."""
    rng, rows = np.random.default_rng(4), circle()
    errors = {"calm": rng.normal(0.0, 1.0, 120), "waved": np.sin(np.arange(120) / 9.0)}
    budgets = []
    for name, error_m in errors.items():
        ranges_m = [float(str(row["range_m"])) for row in rows] + error_m
        walk = [{**row, "range_m": r} for row, r in zip(rows, ranges_m, strict=True)]
        walk = [{k: v for k, v in row.items() if k != "bearing_rad"} for row in walk]
        path = write_walk(tmp_path / f"{name}.csv", walk)
        (result,) = replay_walk(path, load_config(None).tracking, own_sigma_m=0.0)
        budgets.append(result.budget_m)
    calm, wave = budgets
    assert wave["thermal noise"] == pytest.approx(calm["thermal noise"], rel=0.3)
    assert wave["errors that repeat"] > 1.5 * wave["noise as measured"]
    assert calm["errors that repeat"] < 1.2 * calm["noise as measured"]


def test_what_ends_a_replay_is_written_over_its_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: Path, __: object, progress: Callable[[int], None], ___: object) -> None:
        progress(1000)
        raise KeyboardInterrupt

    monkeypatch.setattr("companion.replay.replay_commands.replay_walk", interrupted)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert main(["replay", str(tmp_path / "walk.csv")]) == 1
    assert capsys.readouterr().err == "\r1000 rows\rcompanion: interrupted\n"
