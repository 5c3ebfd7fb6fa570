from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest

from companion.geometry.polygons import contains
from tests.unit.tools.study.reporting.invented import cell, row, study, tally
from tools.study.reporting.figure_data import (
    cells_at,
    interval,
    numbers,
    offset_curves,
    rmse_curves,
    sensitivities,
    shadow_quads,
    values_of,
)
from tools.study.reporting.figures import FIGURES, drawings_of
from tools.study.study import FigureName
from tools.study.systems import System

BLOCK = [(30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)]
LATCHED = System("map", "latched")


@pytest.mark.parametrize(
    ("point", "is_dark"),
    [((10.0, 10.0), True), ((0.0, 50.0), True), ((60.0, 50.0), False), ((45.0, 90.0), False)],
)
def test_the_shadow_is_what_the_target_cannot_see(
    point: tuple[float, float], is_dark: bool
) -> None:
    quads = shadow_quads(BLOCK, (50.0, 50.0))
    assert any(contains(quad, point) for quad in quads) is is_dark


def test_curves_are_of_the_compared_systems_and_their_bounds() -> None:
    result = study(cell("map/latched", tally(0.02)), cell("ekf/fim", tally(0.3)))
    (parameter, value), *_ = values_of(result)
    curves = rmse_curves(cells_at(result, parameter, value))
    assert [(curve.system, curve.is_bound) for curve in curves] == [
        (LATCHED, False),
        (LATCHED, True),
    ]
    assert curves[0].values[-1] == pytest.approx(0.02)
    assert curves[1].values[-1] == pytest.approx(0.01)


def test_offsets_are_means_over_runs() -> None:
    cells = {LATCHED: cell("map/latched", tally(0.02))}
    assert offset_curves(cells, bearing=False)[0].values[0] == pytest.approx(5.3)
    assert offset_curves(cells, bearing=True)[0].values[0] == pytest.approx(math.degrees(-0.05))


def test_sensitivity_is_of_what_the_paper_prints_and_of_ours() -> None:
    names = ("map/latched", "ekf/fim", "huber/passive")
    cells = [cell(name, tally(0.02), value=value) for value in ("0.5", "1.5") for name in names]
    rows = [
        row(c.system, "0.02", "0.4" if c.system.filter == "huber" else "", value=c.value)
        for c in cells
    ]
    found = sensitivities(study(*cells), rows, "sigma_r_m")
    assert [system.label for system, _ in found] == ["MAP (Latched)", "Huber (Passive)"]
    assert np.isnan(found[0][1][2]).all()
    assert found[1][1][2].tolist() == [0.4, 0.4]


def test_every_figure_that_a_study_may_ask_for_can_be_drawn() -> None:
    assert set(get_args(FigureName)) == set(FIGURES)


@pytest.mark.slow
def test_rmse_and_sensitivity_are_drawn_from_a_sweep() -> None:
    cells = [cell("map/latched", tally(0.02), value=value) for value in ("0.5", "1.5")]
    rows = [row(LATCHED, "0.02", value=value) for value in ("0.5", "1.5")]
    found = drawings_of(study(*cells, figures=("rmse", "sensitivity")), rows)
    assert [drawing.name for drawing in found] == [
        "grand_summary_rmse_sigma_r_m_0.5",
        "grand_summary_rmse_sigma_r_m_1.5",
        "grand_summary_sensitivity_sigma_r_m",
    ]


def test_results_are_read_back() -> None:
    assert interval("0.1..0.2") == (0.1, 0.2)
    assert math.isnan(numbers(">500"))
    assert math.isnan(interval("")[0])
