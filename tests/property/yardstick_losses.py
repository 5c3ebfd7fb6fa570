"""Robust losses as values, so that one test takes any: Huber's family and what it is compared with.

Theory of operation. As in `kalman`, u is the whitened residual and a loss is the trio loss,
influence, weight. With x = (u / c)^2, and c the scale of the side that u is on,

    Cauchy      loss c^2/2 log(1 + x)            influence u / (1 + x)       weight 1 / (1 + x)
    Tukey       loss c^2/6 (1 - (1 - x)^3)       influence u (1 - x)^2       weight (1 - x)^2
                     c^2/6             x > 1     0                           0

and c = infinity is quadratic on that side. Both redescend: the influence of a gross error falls,
Tukey's to nothing. That price is convexity, and with it the promise of one minimum.

The check loss u (q - [u < 0]) is least on average where a share q of the residuals lies below 0:
q < 1/2 leans towards the short ranges, which reflections leave alone. It has a kink at 0; smoothed
by convolution with a logistic density of scale h it is convex and smooth,

    loss        q u + h log(1 + exp(-u / h))      within h log 2 of the check loss
    influence   q - 1 / (1 + exp(u / h))

A single residual then costs least not at 0 but at the centre h log((1 - q) / q), where the
influence changes its sign. Influence over residual is therefore of no use: it is infinite at 0 and
negative between 0 and the centre. The weight here is influence / (u - centre), which is positive,
and re-weighted least squares must take u - centre as its residual. It settles at the minimum for
levels from 0.05 to 0.95: there the curvature is below twice the weight at every residual.

Sources: P. W. Holland and R. E. Welsch, Communications in Statistics A6 (1977), for the first two;
S. Zheng, Int. J. Machine Learning and Cybernetics 2 (2011), for the smoothed check loss, which is
the logistic case of X. He, X. Pan, K. M. Tan and W.-X. Zhou, J. Econometrics 232 (2023).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.estimation.filters.kalman import (
    asymmetric_huber_influence,
    asymmetric_huber_loss,
    asymmetric_huber_weight,
)
from companion.kernel import kernel

TINY_SQUARE = 1e-12
"""Squares of u / c below this are taken as 0: log(1 + x) / x is 1 to the last digits that count."""


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """A loss with its thresholds filled in, as functions of the whitened residual u alone.

    The three belong together: influence = d loss / du = weight (u - centre). Re-weighted least
    squares with these weights, applied to u - centre, therefore stands still where the sum of the
    losses does.
    """

    name: str
    loss: Callable[[float], float]
    influence: Callable[[float], float]
    weight: Callable[[float], float]
    is_convex: bool = True
    """False for those that can have several minima."""
    knots: tuple[float, ...] = ()
    """Residuals at which the formula changes; the loss is continuously differentiable there too."""
    centre: float = 0.0
    """The residual that costs least."""


def quadratic() -> RobustLoss:
    """Least squares: every residual counts in full."""
    return asymmetric_huber(math.inf, math.inf, name="quadratic")


def symmetric_huber(k: float) -> RobustLoss:
    """Huber's loss, quadratic up to `k` sigma on both sides. Paper: eq. (8)."""
    return asymmetric_huber(k, k, name=f"symmetric Huber k={k:g}")


def one_sided_huber(k: float) -> RobustLoss:
    """The paper's loss, linear above `k` sigma and quadratic below. Paper: eq. (7)."""
    return asymmetric_huber(k, math.inf, name=f"one-sided Huber k={k:g}")


def asymmetric_huber(k_long: float, k_short: float, name: str | None = None) -> RobustLoss:
    """Linear above `k_long` sigma and below -`k_short` sigma; infinity: quadratic on that side."""
    return RobustLoss(
        name=name or f"asymmetric Huber k={k_long:g}/{k_short:g}",
        loss=lambda u: float(asymmetric_huber_loss(u, k_long, k_short)),
        influence=lambda u: float(asymmetric_huber_influence(u, k_long, k_short)),
        weight=lambda u: float(asymmetric_huber_weight(u, k_long, k_short)),
        knots=tuple(k for k in (-k_short, k_long) if math.isfinite(k)),
    )


@kernel
def squared_ratio(u: float, c_long: float, c_short: float) -> float:
    """(u / c)^2 with the scale of the side that u is on; 0 where that scale is infinite."""
    ratio = u / c_long if u > 0.0 else u / c_short
    return ratio * ratio


@kernel
def asymmetric_cauchy_loss(u: float, c_long: float, c_short: float) -> float:
    """Loss that grows like a logarithm; not convex beyond its scale."""
    x = squared_ratio(u, c_long, c_short)
    if x < TINY_SQUARE:
        return 0.5 * u * u
    return 0.5 * u * u * math.log1p(x) / x


