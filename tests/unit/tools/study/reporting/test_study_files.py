from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from tools.run_study import table_text
from tools.study.reporting.study_tables import (
    load_study,
    studies_of,
    study_path,
)
from tools.study.study import ResultRow
from tools.study.study_run import made_folder

FOLDER = Path(__file__).parents[5] / "configs" / "studies"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))
STUDY = """
table: small
title: Small
systems: [ekf/passive]
metrics: [final_rmse_m]
sweeps:
  - parameter: step_m
    varies: [step_m]
    values: [5.0]
"""


def _written(tmp_path: Path, text: str, name: str = "small") -> Path:
    path = tmp_path / f"{name}.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", NAMES)
def test_the_projects_own_studies_are_right(name: str) -> None:
    assert studies_of(name, FOLDER)


def test_all_is_everything_but_robustness_and_the_field() -> None:
    tables = {study.table for study in studies_of("all", FOLDER)}
    assert tables == set(NAMES) - {"all", "robustness", "field"}


def test_every_number_that_the_paper_prints_is_in_a_study() -> None:
    sweeps = [sweep for study in studies_of("all", FOLDER) for sweep in study.sweeps]
    printed = [
        number
        for sweep in sweeps
        for metrics in sweep.paper.values()
        for numbers in metrics.values()
        for number in numbers
    ]
    assert len(printed) == 100
    assert None not in printed


def test_robustness_is_ten_thousand_runs() -> None:
    assert [study.runs for study in studies_of("robustness", FOLDER)] == [10_000]


def test_a_path_needs_no_folder(tmp_path: Path) -> None:
    assert studies_of(str(_written(tmp_path, STUDY)), tmp_path / "nowhere")[0].title == "Small"


def test_an_unknown_study_gets_a_hint() -> None:
    with pytest.raises(ConfigError, match=r"did you mean `grand_summary`\?"):
        study_path("grand_sumary", FOLDER)


@pytest.mark.parametrize(
    ("old", "new", "where", "what"),
    [
        ("title:", "titel:", r"\$\.titel", "unknown key"),
        ("varies:", "varys:", r"\$\.sweeps\[0\]\.varys", "unknown key"),
        ("[final_rmse_m]", "[final_rsme_m]", r"\$\.metrics\[0\]", "final_rsme_m"),
        ("title: Small", "figures: [track]\ntitle: x", r"\$\.figures\[0\]", ": track is none of"),
        (
            "[ekf/passive]",
            "{filters: [ekf], planners: [latchd]}",
            r"\$\.systems\.planners\[0\]",
            "latchd",
        ),
        ("title: Small", "title: Small\nruns: 0", r"\$\.runs", ">= 1"),
        ("sweeps:", "studies: [p_nlos]\nsweeps:", r"\$", "`sweeps`, or `studies`"),
        ("title: Small", "title: [", "line 5", "expected"),
        ("values: [5.0]", "values: [-5.0]", r"\$\.sweeps\[0\], step_m -5.0", "> 0.0"),
    ],
)
def test_a_wrong_file_is_one_line_that_says_where(
    tmp_path: Path, old: str, new: str, where: str, what: str
) -> None:
    path = _written(tmp_path, STUDY.replace(old, new, 1))
    with pytest.raises(ConfigError, match=where) as error:
        load_study(path)
    assert str(error.value).startswith(str(path))
    assert what in str(error.value)
    assert "\n" not in str(error.value)


def test_a_collection_must_not_contain_itself(tmp_path: Path) -> None:
    path = _written(tmp_path, "table: a\ntitle: a\nstudies: [a]\n", "a")
    with pytest.raises(ConfigError, match="contains itself"):
        studies_of("a", tmp_path)
    path.write_text("table: a\ntitle: a\nstudies: [b]\n")
    with pytest.raises(ConfigError, match=r"\$\.studies: study b: there is none"):
        studies_of("a", tmp_path)


def test_rows_as_csv() -> None:
    row = ResultRow("t", "p", "0.5", "EKF (FIM)", "final_rmse_m", "0.1", "0.2", "0.1..0.3", "")
    assert table_text([row]).splitlines() == [
        "table,parameter,value,system,metric,paper,ours,ours_ci95,bound",
        "t,p,0.5,EKF (FIM),final_rmse_m,0.1,0.2,0.1..0.3,",
    ]


def test_a_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    assert made_folder(tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="choose another --out"):
        made_folder(tmp_path / "file" / "out")
