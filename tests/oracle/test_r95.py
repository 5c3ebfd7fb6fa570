"""R95 against quadrature and against drawn points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, norm

from companion.estimation.target_estimate import (
    r95_of_covariance_m,
    r95_of_mixture_m,
)
from companion.kernel import Matrix, Vector

Component = tuple[float, Vector, Matrix]


def _covariance(sigma_a_m: float, sigma_b_m: float, turn_rad: float) -> Matrix:
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    axes = np.array([[c, -s], [s, c]])
    turned: Matrix = axes @ np.diag([sigma_a_m**2, sigma_b_m**2]) @ axes.T
    return turned


def _probability_within(radius_m: float, sigma_a_m: float, sigma_b_m: float) -> float:
    """Return the probability of a Gaussian within a radius, by slices along the longer axis."""

    def slice_of(a: float) -> float:
        half = math.sqrt(max(radius_m**2 - a * a, 0.0))
        across = 1.0 if sigma_b_m == 0.0 else 2.0 * float(norm.cdf(half / sigma_b_m)) - 1.0
        return across * float(norm.pdf(a / sigma_a_m)) / sigma_a_m

    inside, _ = quad(slice_of, -radius_m, radius_m, points=[0.0], epsabs=1e-10, limit=200)
    return float(inside)


def test_equal_axes_are_chi_square() -> None:
    of_equal_axes = math.sqrt(chi2.ppf(0.95, 2))
    assert r95_of_covariance_m(np.eye(2) * 9.0) == pytest.approx(3.0 * of_equal_axes, rel=1e-9)


@pytest.mark.parametrize("ratio", [1.0, 0.8, 0.5, 0.3, 0.15, 0.1, 0.065])
@pytest.mark.parametrize("turn_rad", [0.0, 0.7, -2.0])
def test_r95_holds_95_percent_by_quadrature(ratio: float, turn_rad: float) -> None:
    radius_m = r95_of_covariance_m(_covariance(5.0, 5.0 * ratio, turn_rad))
    assert _probability_within(radius_m, 5.0, 5.0 * ratio) == pytest.approx(0.95, abs=1e-6)


@pytest.mark.parametrize("ratio", [0.05, 0.01, 1e-4, 0.0])
def test_r95_of_a_needle_is_on_the_safe_side_by_less_than_a_thousandth(ratio: float) -> None:
    radius_m = r95_of_covariance_m(_covariance(5.0, 5.0 * ratio, 0.3))
    needle_m = 5.0 * float(norm.ppf(0.975))
    assert needle_m <= radius_m <= needle_m * 1.0011
    assert _probability_within(radius_m, 5.0, 5.0 * ratio) >= 0.95 - 1e-6


def test_r95_of_nothing_is_zero() -> None:
    assert r95_of_covariance_m(np.zeros((2, 2))) == 0.0


MIXTURES: dict[str, list[Component]] = {
    "one round": [(1.0, np.zeros(2), np.eye(2))],
    "one needle": [(1.0, np.zeros(2), _covariance(3.0, 0.1, 0.4))],
    "mirror images": [
        (0.6, np.zeros(2), np.eye(2)),
        (0.4, np.array([0.0, 40.0]), _covariance(3.0, 1.0, 0.2)),
    ],
    "an unlikely alternative": [
        (0.97, np.zeros(2), np.eye(2)),
        (0.03, np.array([50.0, 0.0]), np.eye(2) * 4.0),
    ],
    "overlapping": [
        (0.7, np.zeros(2), _covariance(2.0, 1.0, 0.0)),
        (0.3, np.array([3.0, 0.0]), np.eye(2)),
    ],
    "a ring": [
        (1.0 / 12.0, 30.0 * np.array([math.cos(a), math.sin(a)]), _covariance(5.0, 8.0, a))
        for a in np.arange(12) * math.pi / 6.0
    ],
}


@pytest.mark.parametrize("name", MIXTURES)
def test_r95_of_a_mixture_holds_95_percent_of_drawn_points(name: str) -> None:
    components = MIXTURES[name]
    centre = components[0][1]
    rng = np.random.default_rng(95)
    chosen = rng.choice(len(components), p=[c[0] for c in components], size=200_000)
    drawn = np.empty((chosen.size, 2))
    for index, (_, mean, covariance) in enumerate(components):
        mask = chosen == index
        drawn[mask] = rng.multivariate_normal(mean, covariance, size=int(mask.sum()))
    radius_m = r95_of_mixture_m(centre, components)
    inside = float(np.mean(np.hypot(*(drawn - centre).T) <= radius_m))
    assert inside == pytest.approx(0.95, abs=0.002)  # four standard errors of the drawn share


def test_a_mixture_of_one_is_its_component() -> None:
    covariance = _covariance(4.0, 1.5, 1.0)
    mixture_m = r95_of_mixture_m(np.zeros(2), [(1.0, np.zeros(2), covariance)])
    assert mixture_m == pytest.approx(r95_of_covariance_m(covariance), rel=0.005)
