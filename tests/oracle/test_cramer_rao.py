"""Fisher information of the true channel against formulas, sampling and finite differences."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from scipy.stats import exponnorm, norm

from companion.kernel import Matrix, Vector
from sim_link.world.environment import ChannelParams
from tools.study.case import (
    CHANNEL,
    TRUTH,
    Case,
    drawn,
    measured,
    stream,
    track_of,
    truth_of,
)
from tools.study.metrics import (
    ChannelInformation,
    channel_information,
    modified_normal,
    position_bounds_m2,
)

PAPER = ChannelParams()
TARGET = np.array([50.0, 50.0])


def _channel(**fields: float) -> ChannelParams:
    return msgspec.structs.replace(PAPER, **fields)


def test_without_nlos_it_is_the_gaussian_formula() -> None:
    information = channel_information(_channel(p_nlos=0.0))
    assert information.range_per_m2 == pytest.approx(1.0 / 1.5**2, rel=1e-12)
    assert information.bearing_per_rad2 == pytest.approx(1.0 / math.radians(2.0) ** 2, rel=1e-12)


def test_with_nlos_alone_bearings_are_gaussian_and_ranges_exponentially_modified() -> None:
    information = channel_information(_channel(p_nlos=1.0))
    spread = math.hypot(math.radians(2.0), math.radians(5.0))
    assert information.bearing_per_rad2 == pytest.approx(1.0 / spread**2, rel=1e-12)
    x, step = np.linspace(-15.0, 400.0, 400_001, retstep=True)
    density = exponnorm.pdf(x, 8.0 / 1.5, scale=1.5)
    slope = np.gradient(density, step)
    by_hand = np.sum(np.where(density > 1e-12, slope**2 / np.maximum(density, 1e-12), 0.0)) * step
    assert information.range_per_m2 == pytest.approx(by_hand, rel=1e-4)


@pytest.mark.parametrize("range_sigma_m", [0.5, 1.5, 2.5])
@pytest.mark.parametrize("mean_bias_m", [0.1, 2.0, 15.0])
def test_the_quadrature_has_converged(range_sigma_m: float, mean_bias_m: float) -> None:
    channel = _channel(range_sigma_m=range_sigma_m, range_bias_mean_m=mean_bias_m)
    usual, fine = channel_information(channel), channel_information(channel, 30)
    assert usual.range_per_m2 == pytest.approx(fine.range_per_m2, rel=1e-9)
    assert usual.bearing_per_rad2 == pytest.approx(fine.bearing_per_rad2, rel=1e-9)


@pytest.mark.parametrize("mean_bias_m", [0.0, 1e-4, 0.01, 8.0, 30.0])
def test_the_density_is_scipys_and_its_slope_the_finite_difference(mean_bias_m: float) -> None:
    x = np.linspace(-5.0, 40.0, 301)
    density, slope = modified_normal(x, 1.5, mean_bias_m)
    if mean_bias_m >= 0.01:
        expected = exponnorm.pdf(x, mean_bias_m / 1.5, scale=1.5)
        np.testing.assert_allclose(density, expected, rtol=1e-7, atol=1e-300)
    else:
        np.testing.assert_allclose(density, norm.pdf(x, scale=1.5), rtol=1e-2, atol=1e-12)
    h = 1e-5
    ahead, behind = (modified_normal(x + sign * h, 1.5, mean_bias_m)[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * h), rtol=1e-4, atol=1e-8)


def _log_density(a: Vector, b: Vector, p: float) -> Vector:
    """Return the log density of errors of the paper's channel, implemented a second time."""
    thermal, bent = math.radians(2.0), math.hypot(math.radians(2.0), math.radians(5.0))
    clear = norm.pdf(a, scale=1.5) * norm.pdf(b, scale=thermal)
    blocked = exponnorm.pdf(a, 8.0 / 1.5, scale=1.5) * norm.pdf(b, scale=bent)
    return np.asarray(np.log((1.0 - p) * clear + p * blocked))


def _errors(p: float, count: int) -> Matrix:
    """Errors of range and bearing as the simulated channel makes them, (count, 2)."""
    channel = _channel(p_nlos=p, range_offset_m=0.0, bearing_offset_deg=0.0)
    truth = truth_of(Case(channel=channel), stream(1, TRUTH))
    draws = drawn(stream(1, CHANNEL), count)
    seen = np.array([measured(draw, -950.0, 50.0, truth) for draw in draws])
    return seen - [1000.0, 0.0]


@pytest.mark.parametrize("p", [0.3, 0.9])
def test_it_is_the_mean_square_of_the_score_over_what_the_channel_does(p: float) -> None:
    a, b = _errors(p, 30_000).T
    h_a, h_b = 1e-4, 1e-6
    by_a = (_log_density(a + h_a, b, p) - _log_density(a - h_a, b, p)) / (2.0 * h_a)
    by_b = (_log_density(a, b + h_b, p) - _log_density(a, b - h_b, p)) / (2.0 * h_b)
    information = channel_information(_channel(p_nlos=p))
    assert np.mean(by_a**2) == pytest.approx(information.range_per_m2, rel=0.03)
    assert np.mean(by_b**2) == pytest.approx(information.bearing_per_rad2, rel=0.03)
    scale = math.sqrt(information.range_per_m2 * information.bearing_per_rad2)
    assert np.mean(by_a * by_b) == pytest.approx(0.0, abs=0.03 * scale)


