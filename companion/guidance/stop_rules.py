"""End of a search: the radius is reached, or it is out of reach.

Theory of operation. Random errors fall with the number of measurements; errors of a place or of the
whole flight do not: the height of the ground, GNSS, walls that stay where they are. So R95 settles
at a radius that depends on the radio, the antenna and the site, and cannot be predicted. If that is
above the radius to stop at, further crossings bring no information.
"""

from __future__ import annotations

from companion.domain import EstimateState, TargetEstimate


class StopRule:
    """Met once the estimate names one position within a radius for long enough without a break."""

    def __init__(self) -> None:
        self._since_s: float | None = None

    def reset(self) -> None:
        """Restart the confirmation time."""
        self._since_s = None

    def is_met(
        self, estimate: TargetEstimate | None, now_s: float, radius_m: float, confirm_s: float
    ) -> bool:
        """Return True if the target is found; a missing estimate restarts the confirmation time."""
        is_one_place = estimate is not None and estimate.state is EstimateState.LOCALISED
        if estimate is None or not is_one_place or estimate.settled_r95_m > radius_m:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s >= confirm_s


IMPROVED_SHARE = 0.92
"""R95 that is not below this share of its mark has not improved."""
WORSE_RATIO = 1.5
"""R95 that has grown by more sets a new mark: measurements contradicted the old one."""
MOST_SETTLED_M = 100.0
"""R95 above this is no position, unless no better one was requested (`localised_r95_m`)."""
ONE_PLACE = (EstimateState.LOCALISED, EstimateState.SEARCHING)


class SettledRule:
    """Met once R95 of one position no longer improves although measurements arrive.

    Only time between measurements that were accepted in flight counts: while the vehicle holds, or
    its radio or its clock fails, there is no information, and a constant R95 is no evidence.
    """

    def __init__(self) -> None:
        self._measuring_s = 0.0
        """Time between accepted measurements."""
        self._heard_s: float | None = None
        """Time of the last one; None: the vehicle held since then, or measurements paused for
        long."""
        self._mark: tuple[float, float] | None = None
        """That time at the last improvement of R95, and its value then."""

    def reset(self) -> None:
        """Drop the mark."""
        self._mark = None

    def is_met(
        self, estimate: TargetEstimate | None, heard_s: float | None, settle_s: float
    ) -> bool:
        """Return True if R95 has not improved for `settle_s`; a missing estimate stops the time.

        Args:
            estimate: None while the plan is not followed, or no measurements arrive.
            heard_s: Time of the last accepted measurement.
            settle_s: Time between measurements that must pass without improvement.
        """
        if estimate is None or heard_s is None:
            self._heard_s = None
            return False
        if self._heard_s is not None:
            self._measuring_s += max(0.0, heard_s - self._heard_s)
        self._heard_s = heard_s
        r95_m = estimate.r95_m
        is_localised = estimate.state is EstimateState.LOCALISED
        if estimate.state not in ONE_PLACE or (r95_m > MOST_SETTLED_M and not is_localised):
            self._mark = None
            return False
        if self._mark is None or not (
            IMPROVED_SHARE * self._mark[1] <= r95_m <= WORSE_RATIO * self._mark[1]
        ):
            self._mark = (self._measuring_s, r95_m)
        return self._measuring_s - self._mark[0] >= settle_s
