from __future__ import annotations

from typing import Any

import msgspec
import pytest

from companion.errors import ConfigError
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import Case
from tools.study.study import Study, cells_of, hint, value_text
from tools.study.systems import System

SWEEP = {
    "parameter": "sigma_r_m",
    "varies": ["channel.range_sigma_m", "belief.range_sigma_m"],
    "values": [0.5, 1.5],
}
STUDY = {
    "table": "noise",
    "title": "Noise",
    "systems": {"filters": ["ekf", "huber"], "planners": ["passive", "fim"]},
    "metrics": ["final_rmse_m"],
}


def _study(sweep: dict[str, Any], **changes: Any) -> Study:
    return msgspec.convert({**STUDY, "sweeps": [{**SWEEP, **sweep}], **changes}, Study)


def test_every_system_flies_every_value() -> None:
    cells = cells_of(_study({}))
    assert [(cell.value, cell.system.label) for cell in cells[:5]] == [
        ("0.5", "EKF (Passive)"),
        ("0.5", "EKF (FIM)"),
        ("0.5", "Huber (Passive)"),
        ("0.5", "Huber (FIM)"),
        ("1.5", "EKF (Passive)"),
    ]
    assert cells[0].case == canonical_case(range_sigma_m=0.5)
    assert cells[4].case == Case()
    assert {cell.table for cell in cells} == {"noise"}


def test_a_sweep_may_differ_from_its_study() -> None:
    sweep = {"table": "text", "systems": ["map/latched"], "case": {"channel": {"p_nlos": 0.7}}}
    (low, _) = cells_of(_study(sweep))
    assert (low.table, low.system) == ("text", System("map", "latched"))
    assert low.case == canonical_case(range_sigma_m=0.5, p_nlos=0.7)


def test_variants_override_the_case_by_name() -> None:
    variants = {"as it is": {}, "on lanes of 8 m": {"lane_spacing_m": 8.0}}
    cells = cells_of(_study({"varies": [], "values": [], "variants": variants}))
    assert [cells[0].value, cells[-1].value] == ["as it is", "on lanes of 8 m"]
    assert [cells[0].case.lane_spacing_m, cells[-1].case.lane_spacing_m] == [5.0, 8.0]


@pytest.mark.parametrize(
    ("value", "text"), [(0.5, "0.5"), (3.0, "3.0"), (16, "16"), (None, "none"), (True, "true")]
)
def test_values_are_written_as_the_tables_have_them(value: Any, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize(
    ("sweep", "where", "what"),
    [
        ({"varies": ["channel.p_nloss"]}, "varies[0]", "did you mean `p_nlos`?"),
        ({"case": {"chanel": {"p_nlos": 0.1}}}, "$.sweeps[0].case.chanel", "`channel`"),
        ({"case": {"channel": {"p_nlos": 2.0}}}, "$.sweeps[0], sigma_r_m 0.5", "<= 1.0"),
        ({"case": {"channel": {"bearing_sigma_deg": 0.0}}}, "sigma_r_m 0.5", "thermal noise"),
        ({"values": []}, "$.sweeps[0]", "`varies` and `values`, or `variants`"),
        ({"variants": {"a": {}}}, "$.sweeps[0]", "`varies` and `values`, or `variants`"),
        ({"values": [1.5, 1.5]}, "values", "1.5 is given twice"),
        ({"systems": []}, "systems", "at least one system"),
        ({"systems": ["ekf/fim", "ekf/fim"]}, "systems", "EKF (FIM) is given twice"),
        ({"systems": ["ekf/fin"]}, "systems[0]", "'fin' is none of"),
        ({"paper": {"EKF (Fim)": {"final_rmse_m": [1, 2]}}}, "paper.EKF (Fim)", "`EKF (FIM)`"),
        ({"paper": {"EKF (FIM)": {"final_rmse_m": [1]}}}, "final_rmse_m", "1 numbers for 2 values"),
        ({"metrics": ["rmse_after_steps_m"]}, "after_steps", "0 numbers for 2 values"),
    ],
)
def test_a_wrong_sweep_is_one_line_that_says_where(
    sweep: dict[str, Any], where: str, what: str
) -> None:
    with pytest.raises(ConfigError) as error:
        cells_of(_study(sweep))
    assert where in str(error.value)
    assert what in str(error.value)
    assert "\n" not in str(error.value)


def test_the_paper_may_name_a_filter_alone_and_means_lanes() -> None:
    paper = {"EKF": {"range_offset_m": [None, 5.5]}}
    assert cells_of(_study({"paper": paper}))[0].sweep.paper["EKF"]["range_offset_m"][1] == 5.5


def test_a_name_like_no_other_gets_the_list() -> None:
    assert hint("latchd", ["passive", "latched"]) == "did you mean `latched`?"
    assert hint("zzz", ["passive", "latched"]) == "known: passive, latched"