def test_range_and_bearing_together_tell_more_than_each_alone_but_less_than_the_path() -> None:
    p = 0.5
    clear, blocked, mixed = (channel_information(_channel(p_nlos=q)) for q in (0.0, 1.0, p))
    separated = (1.0 - p) * clear.range_per_m2 + p * blocked.range_per_m2
    x, step = np.linspace(-15.0, 400.0, 200_001, retstep=True)
    alone = 0.5 * norm.pdf(x, scale=1.5) + 0.5 * exponnorm.pdf(x, 8.0 / 1.5, scale=1.5)
    slope = np.gradient(alone, step)
    marginal = np.sum(np.where(alone > 1e-12, slope**2 / np.maximum(alone, 1e-12), 0.0)) * step
    assert marginal < mixed.range_per_m2 < separated


@pytest.mark.parametrize("field", ["range_sigma_m", "bearing_sigma_deg"])
def test_a_channel_without_noise_has_no_bound(field: str) -> None:
    with pytest.raises(ValueError, match="noise"):
        channel_information(_channel(**{field: 0.0}))


def _bounds(
    track: Matrix, information: ChannelInformation, offset_sigmas: Vector | None = None
) -> Vector:
    prior = np.zeros(2) if offset_sigmas is None else 1.0 / offset_sigmas**2
    by_range = np.full(len(track), information.range_per_m2)
    by_bearing = np.full(len(track), information.bearing_per_rad2)
    return position_bounds_m2(track, TARGET, by_range, by_bearing, prior)


def _information(track: Matrix, range_per_m2: float, bearing_per_rad2: float) -> Matrix:
    """Return a track's information on position and offsets, (4, 4), by finite differences."""

    def expected(x: Vector) -> Vector:
        de, dn = x[0] - track[:, 0], x[1] - track[:, 1]
        return np.concatenate([np.hypot(de, dn) + x[2], np.unwrap(np.arctan2(dn, de)) + x[3]])

    x, h = np.array([*TARGET, 1.5, 0.1]), 1e-5
    slopes = [(expected(x + h * axis) - expected(x - h * axis)) / (2.0 * h) for axis in np.eye(4)]
    H = np.stack(slopes, axis=1)
    weights = np.repeat([range_per_m2, bearing_per_rad2], len(track))
    return np.asarray(H.T @ (weights[:, None] * H))


def test_the_bound_is_the_trace_of_the_inverses_position_block() -> None:
    track = track_of(Case())
    information = channel_information(PAPER)
    bound = _bounds(track, information)
    for step in (20, 100, 499):
        total = _information(
            track[: step + 1], information.range_per_m2, information.bearing_per_rad2
        )
        assert bound[step] == pytest.approx(np.trace(np.linalg.inv(total)[:2, :2]), rel=1e-4)
    assert np.isinf(bound[0])
    assert (np.diff(bound[20:]) <= 0.0).all()


def test_at_the_target_only_the_offsets_are_seen() -> None:
    information = channel_information(PAPER)
    seen = (information.range_per_m2, information.bearing_per_rad2)
    before = track_of(Case())[:60]
    total = _information(before, *seen) + np.diag([0.0, 0.0, *seen])
    bound = _bounds(np.vstack([before, TARGET]), information)
    assert bound[-1] == pytest.approx(np.trace(np.linalg.inv(total)[:2, :2]), rel=1e-4)


def test_priors_of_the_offsets_help() -> None:
    track, information = track_of(Case()), channel_information(PAPER)
    unknown = _bounds(track, information)
    drawn_anew = _bounds(track, information, np.array([5.0, math.radians(5.0)]))
    known = _bounds(track, information, np.array([1e-6, 1e-8]))
    assert (known[5:] < drawn_anew[5:]).all()
    assert (drawn_anew[5:] < unknown[5:]).all()


def test_known_offsets_leave_the_gaussian_triangle() -> None:
    """Two views at right angles: each coordinate is known by one range and one bearing."""
    channel = _channel(p_nlos=0.0)
    track = np.array([[0.0, 50.0], [50.0, 0.0]])
    bound = _bounds(track, channel_information(channel), np.array([1e-9, 1e-12]))[-1]
    per_axis = 1.0 / 1.5**2 + 1.0 / (50.0 * math.radians(2.0)) ** 2
    assert bound == pytest.approx(2.0 / per_axis, rel=1e-6)


@pytest.mark.parametrize("p_nlos", [0.3, 0.9])
def test_draws_of_their_own_tell_less_than_a_shared_one(p_nlos: float) -> None:
    channel = _channel(p_nlos=p_nlos)
    joint = channel_information(channel)
    separate = channel_information(channel, is_joint=False)
    assert separate.range_per_m2 < joint.range_per_m2
    assert separate.bearing_per_rad2 < joint.bearing_per_rad2
    rng, h = np.random.default_rng(8), 1e-4
    is_long = rng.random(200_000) < p_nlos
    errors_m = 1.5 * rng.standard_normal(200_000) + is_long * rng.exponential(8.0, 200_000)

    def log_density(a: Vector) -> Vector:
        long = exponnorm.pdf(a, 8.0 / 1.5, scale=1.5)
        return np.asarray(np.log((1.0 - p_nlos) * norm.pdf(a, scale=1.5) + p_nlos * long))

    score = (log_density(errors_m + h) - log_density(errors_m - h)) / (2.0 * h)
    assert np.mean(score**2) == pytest.approx(separate.range_per_m2, rel=0.02)


def test_without_nlos_it_does_not_matter_who_draws() -> None:
    channel = _channel(p_nlos=0.0)
    joint, separate = (channel_information(channel, is_joint=flag) for flag in (True, False))
    assert separate.range_per_m2 == pytest.approx(joint.range_per_m2, rel=1e-9)
    assert separate.bearing_per_rad2 == pytest.approx(joint.bearing_per_rad2, rel=1e-9)
