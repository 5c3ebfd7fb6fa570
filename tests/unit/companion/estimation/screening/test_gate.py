"""The gate refuses short ranges and false bearings, but no effect of reflections."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import (
    NO_INFLATION,
    FilterState,
    ModalityReport,
    UpdateReport,
)
from companion.estimation.innovations import GATE_SIGMAS, LONG_SIGMAS, OPEN, Gate
from companion.estimation.measurement_model import AZIMUTH, COSINES

STATE = FilterState.of(0.0, np.zeros(4), np.eye(4))
BOTH = RangingMeasurement(1, 0.0, range_m=50.0, bearing_enu_rad=0.3)


def _row(sigmas: float, prior_share: float = 0.0) -> ModalityReport:
    return ModalityReport(2.0 * sigmas, 1.0, 2.0, sigmas, 1.0, prior_share)


def _gate(ranged: float | None, borne: float | None, inflation: float = 1.0) -> Gate:
    rows = [None if u is None else _row(u) for u in (ranged, borne)]
    report = UpdateReport(STATE, (rows[0], rows[1], None), 0.0, True)
    return Gate.of(report, (inflation, inflation, 1.0))


def test_what_fits_passes_and_agrees() -> None:
    assert _gate(0.5, -1.0) == OPEN
    assert _gate(None, None) == OPEN


@pytest.mark.parametrize(
    ("ranged", "borne", "passes_range", "passes_bearing", "agrees"),
    [
        (-0.99 * GATE_SIGMAS, 0.99 * GATE_SIGMAS, True, True, True),
        (-1.01 * GATE_SIGMAS, 0.0, False, True, False),
        (0.0, 1.01 * GATE_SIGMAS, True, False, False),
        (0.0, -1.01 * GATE_SIGMAS, True, False, False),
        (0.99 * LONG_SIGMAS, 0.0, True, True, True),
        (1.01 * LONG_SIGMAS, 0.0, True, True, False),
    ],
)
def test_the_gate_is_where_it_says(
    ranged: float, borne: float, passes_range: bool, passes_bearing: bool, agrees: bool
) -> None:
    gate = _gate(ranged, borne)
    assert gate.passes_range is passes_range
    assert gate.passes_bearing is passes_bearing
    assert gate.agrees is agrees


def test_either_cosine_that_is_off_is_a_direction_that_is() -> None:
    """An elevation of its own is none: it stays, weighed by its loss."""
    for first, second in ((0.0, 1.01 * GATE_SIGMAS), (-1.01 * GATE_SIGMAS, 0.0)):
        report = UpdateReport(STATE, (None, _row(first), _row(second)), 0.0, True)
        assert not Gate.of(report, NO_INFLATION, COSINES).passes_bearing
        assert Gate.of(report, NO_INFLATION, AZIMUTH).passes_bearing is (first == 0.0)


def test_noise_that_the_run_has_shown_and_a_vague_state_widen_it() -> None:
    assert not _gate(-7.0, 0.0).passes_range
    assert _gate(-7.0, 0.0, inflation=1.5).passes_range
    vague = UpdateReport(STATE, (_row(-50.0, prior_share=100.0), None, None), 0.0, True)
    assert Gate.of(vague, NO_INFLATION).passes_range


def test_what_any_likely_hypothesis_explains_is_no_outlier() -> None:
    short, aside = _gate(-20.0, 0.0), _gate(0.0, 20.0)
    assert short.joined(aside) == OPEN
    assert short.joined(short) == short


def test_only_what_does_not_pass_is_taken_out() -> None:
    assert OPEN.passed(BOTH) is BOTH
    short, aside = _gate(-20.0, 0.0).passed(BOTH), _gate(0.0, math.pi * 20).passed(BOTH)
    assert short is not None
    assert (short.range_m, short.bearing_enu_rad) == (None, 0.3)
    assert aside is not None
    assert (aside.range_m, aside.bearing_enu_rad) == (50.0, None)
    assert _gate(-20.0, 20.0).passed(BOTH) is None


def test_an_estimate_that_is_not_proven_keeps_nothing_out_but_disagrees() -> None:
    gate = _gate(-20.0, 20.0).unarmed()
    assert gate.passed(BOTH) is BOTH
    assert not gate.agrees
