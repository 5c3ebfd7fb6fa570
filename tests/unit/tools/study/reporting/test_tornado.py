from __future__ import annotations

import pytest

from tests.unit.tools.study.reporting.invented import cell, study, tally
from tools.study.reporting.tables import tornado_of


def test_factors_are_relative_to_the_first_value() -> None:
    chosen = cell("map/latched", tally(0.02), "assumptions", "500", "horizon_steps")
    other = cell("map/latched", tally(0.03), "assumptions", "200", "horizon_steps")
    tornado = tornado_of([study(chosen, other)])
    assert tornado is not None
    (row,) = tornado.assumptions
    (swing,) = row.swings
    assert swing is not None
    assert row.values == ("500", "200")
    assert swing.factors[0][1] == pytest.approx(1.5)
    assert swing.left_percent == pytest.approx(50.0)
    assert not swing.is_cut


def test_what_moves_most_comes_first() -> None:
    cells = [
        cell("map/latched", tally(final_m), "assumptions", value, parameter)
        for parameter, values in (("little", (0.02, 0.021)), ("much", (0.02, 0.001)))
        for value, final_m in zip(("a", "b"), values, strict=True)
    ]
    tornado = tornado_of([study(*cells)])
    assert tornado is not None
    assert [row.parameter for row in tornado.assumptions] == ["much", "little"]
    assert tornado.span == 10.0
    assert tornado.assumptions[0].swings[0] is not None
    assert tornado.assumptions[0].swings[0].is_cut


def test_other_studies_have_no_tornado() -> None:
    assert tornado_of([study(cell("map/latched", tally(0.02)))]) is None
