"""Robust losses as the trio loss, influence, weight, over the whitened residual u = r / sigma.

Theory of operation. A reflected path is longer than the straight one, never shorter, so the bias b
of a range is non-negative. With an exponential prior of rate lambda on it, the MAP bias of one
measurement is the soft threshold b* = max(0, r - lambda sigma^2), and putting it back gives a loss
that is quadratic up to tau = lambda sigma^2 and linear above: the one-sided Huber loss. In whitened
form the threshold is k = tau / sigma = lambda sigma, and

    loss       u^2/2           -k_short <= u <= k_long       k_long  (u - k_long/2)   above
    influence  u                                             k_long                   above
    weight     1                                             k_long / u               above

and the mirror image below -k_short. k_short = infinity is the one-sided loss of the paper,
k_short = k_long the symmetric Huber loss, both infinite the quadratic loss. A finite k_short serves
sensors whose gross errors are short (recorded UWB shows bursts of them).

    loss                 k_long   k_short
    quadratic            inf      inf
    one-sided Huber      k        inf
    symmetric Huber      k        k
    asymmetric Huber     k        k'

A `RobustLoss` bundles the three with their thresholds, so that one test or study takes any loss.

Paper: eqs. (6), (7), (8) and (10), Propositions A.1 to A.4.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.kernel import kernel


@kernel
def asymmetric_huber_loss(u: float, k_long: float, k_short: float) -> float:
    """Loss of a whitened residual; convex and continuously differentiable. Paper: eqs. (7), (8)."""
    if u > k_long:
        return k_long * (u - 0.5 * k_long)
    if u < -k_short:
        return k_short * (-u - 0.5 * k_short)
    return 0.5 * u * u


@kernel
def asymmetric_huber_influence(u: float, k_long: float, k_short: float) -> float:
    """Derivative of the loss: the residual, clipped to [-k_short, k_long]."""
    return min(max(u, -k_short), k_long)


@kernel
def asymmetric_huber_weight(u: float, k_long: float, k_short: float) -> float:
    """Influence over residual, in (0, 1]: how much of the measurement counts."""
    if u > k_long:
        return k_long / u
    if u < -k_short:
        return -k_short / u
    return 1.0


def threshold(k: float | None) -> float:
    """A configured threshold as a number: none at all is infinity."""
    return math.inf if k is None else k


def threshold_k_from_lambda(rate_per_m: float, sigma_m: float) -> float:
    """The unitless threshold k = lambda sigma. Paper: eq. (10).

    Args:
        rate_per_m: Rate of the exponential prior on the bias, the inverse of its mean, 1/m.
        sigma_m: Standard deviation of the thermal noise, metres.
    """
    return rate_per_m * sigma_m


def map_bias_m(residual_m: float, rate_per_m: float, sigma_m: float) -> float:
    """The most probable bias b* = max(0, r - lambda sigma^2), metres. Paper: eq. (6)."""
    return max(0.0, residual_m - rate_per_m * sigma_m**2)


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
    """Where the formula changes; the loss is continuously differentiable there too."""
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


def one_sided_huber_of_rate(rate_per_m: float, sigma_m: float) -> RobustLoss:
    """The same loss by its physics: linear above tau = lambda sigma^2. Paper: eqs. (7), (10).

    Args:
        rate_per_m: Rate of the exponential prior on the bias, 1/m.
        sigma_m: Standard deviation of the thermal noise, metres.
    """
    return one_sided_huber(threshold_k_from_lambda(rate_per_m, sigma_m))


def asymmetric_huber(k_long: float, k_short: float, name: str | None = None) -> RobustLoss:
    """Linear above `k_long` sigma and below -`k_short` sigma; infinity: quadratic on that side."""
    return RobustLoss(
        name=name or f"asymmetric Huber k={k_long:g}/{k_short:g}",
        loss=lambda u: float(asymmetric_huber_loss(u, k_long, k_short)),
        influence=lambda u: float(asymmetric_huber_influence(u, k_long, k_short)),
        weight=lambda u: float(asymmetric_huber_weight(u, k_long, k_short)),
        knots=tuple(k for k in (-k_short, k_long) if math.isfinite(k)),
    )
