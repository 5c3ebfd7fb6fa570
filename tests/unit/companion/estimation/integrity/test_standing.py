"""What is held against an estimate, and what is told of it."""

from __future__ import annotations

import numpy as np

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterState,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.integrity.track_integrity import CONTRADICTION_COUNT, TrackIntegrity
from companion.estimation.screening.validation import Gate, Objection

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))


def _noted(standing: TrackIntegrity, time_s: float, u: float) -> bool:
    """A range with this innovation, in sigma; a long one is taken for a reflection."""
    row = ModalityReport(u, 1.0, 1.0, u, 1.0 if u < 1.0 else 1.0 / u, 0.0)
    report = UpdateReport(STATE, row, None, None, u * u, True)
    measurement = RangingMeasurement(1, time_s, range_m=50.0)
    return standing.note(measurement, report, Gate.of(report, NO_INFLATION), NO_INFLATION)


def _flown(standing: TrackIntegrity, count: int, start_s: float, u: float) -> list[bool]:
    return [_noted(standing, start_s + 0.1 * step, u) for step in range(count)]


def test_nothing_speaks_against_an_estimate_that_fits() -> None:
    standing = TrackIntegrity()
    standing.began(RangingMeasurement(1, 0.0, range_m=50.0))
    assert not any(_flown(standing, 100, 0.1, 0.5))
    assert standing.objection(10.1) is None
    assert standing.is_proven
    assert standing.contact.agreeing_since_gap(10.1) == 101


def test_a_run_of_ranges_that_are_too_short_ends_it() -> None:
    standing = TrackIntegrity()
    _flown(standing, 100, 0.0, 0.5)
    given_up = _flown(standing, CONTRADICTION_COUNT, 10.0, -9.0)
    assert given_up[-1]
    assert given_up.index(True) >= 25
    assert standing.objection(14.0) is Objection.CONTRADICTED
    assert standing.contact.range_age_s(14.0) is not None
    standing.given_up(14.0)
    assert standing.objection(14.0) is None
    assert not standing.is_proven


def test_what_nothing_agrees_with_for_seconds_is_given_up() -> None:
    standing = TrackIntegrity()
    _flown(standing, 100, 0.0, 0.5)
    given_up = _flown(standing, 100, 10.0, 40.0)  # longer than any reflection
    assert 5.0 <= 0.1 * given_up.index(True) <= 8.0


def test_a_burst_that_nothing_agrees_with_is_survived() -> None:
    standing = TrackIntegrity()
    _flown(standing, 100, 0.0, 0.5)
    assert not any(_flown(standing, 40, 10.0, 40.0))
    assert standing.objection(14.0) is Objection.CONTRADICTED
    assert not any(_flown(standing, 40, 14.0, 0.5))
    assert standing.objection(18.0) is None


def test_disagreement_does_not_excuse_itself_by_the_noise_that_it_shows() -> None:
    standing, inflated = TrackIntegrity(), (900.0, 1.0, 1.0)
    _flown(standing, 100, 0.0, 0.5)
    assert standing.judging(inflated) == inflated
    _flown(standing, 40, 10.0, 40.0)
    assert standing.judging(inflated) == NO_INFLATION
    _flown(standing, 40, 14.0, 0.5)
    assert standing.judging(inflated) == inflated


def test_giving_up_twice_within_a_minute_is_told() -> None:
    standing = TrackIntegrity()
    standing.given_up(100.0)
    standing.given_up(130.0)
    assert standing.objection(131.0) is Objection.UNSTABLE
    standing.forget()
    assert standing.objection(131.0) is Objection.UNSTABLE
    assert standing.objection(161.0) is None


def test_a_frame_that_moved_ends_the_contact() -> None:
    standing = TrackIntegrity()
    _flown(standing, 50, 0.0, 0.5)
    standing.forget()
    assert standing.contact.newest_s is None
    assert not standing.is_proven
