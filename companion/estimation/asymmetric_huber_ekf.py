"""AsymmetricHuberEKF: an extended Kalman filter with the one-sided Huber loss on ranges."""

from __future__ import annotations

from companion.estimation.recursive_filter import RecursiveFilter


class AsymmetricHuberEkf(RecursiveFilter):
    """The filter of the paper: ranges linear above `range_k_long`, bearings on both sides.

    With `range_k_short` ranges are linear on the short side as well, for sensors whose gross
    errors are short; without it the loss is the paper's.

    Paper: eqs. (7) to (9), used recursively. Deviations: the range is slant; the variances contain
    second-order terms and the vehicle's own position uncertainty (`models.ranging_model`), without
    which the filter diverges near the target and is over-confident right above it.
    """
