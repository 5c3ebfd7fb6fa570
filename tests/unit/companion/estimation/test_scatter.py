"""Scatter of successive measurements limits the standard deviations that a radio reports."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.integrity import ReportedSigmas, Scatter
from companion.estimation.tracker import TargetTracker
from companion.estimation.tracker_params import TrackerParams
from companion.estimation.window.sandwich import MIN_MEASUREMENTS
from tests.unit.companion.estimation.tracker_helpers import (
    bearing_to,
    estimate_of,
    leg,
    measured,
    range_to,
)

TARGET = (50.0, 50.0)


def test_scatter_of_a_moving_vehicle_is_the_noise_even_where_messages_are_lost() -> None:
    rng, scatter = np.random.default_rng(1), Scatter()
    for step in range(80):
        if rng.random() < 0.8:
            scatter.add(0.1 * step, 90.0 - 0.8 * step + rng.normal(0.0, 0.3))
    assert scatter.sigma == pytest.approx(0.3, rel=0.25)


def test_a_tenth_of_forged_values_hardly_moves_it() -> None:
    rng, scatter = np.random.default_rng(2), Scatter()
    for step in range(80):
        is_forged = rng.random() < 0.1
        scatter.add(0.1 * step, 300.0 if is_forged else rng.normal(50.0, 0.3))
    assert scatter.sigma == pytest.approx(0.3, rel=0.6)


def test_a_direction_through_south_is_no_scatter() -> None:
    scatter = Scatter(is_angle=True)
    for step in range(40):
        scatter.add(0.1 * step, math.remainder(3.0 + 0.01 * step, math.tau))
    assert scatter.sigma == pytest.approx(0.0, abs=1e-9)


def test_few_values_gaps_and_repetitions_show_nothing() -> None:
    few, gaps, repeated = Scatter(), Scatter(), Scatter()
    for step in range(MIN_MEASUREMENTS + 1):
        few.add(0.1 * step, float(step % 2))
    for step in range(99):
        gaps.add(1.5 * step, float(step % 2))
        repeated.add(7.0, float(step % 2))
    assert (few.sigma, gaps.sigma, repeated.sigma) == (None, None, None)
    few.add(9.0, 0.0)  # too late to be compared, and after a gap
    assert few.sigma is None


@pytest.mark.parametrize(
    ("noise_m", "configured_m", "least_m"), [(0.2, None, 0.2), (9.0, None, 1.5), (0.2, 0.7, 0.7)]
)
def test_what_is_configured_goes_before_scatter_and_scatter_before_what_is_assumed(
    noise_m: float, configured_m: float | None, least_m: float
) -> None:
    rng, sigmas = np.random.default_rng(3), ReportedSigmas()
    params = FilterParams(range_sigma_m=1.5)
    for step in range(80):
        seen = RangingMeasurement(
            emitter_id=1,
            measured_at_s=0.1 * step,
            range_m=50.0 + float(rng.normal(0.0, noise_m)),
            range_sigma_m=1e-6,
            least_sigmas=(configured_m, None, None),
        )
        limited = sigmas.limited(seen, params)
    assert limited.least_sigmas[0] == pytest.approx(least_m, rel=0.3)
    assert limited.least_sigmas[1:] == params.configured_sigmas[1:]
    assert params.effective_sigmas(limited)[0] == limited.least_sigmas[0]


def crossed(claimed_m: float, kind: AntennaKind = "auto") -> TargetTracker:
    """Return the tracker of a crossing by ranges with a noise of 0.3 m that claim this one."""
    rng = np.random.default_rng(4)
    antenna = AntennaParams(kind=kind)
    tracker = TargetTracker(TrackerParams(filter=FilterParams(antenna=antenna)))
    legs = ((0.0, -10.0), (70.0, 80.0)), ((90.0, 40.0), (0.0, 60.0))
    positions = [position for begin, end in legs for position in leg(begin, end, 100)]
    for step, position in enumerate(positions):
        range_m = range_to(position, TARGET) + float(rng.normal(0.0, 0.3))
        bearing_rad = bearing_to(position, TARGET) + float(rng.normal(0.0, 0.05))
        seen = replace(measured(0.2 * step, range_m, bearing_rad), range_sigma_m=claimed_m)
        tracker.fuse(seen, position, seen.measured_at_s)
    return tracker


def test_an_unknown_radio_is_as_sharp_as_its_scatter_whatever_it_claims() -> None:
    honest, boastful = estimate_of(crossed(0.3)), estimate_of(crossed(1e-6))
    assert boastful.r95_m == pytest.approx(honest.r95_m, rel=0.15)
    assert math.dist(boastful.position_enu_m[:2], TARGET) < boastful.r95_m


@pytest.mark.parametrize(("kind", "sigma_m"), [("auto", 0.3), ("azimuth", 1.5)])
def test_a_configured_antenna_means_that_the_sigmas_are_configured(
    kind: AntennaKind, sigma_m: float
) -> None:
    sigmas = crossed(0.01, kind).latest_sigmas
    assert sigmas is not None
    assert sigmas[0] == pytest.approx(sigma_m, rel=0.3)
