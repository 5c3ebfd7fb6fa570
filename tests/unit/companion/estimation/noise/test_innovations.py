"""Noise of a run by its innovations, modality by modality."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.filters.target_filter import FilterState, ModalityReport, UpdateReport
from companion.estimation.innovations import MAX_INFLATION, MAX_PRIOR_SHARE, InnovationNoise

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))
THRESHOLDS = np.array([[1.5, math.inf], [1.5, 1.5], [1.5, 1.5]])


def _row(u: float | None, prior_share: float = 0.1) -> ModalityReport | None:
    return None if u is None else ModalityReport(2.0 * u, 4.0, 2.0, u, 1.0, prior_share)


def _report(
    ranged: float | None = None,
    borne: float | None = None,
    elevated: float | None = None,
    prior_share: float = 0.1,
) -> UpdateReport:
    rows = [_row(u, prior_share) for u in (ranged, borne, elevated)]
    nis = sum(u * u for u in (ranged, borne, elevated) if u is not None)
    return UpdateReport(STATE, tuple(rows[:3]), nis, True)


def _after(reports: list[UpdateReport]) -> InnovationNoise:
    noise = InnovationNoise.starting(4.0)
    for report in reports:
        noise = noise.after(report, THRESHOLDS)
    return noise


def test_at_first_the_configured_inflation_is_believed() -> None:
    noise = InnovationNoise.starting(4.0)
    assert noise.inflation == pytest.approx((4.0, 4.0, 4.0))
    assert noise.is_white
    assert noise.nlos_share == 0.0
    assert noise.nis is None


def test_a_modality_that_a_report_lacks_keeps_its_noise() -> None:
    noise = InnovationNoise.starting(4.0, rows=4).after(_report(1.0), THRESHOLDS)
    assert len(replace(noise, found=(1.0, 2.0, 2.0, 3.0)).inflation) == 4
    assert noise.monitors[3] == InnovationNoise.starting(4.0).monitors[0]


def test_every_modality_learns_from_its_own_innovations() -> None:
    rng = np.random.default_rng(1)
    noise = _after([_report(float(u), 3.0 * float(v)) for u, v in rng.normal(size=(600, 2))])
    ranges, bearings, elevations = noise.inflation
    assert 1.0 <= ranges < 1.3
    assert bearings > 1.5
    assert elevations == pytest.approx(4.0)  # never measured


def test_one_that_repeats_itself_is_enough_to_be_no_longer_white() -> None:
    rng = np.random.default_rng(2)
    slow = np.sin(np.arange(300) / 20.0)
    noise = _after(
        [_report(float(u), float(s)) for u, s in zip(rng.normal(size=300), slow, strict=True)]
    )
    assert not noise.is_white
    health = noise.health((1.0, 1.0, 1.0), None)
    assert health.correlation[1] > 0.8
    assert health.correlation[2] == 0.0


def test_what_the_window_found_is_only_repeated() -> None:
    rng = np.random.default_rng(3)
    white = _after([_report(float(u)) for u in rng.normal(size=200)])
    assert white.is_white
    assert replace(white, found=(1.7, 1.0, 2.5)).inflation == (1.7, 1.0, 2.5)
    slow = _after([_report(math.sin(i / 20.0)) for i in range(300)])
    found = replace(slow, found=(1.7, 1.0, 2.5)).inflation
    assert found[0] > 10.0 * 1.7
    assert found[1:] == (1.0, 2.5)
    assert replace(slow, found=(300.0, 1.0, 1.0)).inflation[0] == MAX_INFLATION


def test_innovations_of_a_vague_state_say_nothing_of_noise() -> None:
    vague = _report(9.0, 9.0, prior_share=1.1 * MAX_PRIOR_SHARE)
    noise = _after([vague] * 50)
    assert noise.inflation == pytest.approx((4.0, 4.0, 4.0))
    assert noise.nlos_share == 0.0
    mixed = _after([_report(1.0), vague] * 50)
    assert mixed.is_white  # neighbours of neighbours do not count as neighbours


def test_ranges_on_the_linear_branch_are_taken_for_reflections() -> None:
    noise = _after([_report(4.0 if i % 4 else 0.3) for i in range(400)])
    assert noise.nlos_share == pytest.approx(0.75, abs=0.02)
    assert _after([_report(-4.0)] * 100).nlos_share == 0.0


def test_health_is_all_of_it() -> None:
    noise = _after([_report(3.0, 3.0)] * 100)
    health = noise.health((2.0, 3.0, 4.0), None)
    assert health.inflation == (2.0, 3.0, 4.0)
    assert health.nis == pytest.approx(9.0)
    assert health.is_overconfident
    assert health.nlos_share == 1.0
    assert health.observability is None
