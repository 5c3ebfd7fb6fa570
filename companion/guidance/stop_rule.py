"""When the target counts as found."""

from __future__ import annotations

from companion.domain import EstimateState, TargetEstimate


class StopRule:
    """The estimate names one place within a radius, without a break, for long enough.

    Args:
        radius_m: R95 must be at most this.
        confirm_s: For this long.
    """

    def __init__(self, radius_m: float, confirm_s: float) -> None:
        self._radius_m = radius_m
        self._confirm_s = confirm_s
        self._since_s: float | None = None

    def begin_anew(self) -> None:
        """What was seen so far counts no more."""
        self._since_s = None

    def is_met(self, estimate: TargetEstimate | None, now_s: float) -> bool:
        """Whether the target is found, given the estimate of this moment; None breaks the run."""
        if estimate is None or not self._is_enough(estimate):
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s >= self._confirm_s

    def _is_enough(self, estimate: TargetEstimate) -> bool:
        is_one_place = estimate.state is EstimateState.LOCALISED
        return is_one_place and estimate.r95_m <= self._radius_m
