"""Errors that stay with the place: how far they reach, and what a thousand measurements are worth.

What reflections add to a range, or bend a bearing by, changes with the vehicle's place and hardly
with time: a hundred measurements from one spot are one opinion. The influences psi of a fit are
taken for a field over the places with covariance

    s^2 exp(-d / l) + white noise

of which s and l are not known. Measurements of a cell of places are averaged, and every pair of a
grid of s and l is weighed by the restricted likelihood of the averages y, in which whatever the fit
itself explains by its partials X (with the prior P of the state) tells nothing:

    -2 log L = log |V| + log |K| + y^T V^-1 y - b^T K^-1 b,  K = X^T V^-1 X + P,  b = X^T V^-1 y

A short walk leaves residuals that look white although the field reached over all of it: the fit has
swallowed it. Restricted likelihood is flat there, and what is believed of the radio beforehand
stays. The mean of the field's covariance over the grid is what the sandwich counts, and n
measurements are as many votes as make the variance of their mean.

Source: H. D. Patterson and R. Thompson, Biometrika 58 (1971), for the restricted likelihood;
T. G. Conley, J. Econometrics 92 (1999), for variances of estimates under errors of places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.kernel import Matrix, Vector

Indices = NDArray[np.intp]

LENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Reaches that are weighed, in units of the one that is believed beforehand."""
AMPLITUDES = (0.1, 0.25, 0.5, 0.8, 1.2, 1.8)
"""The same of the field's deviation."""
LENGTH_DOUBT, AMPLITUDE_DOUBT = 1.5, 1.0
"""How vague that belief is, in factors of two."""
MOST_CELLS = 32
CELL_SHARE = 0.125
"""Length of a stretch as a share of the reach, if that makes few enough."""
WHITE_COUNT = 4.0
"""How many measurements the white noise is worth before it is measured."""


@dataclass(frozen=True, slots=True)
class PlaceBelief:
    """What is believed of a modality's field before anything is measured."""

    deviation: float
    """Of the field, in the unit of the influences."""
    length_m: float
    is_of_radio: bool = True
    """Whether that deviation is what the radio is known for; false: it is the most there can be."""


@dataclass(frozen=True, slots=True)
class PlaceNoise:
    """The field of one modality's influences."""

    cell: Indices
    """(n,) which stretch each of the measurements is on; -1: not measured."""
    field: Matrix
    """(g, g) covariance of the field between stretches."""
    white: float
    """Variance of what is left to each measurement."""
    repetition: float
    """How many measurements are one vote, at least 1."""

    def variance(self, weights: Matrix) -> Matrix:
        """Of the sums of influences with weights (n, m), (m, m); rows not measured are zero."""
        seen = self.cell >= 0
        sums = np.zeros((len(self.field), weights.shape[1]))
        np.add.at(sums, self.cell[seen], weights[seen])
        total: Matrix = sums.T @ self.field @ sums + self.white * (weights.T @ weights)
        return total


def place_noise(
    places: Matrix, psi: Vector, partials: Matrix, slope: float, prior: Matrix, belief: PlaceBelief
) -> PlaceNoise:
    """The field of the influences psi (n,), NaN where not measured, at `places` (n, 2).

    `partials` (n, k) are the whitened ones, `slope` the share of them on the quadratic part, and
    `prior` (k, k) is the information of the state's prior.
    """
    seen = ~np.isnan(psi)
    index, way_m = stretches_of(places[seen], CELL_SHARE * belief.length_m)
    cell = np.full(len(psi), -1)
    cell[seen] = index
    count = np.bincount(index).astype(float)
    mean = _means(np.column_stack([psi[seen], places[seen], slope * partials[seen]]), index, count)
    y, centres, X = mean[:, 0], mean[:, 1:3], mean[:, 3:]
    scatter = float(np.sum((psi[seen] - y[index]) ** 2))
    degrees = len(index) - len(count)
    white = (scatter + WHITE_COUNT * belief.deviation**2) / (degrees + WHITE_COUNT)
    apart = np.stack(
        [
            np.hypot(*(centres[:, None, :] - centres[None, :, :]).T),
            np.abs(way_m[:, None] - way_m[None, :]),
        ]
    )
    lengths = belief.length_m * np.array(LENGTHS)
    shapes = np.exp(-apart[:, None] / lengths[:, None, None]).reshape(-1, *apart.shape[1:])
    deviations = belief.deviation * np.array(AMPLITUDES)
    fields = (deviations[None, :, None, None] ** 2 * shapes[:, None]).reshape(-1, *apart.shape[1:])
    logs = _log_likelihoods(fields + np.diag(white / count), y, X, prior)
    weights = logs + _log_prior(belief)
    weights = np.exp(weights - weights.max())
    field = np.tensordot(weights / weights.sum(), fields, axes=1)
    total = len(index)
    of_mean = float(count @ field @ count) + white * total
    return PlaceNoise(cell, field, white, max(1.0, of_mean / (total * slope)))


def _log_prior(belief: PlaceBelief) -> Vector:
    """Of every reach and deviation that is weighed, (m,)."""
    if not belief.is_of_radio:
        return np.zeros(2 * len(LENGTHS) * len(AMPLITUDES))
    doubts = [
        (math.log2(a) / LENGTH_DOUBT) ** 2 + (math.log2(b) / AMPLITUDE_DOUBT) ** 2
        for a in LENGTHS
        for b in AMPLITUDES
    ]
    return -0.5 * np.array(2 * doubts)


def stretches_of(places: Matrix, least_m: float) -> tuple[Indices, Vector]:
    """Which stretch of the way each of the places (n, 2) is on, (n,), and how far along each is.

    A stretch begins where the vehicle is so far from where the one before it began, so that who
    hovers gets nowhere; stretches are as long as makes them few enough.
    """
    points = places.tolist()
    while True:
        index, ways_m, begin = [0] * len(points), [0.0], points[0]
        for i, point in enumerate(points):
            step_m = math.dist(point, begin)
            if step_m >= least_m:
                ways_m.append(ways_m[-1] + step_m)
                if len(ways_m) > MOST_CELLS:
                    break
                begin = point
            index[i] = len(ways_m) - 1
        if len(ways_m) <= MOST_CELLS:
            return np.array(index), np.array(ways_m)
        least_m *= 1.5


def _means(values: Matrix, index: Indices, count: Vector) -> Matrix:
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, index, values)
    means: Matrix = sums / count[:, None]
    return means


def _log_likelihoods(V: Matrix, y: Vector, X: Matrix, prior: Matrix) -> Vector:
    """Restricted log-likelihoods of the averages y (g,), (m,), by each of the V (m, g, g)."""
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
