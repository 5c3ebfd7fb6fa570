"""Spatially correlated errors: their range, and the effective sample size that they leave.

A reflection's effect on a range or bearing changes with the vehicle's position and hardly with
time: a hundred measurements from one spot are fully correlated. The influences psi of a fit are
modelled as a random field over positions with covariance

    s^2 exp(-d / l) + white noise

with unknown s and l. Measurements are averaged in cells of positions, and every pair of a grid of s
and l is weighted by the restricted likelihood of the averages y, which excludes what the fit itself
explains by its partials X (with the prior P of the state):

    -2 log L = log |V| + log |K| + y^T V^-1 y - b^T K^-1 b,  K = X^T V^-1 X + P,  b = X^T V^-1 y

A short track leaves residuals that look white although the field is constant along it: the fit has
absorbed it. The restricted likelihood is flat there, and the radio's prior remains. The sandwich
uses the weighted mean of the field's covariance over the grid, and the effective sample size of n
measurements follows from the variance of their mean.

Source: H. D. Patterson and R. Thompson, Biometrika 58 (1971), for the restricted likelihood; T. G.
Conley, J. Econometrics 92 (1999), for variances of estimates under spatial errors.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.kernel import Matrix, Vector

Indices = NDArray[np.intp]

LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Correlation lengths of the grid, in units of the prior one, in factors of two.

Chosen: a finer grid, as one of more deviations below, costs a factorisation for each pair.
"""
AMPLITUDES = (0.1, 0.25, 0.5, 0.8, 1.2, 1.8)
"""Deviations of the grid, in units of the prior one."""
CELL_SHARE = 0.125
"""Length of a cell as a share of the correlation length, if that leaves few enough: within a cell
the correlation is 0.88 or more."""


_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(32)
"""Points and weights of a mean over a standard normal, after Gauss and Hermite."""


@functools.lru_cache(maxsize=64)
def clipped_deviation(deviation: float, k_long: float, k_short: float) -> float:
    """Return the standard deviation of a field of residuals, in sigma, in the influences.

    A loss that clips residuals clips their field as well: under a normal field f and white noise e
    it is the deviation of the expected influence E[psi(f + e) | f]. With L(x) = x Phi(x) + phi(x),
    the mean of max(x - e, 0), that expectation is f + L(-k_short - f) - L(f - k_long).
    """
    field = deviation * _NODES
    mean = field.copy()
    if math.isfinite(k_short):
        mean += [_mean_excess(x) for x in (-k_short - field).tolist()]
    if math.isfinite(k_long):
        mean -= [_mean_excess(x) for x in (field - k_long).tolist()]
    return float(np.sqrt(np.cov(mean, ddof=0, aweights=_WEIGHTS)))


def _mean_excess(x: float) -> float:
    """Return the mean of max(x - e, 0) over a standard normal e."""
    density = math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
    return 0.5 * x * math.erfc(-x / math.sqrt(2.0)) + density


@dataclass(frozen=True, slots=True)
class SpatialPrior:
    """Prior of a modality's field."""

    deviation: float
    """Standard deviation of the field, in units of the influences."""
    length_m: float
    is_of_radio: bool = True
    """True: the deviation is known from the radio; false: it is an upper limit."""


@dataclass(frozen=True, slots=True)
class SpatialNoise:
    """Field of one modality's influences."""

    cell: Indices
    """(n,) cell of each measurement; -1: not measured."""
    field: Matrix
    """(g, g) covariance of the field between cells."""
    white: float
    """Variance of the white rest of each measurement."""
    repetition: float
    """Measurements per effective sample, at least 1."""

    def sums(self, values: Matrix) -> Matrix:
        """Return the sums over each cell, (g, m), of `values` (n, m)."""
        seen = self.cell >= 0
        sums = np.zeros((len(self.field), values.shape[1]))
        np.add.at(sums, self.cell[seen], values[seen])
        return sums

    def variance(self, weights: Matrix) -> Matrix:
        """Return the covariance of weighted sums of influences, (m, m); `weights` (n, m).

        Rows that were not measured are zero.
        """
        return self.covariance(weights, weights)

    def covariance(self, one: Matrix, other: Matrix) -> Matrix:
        """Return the covariance (m, k) of sums with the weights `one` (n, m) and `other` (n, k)."""
        sums, others = self.sums(one), self.sums(other)
        total: Matrix = sums.T @ self.field @ others + self.white * (one.T @ other)
        return total

    @property
    def degrees(self) -> float:
        """Degrees of freedom of a variance that the cells' averages determine (Satterthwaite)."""
        count = np.bincount(self.cell[self.cell >= 0], minlength=len(self.field))
        V = self.field + np.diag(self.white / count)
        return float(np.trace(V) ** 2 / np.sum(V * V))


