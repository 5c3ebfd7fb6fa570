"""Spatially correlated errors: how many votes measurements are worth, and the stated R95."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config.schema import load_config
from companion.domain import EstimateState
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.window.map_kernels import clipped
from companion.estimation.window.spatial_noise import (
    SpatialPrior,
    cells_of,
    clipped_deviation,
    fit_spatial_noise,
)
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector
from tests.unit.companion.estimation.walks import START, params, walk
from tests.unit.companion.estimation.window.correlated_walks import CorrelatedCase, walks_of
from tools.study.walks.walk_figures import CONFIGS, TargetClaims, replayed

WIFI = load_config(CONFIGS / "wifi_rtt.yaml").tracking
COUNT = 300
LINE = np.stack([np.linspace(0.0, 150.0, COUNT), np.zeros(COUNT)], axis=1)
OFFSET_ALONE, NO_PRIOR = np.ones((COUNT, 1)), np.zeros((1, 1))


def field(rng: np.random.Generator, length_m: float) -> Vector:
    """Return a unit field at the positions of `LINE`, (n,)."""
    apart = np.abs(LINE[:, :1] - LINE[:, 0])
    covariance = np.exp(-apart / length_m) + 1e-9 * np.eye(COUNT)
    return np.asarray(np.linalg.cholesky(covariance) @ rng.normal(size=COUNT))


def repetition(psi: Vector, belief: SpatialPrior, positions: Matrix = LINE) -> float:
    return fit_spatial_noise(positions, psi, OFFSET_ALONE, 1.0, NO_PRIOR, belief).repetition


def test_white_errors_are_a_vote_each() -> None:
    unknown = SpatialPrior(1.0, 4.0, is_of_radio=False)
    found = [repetition(np.random.default_rng(s).normal(size=COUNT), unknown) for s in range(10)]
    assert float(np.median(found)) < 3.0


@pytest.mark.parametrize("length_m", [2.0, 6.0])
def test_votes_are_those_of_the_field_that_was_drawn(length_m: float) -> None:
    """2 l over the spacing of the measurements, or more: a walk says little of a longer reach."""
    unknown = SpatialPrior(1.0, 4.0, is_of_radio=False)
    drawn = [field(np.random.default_rng(s), length_m) for s in range(20)]
    found = [repetition(psi - psi.mean(), unknown) for psi in drawn]
    expected = 2.0 * length_m / 0.5
    assert 0.7 * expected < float(np.median(found)) < 4.0 * expected


@pytest.mark.parametrize(("k_long", "k_short"), [(0.5, 0.5), (0.3, 3.0), (1.0, np.inf)])
@pytest.mark.parametrize("deviation", [0.4, 1.4, 4.0])
def test_a_field_is_clipped_as_the_loss_clips_it(
    deviation: float, k_long: float, k_short: float
) -> None:
    """Two measurements at one position have the field in common, and each its own noise."""
    rng = np.random.default_rng(3)
    residuals = deviation * rng.normal(size=200_000) + rng.normal(size=(2, 200_000))
    one, other = clipped(residuals, np.array([[k_long, k_short]] * 2))
    found = float(np.cov(one, other)[0, 1]) ** 0.5
    assert clipped_deviation(deviation, k_long, k_short) == pytest.approx(found, rel=0.03)


def test_without_clipping_a_field_is_as_it_is() -> None:
    assert clipped_deviation(1.4, np.inf, np.inf) == pytest.approx(1.4)


def test_a_short_walk_leaves_what_is_known_of_the_radio() -> None:
    """Residuals look white, because the offset has swallowed what the field was."""
    near = LINE * (1.0 / 150.0)
    white = 0.05 * np.random.default_rng(1).normal(size=COUNT)
    assert repetition(white, SpatialPrior(1.0, 20.0), near) > 50.0


def test_who_hovers_gets_nowhere() -> None:
    jitter = 0.05 * np.random.default_rng(2).normal(size=(COUNT, 2))
    index, way_m = cells_of(jitter, 0.5)
    assert index.tolist() == [0] * COUNT
    assert way_m.tolist() == [0.0]


def test_votes_decide_between_the_data_and_what_is_known_of_the_offset() -> None:
    """Ranges from a few positions do not outvote the prior of the offset, however many they are."""
    rows = walk(np.random.default_rng(3), 400, bearings=False)
    configured = params(range_offset_m=1.0, range_offset_sigma_m=0.3)
    correlated = params(range_offset_m=1.0, range_offset_sigma_m=0.3, place_range_sigma_m=1.0)
    alone_m, voted_m = (
        float(WindowMap(believed).optima(rows, [START])[0].mean[2])
        for believed in (configured, correlated)
    )
    assert alone_m > 1.8
    assert voted_m < alone_m - 0.1


def test_ranges_of_one_step_are_few_votes() -> None:
    """Four hundred ranges of a walk through two or three steps."""
    rows = walk(np.random.default_rng(3), 400, bearings=False)
    rows[:, 3] = (rows[:, 3] // 20.0 + 0.5) * 20.0
    rows[:, 6] = 20.0 / np.sqrt(12.0)
    repetitions = []
    for step_m in (0.0, 20.0):
        window = WindowMap(params(range_offset_sigma_m=20.0, range_step_m=step_m))
        assert window.optima(rows, [START])
        noise = window.spatial_noise[0]
        repetitions.append(1.0 if noise is None else noise.repetition)
    assert repetitions[0] == 1.0
    assert repetitions[1] > 20.0


def test_an_offset_is_believed_to_be_where_its_prior_is() -> None:
    rows = walk(np.random.default_rng(4), count=20)
    sure = params(range_offset_m=5.0, range_offset_sigma_m=1e-3)
    assert WindowMap(sure).optima(rows, [START])[0].mean[2] == pytest.approx(5.0, abs=0.01)


def test_a_scale_may_be_bounded_below_alone() -> None:
    scaled = FilterParams(range_scale_sigma=0.1, range_scale_max=0.4, range_scale_min=0.0)
    assert scaled.bounds[:, 4].tolist() == [0.0, 0.4]


def test_parallel_bearings_name_a_place_within_reach() -> None:
    rows = walk(np.random.default_rng(5), 60, ranges=False, straight=True)
    rows[:, 4] = 0.5 * np.pi
    far = WindowMap(params()).optima(rows, [START])
    believed = params(reach_m=20.0, place_bearing_sigma_deg=5.0)
    near = WindowMap(believed).optima(rows, [START])
    assert not far or abs(far[0].mean[1]) > 200.0
    assert len(near) == 1
    assert abs(near[0].mean[1]) < 200.0


def test_bearings_are_fused_where_only_ranges_are_known_to_keep_errors_in_places() -> None:
    rows = walk(np.random.default_rng(6), 60, ranges=False)
    assert WindowMap(params(place_range_sigma_m=0.5)).optima(rows, [START])


def claims(path: str, length_m: float, seeds: range) -> list[TargetClaims]:
    """Return the claims on invented walks."""
    case = CorrelatedCase(path, length_m)  # type: ignore[arg-type]
    return [replayed(path, rows, WIFI) for rows in walks_of(case, seeds)]


@pytest.mark.slow
def test_a_straight_walk_is_never_claimed_on_one_side_alone() -> None:
    along = [claim for target in claims("straight", 6.0, range(4)) for claim in target.along]
    assert all(claim.is_stated for claim in along if claim.state is EstimateState.AMBIGUOUS)
    assert all(claim.is_inside for claim in along if claim.is_localised)
    assert any(claim.state is EstimateState.AMBIGUOUS for claim in along)


@pytest.mark.slow
@pytest.mark.parametrize("length_m", [2.0, 6.0, 20.0])
def test_what_is_claimed_of_places_with_their_own_errors_holds(length_m: float) -> None:
    found = [t for path in ("corner", "circle") for t in claims(path, length_m, range(10))]
    localised = [claim for t in found for claim in t.along if claim.is_localised]
    assert len(localised) >= 40
    assert sum(claim.is_inside for claim in localised) >= 0.93 * len(localised)
