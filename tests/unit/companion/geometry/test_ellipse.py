"""Confidence ellipses: they hold what they claim, whatever their direction."""

import math

import numpy as np
import pytest

from companion.geometry.polygons import Covariance, ellipse_95


def as_tuples(covariance: np.ndarray) -> Covariance:
    (a, b), (c, d) = covariance.tolist()
    return ((a, b), (c, d))


@pytest.mark.parametrize("turn_rad", [0.0, 0.4, math.pi / 2, 2.5])
def test_axes_and_direction_are_those_of_the_covariance(turn_rad: float) -> None:
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    rotation = np.array([[c, -s], [s, c]])
    covariance = rotation @ np.diag([9.0, 1.0]) @ rotation.T
    ellipse = ellipse_95((5.0, -2.0), as_tuples(covariance))
    assert ellipse.semi_major_m == pytest.approx(3.0 * math.sqrt(5.991465), rel=1e-6)
    assert ellipse.semi_minor_m == pytest.approx(1.0 * math.sqrt(5.991465), rel=1e-6)
    assert math.sin(ellipse.major_enu_rad - turn_rad) == pytest.approx(0.0, abs=1e-9)


def test_it_holds_95_of_100_samples() -> None:
    covariance = np.array([[4.0, 1.5], [1.5, 2.0]])
    samples = np.random.default_rng(1).multivariate_normal([1.0, 2.0], covariance, 100_000)
    ellipse = ellipse_95((1.0, 2.0), as_tuples(covariance))
    c, s = math.cos(ellipse.major_enu_rad), math.sin(ellipse.major_enu_rad)
    along = (samples - [1.0, 2.0]) @ np.array([c, s])
    across = (samples - [1.0, 2.0]) @ np.array([-s, c])
    inside = (along / ellipse.semi_major_m) ** 2 + (across / ellipse.semi_minor_m) ** 2 <= 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.003)


def test_corners_lie_on_the_border_and_turn_to_the_left() -> None:
    ellipse = ellipse_95((0.0, 0.0), ((4.0, 1.0), (1.0, 2.0)))
    corners = np.array(ellipse.corners_enu_m(36))
    information = np.linalg.inv([[4.0, 1.0], [1.0, 2.0]])
    distances = np.einsum("ni,ij,nj->n", corners, information, corners)
    assert distances == pytest.approx(np.full(36, 5.991465), rel=1e-6)
    following = np.roll(corners, -1, axis=0)
    assert np.all(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0] > 0.0)


def test_a_flat_covariance_is_a_line() -> None:
    ellipse = ellipse_95((0.0, 0.0), ((1.0, 1.0), (1.0, 1.0 - 1e-17)))
    assert ellipse.semi_minor_m == 0.0
    assert len(ellipse.corners_enu_m(2)) == 3
