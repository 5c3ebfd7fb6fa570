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

Paper: eqs. (6), (7), (8) and (10), Propositions A.1 to A.4.
"""

from __future__ import annotations

import math

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
