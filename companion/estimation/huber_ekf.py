"""Huber-EKF: the symmetric robust filter, which takes a long range for as wrong as a short one."""

from __future__ import annotations

import msgspec

from companion.estimation.filter_params import FilterParams
from companion.estimation.recursive_filter import RecursiveFilter


class HuberEkf(RecursiveFilter):
    """The symmetric baseline: the long threshold of ranges holds on the short side, too.

    Paper: eq. (8) for every modality, the "relaxed" model that ignores that b >= 0.

    Args:
        params: Noise, thresholds, priors and bounds; `range_k_short` does not count.
    """

    def __init__(self, params: FilterParams) -> None:
        super().__init__(msgspec.structs.replace(params, range_k_short=params.range_k_long))