def fit_spatial_noise(
    positions: Matrix,
    psi: Vector,
    partials: Matrix,
    slope: float,
    prior: Matrix,
    prior_noise: SpatialPrior,
) -> SpatialNoise:
    """Return the field of the influences psi (n,), NaN where not measured, at `positions` (n, 2).

    `partials` (n, k) are whitened, `slope` is the share of them on the quadratic part, and `prior`
    (k, k) is the information of the state's prior.
    """
    seen = ~np.isnan(psi)
    index, way_m = cells_of(positions[seen], CELL_SHARE * prior_noise.length_m)
    cell = np.full(len(psi), -1)
    cell[seen] = index
    count = np.bincount(index).astype(float)
    mean = _means(
        np.column_stack([psi[seen], positions[seen], slope * partials[seen]]), index, count
    )
    y, centres, X = mean[:, 0], mean[:, 1:3], mean[:, 3:]
    scatter = float(np.sum((psi[seen] - y[index]) ** 2))
    degrees = len(index) - len(count)
    count_0 = 4.0  # weight of the prior, in measurements; chosen: it decides where few share a cell
    white = (scatter + count_0 * prior_noise.deviation**2) / (degrees + count_0)
    apart = np.stack(
        [
            np.hypot(*(centres[:, None, :] - centres[None, :, :]).T),
            np.abs(way_m[:, None] - way_m[None, :]),
        ]
    )
    lengths = prior_noise.length_m * np.array(LENGTHS)
    shapes = np.exp(-apart[:, None] / lengths[:, None, None]).reshape(-1, *apart.shape[1:])
    deviations = prior_noise.deviation * np.array(AMPLITUDES)
    fields = (deviations[None, :, None, None] ** 2 * shapes[:, None]).reshape(-1, *apart.shape[1:])
    logs = _log_likelihoods(fields + np.diag(white / count), y, X, prior)
    weights = logs + _log_prior(prior_noise)
    weights = np.exp(weights - weights.max())
    field = np.tensordot(weights / weights.sum(), fields, axes=1)
    total = len(index)
    of_mean = float(count @ field @ count) + white * total
    return SpatialNoise(cell, field, white, max(1.0, of_mean / (total * slope)))


def _log_prior(prior_noise: SpatialPrior) -> Vector:
    """Return the log prior of every length and deviation of the grid, (m,)."""
    if not prior_noise.is_of_radio:
        return np.zeros(2 * len(LENGTHS) * len(AMPLITUDES))
    # in factors of two; chosen: a length is known worse than a deviation
    length_sigma, amplitude_sigma = 1.5, 1.0
    deviations2 = [
        (math.log2(a) / length_sigma) ** 2 + (math.log2(b) / amplitude_sigma) ** 2
        for a in LENGTHS
        for b in AMPLITUDES
    ]
    return -0.5 * np.array(2 * deviations2)


def cells_of(positions: Matrix, least_m: float) -> tuple[Indices, Vector]:
    """Return the cell of each of the positions (n, 2), and each cell's distance along the track.

    A cell begins where the vehicle is far enough from the start of the one before, so that hovering
    stays within one; cells are as long as needed to be few enough.
    """
    points = positions.tolist()
    most = 32  # the cost grows with the third power
    while True:
        index, ways_m, begin = [0] * len(points), [0.0], points[0]
        for i, point in enumerate(points):
            step_m = math.dist(point, begin)
            if step_m >= least_m:
                ways_m.append(ways_m[-1] + step_m)
                if len(ways_m) > most:
                    break
                begin = point
            index[i] = len(ways_m) - 1
        if len(ways_m) <= most:
            return np.array(index), np.array(ways_m)
        least_m *= 1.5


def _means(values: Matrix, index: Indices, count: Vector) -> Matrix:
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, index, values)
    means: Matrix = sums / count[:, None]
    return means


def _log_likelihoods(V: Matrix, y: Vector, X: Matrix, prior: Matrix) -> Vector:
    """Return the restricted log-likelihoods, (m,), of the averages y (g,) for V (m, g, g)."""
    right = np.column_stack([X, y])
    solved = np.linalg.solve(V, np.broadcast_to(right, (len(V), *right.shape)))
    information = X.T @ solved[:, :, :-1] + prior
    b = X.T @ solved[:, :, -1:]
    scale = np.trace(information, axis1=1, axis2=2)[:, None, None]
    information += 1e-9 * scale * np.eye(X.shape[1])
    explained = np.sum(b * np.linalg.solve(information, b), axis=(1, 2))
    left = solved[:, :, -1] @ y - explained
    logs: Vector = -0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(information)[1] + left)
    return logs
