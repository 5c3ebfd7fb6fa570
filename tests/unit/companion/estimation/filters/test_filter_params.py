"""Parameters of a filter, and the form in which its kernels take them."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from companion.domain import MAX_SETTING, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.measurement_model import ABSENT
from companion.estimation.window.map_kernels import SEQUENCE, SIGMAS, VALUES

HERE = (0.0, 0.0, 20.0)
EVERYTHING = RangingMeasurement(
    emitter_id=1,
    measured_at_s=0.0,
    range_m=50.0,
    range_sigma_m=0.7,
    bearing_enu_rad=0.4,
    bearing_sigma_rad=0.02,
    elevation_rad=-0.3,
    elevation_sigma_rad=0.05,
)
SHARP = FilterParams(range_sigma_m=0.5, bearing_sigma_deg=1.0, elevation_sigma_deg=2.0)
"""Parameters of a radio that is as accurate as it reports."""


@pytest.mark.parametrize(
    ("scale_sigma", "height_sigma_m", "size", "scale_index", "height_index"),
    [
        (0.0, 0.0, 4, ABSENT, ABSENT),
        (0.05, 0.0, 5, 4, ABSENT),
        (0.0, 3.0, 5, ABSENT, 4),
        (0.05, 3.0, 6, 4, 5),
    ],
)
def test_the_state_has_a_place_for_all_that_is_not_known(
    scale_sigma: float, height_sigma_m: float, size: int, scale_index: int, height_index: int
) -> None:
    params = FilterParams(
        range_scale_sigma=scale_sigma, target_height_sigma_m=height_sigma_m, target_height_m=7.0
    )
    mean, sigmas = params.prior
    assert mean.shape == sigmas.shape == (size,)
    assert params.bounds.shape == (2, size)
    assert (params.model.scale_index, params.model.height_index) == (scale_index, height_index)
    assert sigmas[:4].tolist() == [30.0, 30.0, 5.0, math.radians(5.0)]
    assert mean[:4].tolist() == [0.0, 0.0, 0.0, 0.0]
    if scale_sigma:
        assert (mean[scale_index], sigmas[scale_index]) == (0.0, scale_sigma)
    if height_sigma_m:
        assert (mean[height_index], sigmas[height_index]) == (7.0, height_sigma_m)
    assert params.model.height_m == 7.0


def test_without_bounds_there_are_none() -> None:
    for params in (FilterParams(), FilterParams(target_height_sigma_m=1.0)):
        assert np.isneginf(params.bounds[0]).all()
        assert np.isposinf(params.bounds[1]).all()


def test_every_bound_has_its_place() -> None:
    params = FilterParams(
        range_offset_min_m=-1.0,
        range_offset_max_m=3.0,
        bearing_offset_max_deg=10.0,
        range_scale_sigma=0.05,
        range_scale_max=0.2,
        target_height_sigma_m=1.0,
    )
    ten_deg = math.radians(10.0)
    assert params.bounds[0].tolist() == [-math.inf, -math.inf, -1.0, -ten_deg, -0.2, -math.inf]
    assert params.bounds[1].tolist() == [math.inf, math.inf, 3.0, ten_deg, 0.2, math.inf]


@pytest.mark.parametrize(
    ("low", "high", "offset_m"),
    [(None, None, 0.0), (0.0, 3.0, 0.0), (1.0, None, 1.0), (None, -2.0, -2.0), (-1.0, 1.0, 0.0)],
)
def test_the_first_offset_is_the_likeliest_one_within_bounds(
    low: float | None, high: float | None, offset_m: float
) -> None:
    params = FilterParams(range_offset_min_m=low, range_offset_max_m=high)
    assert params.prior[0][2] == offset_m


@pytest.mark.parametrize(("low", "high"), [(3.0, 3.0), (4.0, 3.0)])
def test_bounds_that_leave_nothing_are_refused(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="range_offset_min_m"):
        FilterParams(range_offset_min_m=low, range_offset_max_m=high)


@pytest.mark.parametrize(
    "wrong",
    [
        {"range_sigma_m": 0.0},
        {"range_k_long": 0.0},
        {"range_scale_max": 1.0},
        {"bearing_offset_max_deg": 181.0},
        {"target_height_sigma_m": -1.0},
        {"range_offset_min_m": 2.0, "range_offset_max_m": 1.0},
        {"no_such_key": 1.0},
    ],
)
def test_what_makes_no_sense_is_refused_where_it_is_read(wrong: dict[str, float]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, FilterParams)


def test_no_threshold_is_an_infinite_one() -> None:
    assert FilterParams().thresholds.tolist() == [[1.5, math.inf], [1.5, 1.5], [1.5, 1.5]]
    plain = FilterParams(range_k_long=None, bearing_k=None)
    assert np.isinf(plain.thresholds).all()
    assert FilterParams(range_k_short=3.0).thresholds[0].tolist() == [1.5, 3.0]


def test_a_measurement_is_values_and_standard_deviations() -> None:
    row = SHARP.kernel_row(EVERYTHING, HERE)
    assert row[VALUES:SIGMAS].tolist() == [50.0, 0.4, -0.3]
    assert row[SIGMAS:SEQUENCE].tolist() == [0.7, 0.02, 0.05]


def test_what_is_not_reported_or_not_trusted_is_as_configured() -> None:
    own = [1.5, math.radians(2.0), math.radians(5.0)]
    deaf = FilterParams(use_reported_sigma=False)
    assert deaf.kernel_row(EVERYTHING, HERE)[SIGMAS:SEQUENCE].tolist() == own
    silent = RangingMeasurement(emitter_id=1, measured_at_s=0.0, range_m=50.0)
    row = FilterParams().kernel_row(silent, HERE)
    assert row[SIGMAS:SEQUENCE].tolist() == own
    assert row[VALUES] == 50.0
    assert np.isnan(row[VALUES + 1 : SIGMAS]).all()


def test_no_range_is_better_than_its_steps() -> None:
    cell = msgspec.structs.replace(SHARP, range_step_m=78.0, place_length_m=4.0)
    least_m = 78.0 / math.sqrt(12.0)
    row = cell.kernel_row(EVERYTHING, HERE)
    assert row[SIGMAS:SEQUENCE].tolist() == [least_m, 0.02, 0.05]
    assert cell.spatial_sigmas == pytest.approx((least_m, 0.0))
    assert cell.range_length_m == 39.0
    worse = FilterParams(range_step_m=78.0, range_sigma_m=30.0, use_reported_sigma=False)
    assert worse.kernel_row(EVERYTHING, HERE)[SIGMAS] == 30.0


def test_an_elevation_may_be_left_out() -> None:
    row = FilterParams(use_elevation=False).kernel_row(EVERYTHING, HERE)
    assert np.isnan(row[VALUES + 2])
    assert row[VALUES : VALUES + 2].tolist() == [50.0, 0.4]


@pytest.mark.parametrize(
    ("reported", "counted"),
    [(1e-300, 1.5), (1e-6, 1.5), (1.4, 1.5), (3.0, 3.0), (1e300, MAX_SETTING)],
)
def test_a_reported_sigma_counts_as_the_configured_one_at_least(
    reported: float, counted: float
) -> None:
    seen = RangingMeasurement(emitter_id=1, measured_at_s=0.0, range_m=50.0, range_sigma_m=reported)
    assert FilterParams().effective_sigmas(seen)[0] == counted


def test_directions_have_the_same_floor_and_are_off_by_half_a_turn_at_most() -> None:
    for reported, counted in ((1e-9, (2.0, 5.0)), (0.2, (math.degrees(0.2),) * 2), (1e30, None)):
        seen = replace(EVERYTHING, bearing_sigma_rad=reported, elevation_sigma_rad=reported)
        sigmas = FilterParams().effective_sigmas(seen)[1:]
        assert sigmas == pytest.approx([math.radians(v) for v in counted or (180.0, 180.0)])


def test_a_float32_of_the_configured_sigma_is_the_configured_sigma() -> None:
    reported = float(np.float32(math.radians(2.0)))
    seen = replace(EVERYTHING, bearing_sigma_rad=reported)
    assert FilterParams().effective_sigmas(seen)[1] == reported


def test_a_radio_that_is_configured_as_better_than_the_estimation_has_its_own_floor() -> None:
    seen = replace(EVERYTHING, range_sigma_m=1e-6, least_sigmas=(0.1, None, None))
    assert FilterParams().effective_sigmas(seen)[0] == 0.1