@kernel
def asymmetric_cauchy_influence(u: float, c_long: float, c_short: float) -> float:
    """Derivative of the loss; largest, c / 2, at the scale itself."""
    return u / (1.0 + squared_ratio(u, c_long, c_short))


@kernel
def asymmetric_cauchy_weight(u: float, c_long: float, c_short: float) -> float:
    """Influence over residual, in (0, 1]."""
    return 1.0 / (1.0 + squared_ratio(u, c_long, c_short))


@kernel
def asymmetric_tukey_loss(u: float, c_long: float, c_short: float) -> float:
    """Tukey's biweight: constant beyond its scale."""
    x = squared_ratio(u, c_long, c_short)
    if x >= 1.0:
        c = c_long if u > 0.0 else c_short
        return c * c / 6.0
    return u * u / 6.0 * (3.0 - 3.0 * x + x * x)


@kernel
def asymmetric_tukey_influence(u: float, c_long: float, c_short: float) -> float:
    """Derivative of the loss; 0 beyond its scale."""
    return u * asymmetric_tukey_weight(u, c_long, c_short)


@kernel
def asymmetric_tukey_weight(u: float, c_long: float, c_short: float) -> float:
    """Influence over residual, in [0, 1]: beyond its scale a measurement does not count at all."""
    left = max(0.0, 1.0 - squared_ratio(u, c_long, c_short))
    return left * left


@kernel
def smoothed_quantile_centre(level: float, bandwidth: float) -> float:
    """The residual that costs least, h log((1 - q) / q)."""
    return bandwidth * math.log((1.0 - level) / level)


@kernel
def smoothed_quantile_loss(u: float, level: float, bandwidth: float) -> float:
    """Check loss of level q in (0, 1), smoothed over a bandwidth h > 0; convex and smooth."""
    check = level * u if u >= 0.0 else (level - 1.0) * u
    return check + bandwidth * math.log1p(math.exp(-abs(u) / bandwidth))


@kernel
def smoothed_quantile_influence(u: float, level: float, bandwidth: float) -> float:
    """Derivative of the loss, in (q - 1, q), without cancellation about the centre."""
    v = (u - smoothed_quantile_centre(level, bandwidth)) / bandwidth
    if v > 0.0:
        return -level * (1.0 - level) * math.expm1(-v) / (level * math.exp(-v) + 1.0 - level)
    return level * (1.0 - level) * math.expm1(v) / (level + (1.0 - level) * math.exp(v))


@kernel
def smoothed_quantile_weight(u: float, level: float, bandwidth: float) -> float:
    """Influence over u - centre, in (0, 1 / (4 h)]; see the head of the module."""
    from_centre = u - smoothed_quantile_centre(level, bandwidth)
    if abs(from_centre) < 1e-9 * bandwidth:
        return level * (1.0 - level) / bandwidth
    return smoothed_quantile_influence(u, level, bandwidth) / from_centre


def asymmetric_cauchy(c_long: float, c_short: float) -> RobustLoss:
    """Cauchy's loss with a scale per side, in sigma; infinity: quadratic on that side."""
    return RobustLoss(
        name=f"asymmetric Cauchy c={c_long:g}/{c_short:g}",
        loss=lambda u: float(asymmetric_cauchy_loss(u, c_long, c_short)),
        influence=lambda u: float(asymmetric_cauchy_influence(u, c_long, c_short)),
        weight=lambda u: float(asymmetric_cauchy_weight(u, c_long, c_short)),
        is_convex=math.isinf(c_long) and math.isinf(c_short),
        knots=(0.0,),
    )


def asymmetric_tukey(c_long: float, c_short: float) -> RobustLoss:
    """Tukey's biweight with a scale per side, in sigma; infinity: quadratic on that side."""
    return RobustLoss(
        name=f"asymmetric Tukey c={c_long:g}/{c_short:g}",
        loss=lambda u: float(asymmetric_tukey_loss(u, c_long, c_short)),
        influence=lambda u: float(asymmetric_tukey_influence(u, c_long, c_short)),
        weight=lambda u: float(asymmetric_tukey_weight(u, c_long, c_short)),
        is_convex=math.isinf(c_long) and math.isinf(c_short),
        knots=(0.0, *(c for c in (-c_short, c_long) if math.isfinite(c))),
    )


def smoothed_quantile(level: float, bandwidth: float) -> RobustLoss:
    """The smoothed check loss of level q, its bandwidth in sigma."""
    return RobustLoss(
        name=f"smoothed quantile q={level:g} h={bandwidth:g}",
        loss=lambda u: float(smoothed_quantile_loss(u, level, bandwidth)),
        influence=lambda u: float(smoothed_quantile_influence(u, level, bandwidth)),
        weight=lambda u: float(smoothed_quantile_weight(u, level, bandwidth)),
        centre=float(smoothed_quantile_centre(level, bandwidth)),
    )
