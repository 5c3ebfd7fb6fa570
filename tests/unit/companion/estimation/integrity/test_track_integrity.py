"""Evidence against an estimate, and its announcement."""

from __future__ import annotations

import numpy as np

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterState,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.innovations import Gate
from companion.estimation.integrity import CONTRADICTION_COUNT, TrackIntegrity
from companion.estimation.screen import Objection

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))


def _noted(integrity: TrackIntegrity, time_s: float, u: float) -> bool:
    """A range with this innovation, in sigma; a long one is taken for a reflection."""
    row = ModalityReport(u, 1.0, 1.0, u, 1.0 if u < 1.0 else 1.0 / u, 0.0)
    report = UpdateReport(STATE, (row, None, None), u * u, True)
    gate = Gate.of(report, NO_INFLATION)
    return integrity.update(time_s, report, gate, integrity.gate_inflation(NO_INFLATION))


def _flown(integrity: TrackIntegrity, count: int, start_s: float, u: float) -> list[bool]:
    return [_noted(integrity, start_s + 0.1 * step, u) for step in range(count)]


def test_nothing_speaks_against_an_estimate_that_fits() -> None:
    integrity = TrackIntegrity()
    integrity.begin(RangingMeasurement(1, 0.0, range_m=50.0))
    assert not any(_flown(integrity, 100, 0.1, 0.5))
    assert integrity.objection(10.1) is None
    assert integrity.is_proven
    assert integrity.contact.agreeing_since_gap(10.1) == 101


def test_a_run_of_ranges_that_are_too_short_ends_it() -> None:
    integrity = TrackIntegrity()
    _flown(integrity, 100, 0.0, 0.5)
    given_up = _flown(integrity, CONTRADICTION_COUNT, 10.0, -9.0)
    assert given_up[-1]
    assert given_up.index(True) >= 25
    assert integrity.objection(14.0) is Objection.CONTRADICTED
    assert integrity.contact.range_age_s(14.0) is not None
    integrity.give_up(14.0, 140)
    assert integrity.objection(14.0) is None
    assert not integrity.is_proven


def test_what_nothing_agrees_with_for_seconds_is_given_up() -> None:
    integrity = TrackIntegrity()
    _flown(integrity, 100, 0.0, 0.5)
    given_up = _flown(integrity, 100, 10.0, 40.0)  # longer than any reflection
    assert 5.0 <= 0.1 * given_up.index(True) <= 8.0


def test_a_burst_that_nothing_agrees_with_is_survived() -> None:
    integrity = TrackIntegrity()
    _flown(integrity, 100, 0.0, 0.5)
    assert not any(_flown(integrity, 40, 10.0, 40.0))
    assert integrity.objection(14.0) is Objection.CONTRADICTED
    assert not any(_flown(integrity, 40, 14.0, 0.5))
    assert integrity.objection(18.0) is None


def test_disagreement_does_not_excuse_itself_by_the_noise_that_it_shows() -> None:
    integrity, inflated = TrackIntegrity(), (900.0, 1.0, 1.0)
    _flown(integrity, 100, 0.0, 0.5)
    assert integrity.gate_inflation(inflated) == inflated
    _flown(integrity, 40, 10.0, 40.0)
    assert integrity.gate_inflation(inflated) == NO_INFLATION[: len(inflated)]
    _flown(integrity, 40, 14.0, 0.5)
    assert integrity.gate_inflation(inflated) == inflated


def test_giving_up_twice_within_a_minute_is_reported() -> None:
    integrity = TrackIntegrity()
    integrity.give_up(100.0, 500)
    integrity.give_up(130.0, 800)
    assert integrity.objection(131.0) is Objection.UNSTABLE
    assert integrity.restarts == 2
    assert integrity.is_recovering(800 + CONTRADICTION_COUNT)
    assert not integrity.is_recovering(801 + CONTRADICTION_COUNT)
    integrity.forget()
    assert integrity.objection(131.0) is Objection.UNSTABLE
    assert integrity.objection(161.0) is None


def test_a_frame_that_moved_ends_the_contact() -> None:
    integrity = TrackIntegrity()
    _flown(integrity, 50, 0.0, 0.5)
    integrity.forget()
    assert integrity.contact.newest_s is None
    assert not integrity.is_proven
