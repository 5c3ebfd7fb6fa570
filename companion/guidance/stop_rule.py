"""When the target counts as found."""

from __future__ import annotations

from companion.domain import EstimateState, TargetEstimate


class StopRule:
    """The estimate names one place within a radius, without a break, for long enough."""

    def __init__(self) -> None:
        self._since_s: float | None = None

    def begin_anew(self) -> None:
        """What was seen so far counts no more."""
        self._since_s = None

    def is_met(
        self, estimate: TargetEstimate | None, now_s: float, radius_m: float, confirm_s: float
    ) -> bool:
        """Whether the target is found.

        Args:
            estimate: Of this moment; None breaks the run.
            now_s: The present.
            radius_m: R95 must be at most this.
            confirm_s: For this long.
        """
        if estimate is None or not _is_enough(estimate, radius_m):
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s >= confirm_s


def _is_enough(estimate: TargetEstimate, radius_m: float) -> bool:
    is_one_place = estimate.state is EstimateState.LOCALISED
    return is_one_place and estimate.r95_m <= radius_m
