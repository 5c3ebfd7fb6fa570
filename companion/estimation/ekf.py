"""EKF: the extended Kalman filter of Gaussian noise, every weight one."""

from __future__ import annotations

import msgspec

from companion.estimation.filter_params import FilterParams
from companion.estimation.recursive_filter import RecursiveFilter


class Ekf(RecursiveFilter):
    """The baseline that believes its measurements; thresholds in the params do not count.

    Args:
        params: Noise, priors and bounds.
    """

    def __init__(self, params: FilterParams) -> None:
        super().__init__(
            msgspec.structs.replace(params, range_k_long=None, range_k_short=None, bearing_k=None)
        )
