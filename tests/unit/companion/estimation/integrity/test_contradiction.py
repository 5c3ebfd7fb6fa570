"""A confident estimate is given up after forty contradictions of one kind in a row."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterState,
    Inflation,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.integrity import (
    CONTRADICTION_COUNT,
    CONTRADICTION_U,
    Contradiction,
)

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))


def _modality(innovation: float, u: float, prior_share: float = 0.1) -> ModalityReport:
    return ModalityReport(innovation, 1.0, abs(innovation / u), u, 1.0, prior_share)


def _range(u: float, prior_share: float = 0.1) -> ModalityReport:
    return _modality(1.5 * u, u, prior_share)


def _bearing(u: float, prior_share: float = 0.1) -> ModalityReport:
    return _modality(0.03 * u, u, prior_share)


def _behind(side: float) -> ModalityReport:
    return _modality(side * 3.0, side * 100.0)


def _report(
    ranged: ModalityReport | None = None, borne: ModalityReport | None = None
) -> UpdateReport:
    return UpdateReport(STATE, (ranged, borne, None), 0.0, True)


def _after(
    reports: Iterable[UpdateReport],
    inflation: Inflation = NO_INFLATION,
    start: Contradiction | None = None,
) -> Contradiction:
    contradiction = start or Contradiction()
    for report in reports:
        contradiction = contradiction.after(report, inflation)
    return contradiction


LEFT, RIGHT = _report(borne=_bearing(5.0)), _report(borne=_bearing(-5.0))
SHORT, LONG = _report(_range(-5.0)), _report(_range(5.0))
FINE = _report(_range(0.4), _bearing(-0.7))


def test_at_first_nothing_contradicts() -> None:
    assert not Contradiction().is_conclusive
    assert _after([FINE] * 100) == Contradiction()


@pytest.mark.parametrize("report", [LEFT, RIGHT, SHORT, _report(_range(0.1), _behind(1.0))])
def test_so_many_of_a_kind_are_conclusive(report: UpdateReport) -> None:
    assert not _after([report] * (CONTRADICTION_COUNT - 1)).is_conclusive
    assert _after([report] * CONTRADICTION_COUNT).is_conclusive


def test_ranges_that_are_too_long_are_what_reflections_do() -> None:
    assert _after([LONG] * 100) == Contradiction()


@pytest.mark.parametrize("report", [LEFT, SHORT])
def test_one_that_agrees_forgives_all(report: UpdateReport) -> None:
    almost = [report] * (CONTRADICTION_COUNT - 1)
    assert _after([*almost, FINE]) == Contradiction()
    assert not _after([*almost, FINE, report]).is_conclusive


def test_the_other_side_starts_a_count_of_its_own() -> None:
    """An estimate that is vague across the line of sight is missed to both sides."""
    assert not _after([LEFT] * 30 + [RIGHT] * 30).is_conclusive
    assert not _after([LEFT, RIGHT] * 100).is_conclusive


def test_behind_is_one_kind_whichever_way_it_wraps() -> None:
    sides = [_report(borne=_behind(side)) for side in (1.0, -1.0)]
    assert _after(sides * (CONTRADICTION_COUNT // 2)).is_conclusive
    assert not _after([LEFT, *sides] * CONTRADICTION_COUNT).is_conclusive


def test_ranges_and_bearings_may_come_one_by_one() -> None:
    fine_range, fine_bearing = _report(_range(0.3)), _report(borne=_bearing(0.3))
    assert _after([LEFT, fine_range] * CONTRADICTION_COUNT).is_conclusive
    assert _after([SHORT, fine_bearing] * CONTRADICTION_COUNT).is_conclusive
    assert _after([LEFT, SHORT] * CONTRADICTION_COUNT).is_conclusive
    assert not _after([LEFT, fine_bearing, fine_range] * CONTRADICTION_COUNT).is_conclusive


def test_a_good_range_does_not_excuse_a_bearing() -> None:
    assert _after([_report(_range(0.1), _bearing(5.0))] * CONTRADICTION_COUNT).is_conclusive
    assert _after([_report(_range(-5.0), _bearing(0.1))] * CONTRADICTION_COUNT).is_conclusive


@pytest.mark.parametrize("u", [0.99 * CONTRADICTION_U, -0.99 * CONTRADICTION_U])
def test_under_the_threshold_it_is_noise(u: float) -> None:
    assert _after([_report(_range(u), _bearing(u))] * 50) == Contradiction()


@pytest.mark.parametrize(
    ("ranged_u", "borne_u", "contradicts"),
    [(-5.9, 8.9, False), (-6.1, 0.0, True), (0.0, 9.1, True), (0.0, -9.1, True)],
)
def test_inflated_noise_must_be_contradicted_by_more(
    ranged_u: float, borne_u: float, contradicts: bool
) -> None:
    report = _report(_range(ranged_u or 0.1), _bearing(borne_u or 0.1))
    assert (_after([report], (4.0, 9.0, 1.0)) != Contradiction()) is contradicts


def test_what_a_vague_state_predicts_contradicts_nothing() -> None:
    vague = _report(_range(-50.0, prior_share=1.0), _bearing(50.0, prior_share=1.0))
    assert _after([vague] * 50) == Contradiction()
