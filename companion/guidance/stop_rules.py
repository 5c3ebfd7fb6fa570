"""When a search ends: the radius is reached, or it is out of reach.

Theory of operation. Random errors fall with the number of measurements, those of a place or of the
whole flight do not: the height of the ground, satellites, walls that stay where they are. So R95
comes down to a radius of its own, which depends on the radio, the antenna and the place, and nobody
can tell it beforehand. Where that is above the radius to stop at, more crossing tells nothing more.
"""

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
        """Whether the target is found; without an estimate the run is broken."""
        is_one_place = estimate is not None and estimate.state is EstimateState.LOCALISED
        if estimate is None or not is_one_place or estimate.settled_r95_m > radius_m:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s >= confirm_s


IMPROVED_SHARE = 0.92
"""R95 that is not below this share of what it was has not improved."""
WORSE_RATIO = 1.5
"""R95 that has grown by more is looked at anew: something was learnt that contradicts it."""
MOST_SETTLED_M = 100.0
"""What settles above this is no place, unless it was asked for no better (`localised_r95_m`)."""
ONE_PLACE = (EstimateState.LOCALISED, EstimateState.SEARCHING)


class SettledRule:
    """R95 of one place does not improve any more, though measurements come.

    Only time between measurements that were accepted in flight counts: while the vehicle holds, or
    its radio or its clock fails, nothing is learnt, and that R95 stays as it is says nothing.
    """

    def __init__(self) -> None:
        self._learnt_s = 0.0
        """Time between accepted measurements."""
        self._heard_s: float | None = None
        """Of the last one; None: the vehicle held since then, or nothing was heard for long."""
        self._mark: tuple[float, float] | None = None
        """After how much of that time R95 improved last, and to what."""

    def begin_anew(self) -> None:
        """What was seen so far counts no more."""
        self._mark = None

    def is_met(
        self, estimate: TargetEstimate | None, heard_s: float | None, settle_s: float
    ) -> bool:
        """Return True if it has not improved for so long; without an estimate nothing is learnt.

        Args:
            estimate: None while the plan is not flown, or no measurements come.
            heard_s: Time of the last accepted measurement.
            settle_s: How much time between measurements must pass without improvement.
        """
        if estimate is None or heard_s is None:
            self._heard_s = None
            return False
        if self._heard_s is not None:
            self._learnt_s += max(0.0, heard_s - self._heard_s)
        self._heard_s = heard_s
        r95_m = estimate.r95_m
        is_localised = estimate.state is EstimateState.LOCALISED
        if estimate.state not in ONE_PLACE or (r95_m > MOST_SETTLED_M and not is_localised):
            self._mark = None
            return False
        if self._mark is None or not (
            IMPROVED_SHARE * self._mark[1] <= r95_m <= WORSE_RATIO * self._mark[1]
        ):
            self._mark = (self._learnt_s, r95_m)
        return self._learnt_s - self._mark[0] >= settle_s
