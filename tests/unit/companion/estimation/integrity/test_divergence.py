"""Innovations that stay larger than they say they are, and restarts that come too often."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterState,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.innovations import OPEN
from companion.estimation.integrity import (
    NIS_WINDOW_COUNT,
    RESTART_MEMORY_S,
    NisWindow,
    TrackIntegrity,
)
from companion.estimation.screen import Objection

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))


def _row(u: float, weight: float = 1.0) -> ModalityReport:
    return ModalityReport(u, 1.0, 1.0, u, weight, 0.0)


def _report(ranged: float, borne: float, range_weight: float = 1.0) -> UpdateReport:
    return UpdateReport(STATE, (_row(ranged, range_weight), _row(borne), None), 0.0, True)


def _first_alarm(
    window: NisWindow, reports: Sequence[UpdateReport], start_s: float, rate_hz: float = 10.0
) -> float | None:
    for step, report in enumerate(reports):
        time_s = start_s + step / rate_hz
        if window.add(report, NO_INFLATION, time_s):
            return time_s - start_s
    return None


def _consistent(count: int, seed: int = 1) -> list[UpdateReport]:
    rng = np.random.default_rng(seed)
    return [_report(*rng.normal(size=2).tolist()) for _ in range(count)]


@pytest.mark.slow
def test_consistent_innovations_never_alarm() -> None:
    assert _first_alarm(NisWindow(), _consistent(20_000), 0.0) is None


def test_innovations_of_twice_their_size_do_within_seconds() -> None:
    window = NisWindow()
    assert _first_alarm(window, _consistent(300), 0.0) is None
    rng = np.random.default_rng(2)
    wide = [_report(*(2.5 * rng.normal(size=2)).tolist()) for _ in range(100)]
    alarm_s = _first_alarm(window, wide, 30.0)
    assert alarm_s is not None
    assert 3.0 <= alarm_s <= 7.0


@pytest.mark.parametrize(("range_weight", "is_discarded"), [(0.2, False), (1.0, True)])
def test_reflections_are_no_divergence(range_weight: float, is_discarded: bool) -> None:
    integrity, long = TrackIntegrity(), _report(8.0, 0.3, range_weight)
    discarded = [integrity.update(0.1 * step, long, OPEN, NO_INFLATION) for step in range(300)]
    assert any(discarded) is is_discarded


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_no_divergence(share: float) -> None:
    rng = np.random.default_rng(3)
    reports = [
        _report(*((10.0 if rng.random() < share else 0.6) * rng.normal(size=2)).tolist())
        for _ in range(3000)
    ]
    assert _first_alarm(NisWindow(), reports, 0.0) is None


def test_noise_that_the_run_has_shown_is_no_divergence() -> None:
    window, rng = NisWindow(), np.random.default_rng(2)
    wide = [_report(*(2.5 * rng.normal(size=2)).tolist()) for _ in range(600)]
    assert not any(
        window.add(report, (6.25, 6.25, 1.0), 0.1 * step) for step, report in enumerate(wide)
    )


def test_what_is_over_is_forgiven() -> None:
    window = NisWindow()
    assert _first_alarm(window, _consistent(60), 0.0) is None
    assert _first_alarm(window, [_report(4.0, 4.0)] * 25, 6.0) is None
    assert _first_alarm(window, [_report(0.2, 0.2)] * 60, 8.5) is None


def test_it_takes_a_full_window_to_tell() -> None:
    window = NisWindow()
    assert _first_alarm(window, [_report(9.0, 9.0)] * (NIS_WINDOW_COUNT - 1), 0.0, 1.0) is None
    window = NisWindow()
    assert _first_alarm(window, [_report(9.0, 9.0)] * (NIS_WINDOW_COUNT + 8), 0.0, 1.0) is None
    assert _first_alarm(window, [_report(9.0, 9.0)] * 3, 50.0, 1.0) is not None


def test_an_update_without_a_word_about_the_estimate_counts_for_nothing() -> None:
    window = NisWindow()
    empty = UpdateReport(STATE, (None, None, None), 0.0, True)
    assert _first_alarm(window, [empty] * 200, 0.0) is None


def test_two_restarts_within_a_minute_are_too_many() -> None:
    integrity = TrackIntegrity()
    integrity.give_up(100.0, accepted=0)
    assert integrity.objection(100.0) is None
    integrity.give_up(130.0, accepted=0)
    assert integrity.objection(130.0) is Objection.UNSTABLE
    assert integrity.objection(100.0 + RESTART_MEMORY_S) is Objection.UNSTABLE
    assert integrity.objection(100.1 + RESTART_MEMORY_S) is None
    integrity.give_up(170.0, accepted=0)
    assert integrity.objection(189.0) is Objection.UNSTABLE
