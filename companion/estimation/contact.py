"""What was heard of the emitter lately: the age of each kind, and how much of it agrees."""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import RangingMeasurement
from companion.estimation.gate import Gate

GAP_S = 2.0
"""Without a measurement that agrees for this long the contact was interrupted."""


@dataclass(frozen=True, slots=True)
class Contact:
    """Times are those of the measurements themselves, on the companion's clock.

    Only measurements that agree with the estimate count: refused ones, outliers and frozen values
    are as good as none. While nothing is known of the target, everything agrees.
    """

    range_s: float | None = None
    """When the newest range was measured; None: there was none yet."""
    bearing_s: float | None = None
    """The same of bearings."""
    agreeing: int = 0
    """Measurements that agreed since the last gap, or since the first one."""

    def after(self, measurement: RangingMeasurement, gate: Gate) -> Contact:
        """With one more measurement; a late one makes nothing younger or older.

        Args:
            measurement: All that was measured, its bearing in ENU.
            gate: What of it agrees with the estimate.
        """
        at_s = measurement.measured_at_s
        has_range = measurement.range_m is not None and gate.agrees_in_range
        has_bearing = measurement.bearing_enu_rad is not None and gate.agrees_in_bearing
        if not (has_range or has_bearing):
            return self
        is_gap = self.newest_s is not None and at_s - self.newest_s > GAP_S
        return Contact(
            range_s=_later(self.range_s, at_s if has_range else None),
            bearing_s=_later(self.bearing_s, at_s if has_bearing else None),
            agreeing=(0 if is_gap else self.agreeing) + gate.agrees,
        )

    @property
    def newest_s(self) -> float | None:
        """When the newest measurement of any kind was made."""
        return _later(self.range_s, self.bearing_s)

    def is_interrupted(self, now_s: float) -> bool:
        """Whether there is a gap now, or there was no contact yet."""
        newest_s = self.newest_s
        return newest_s is None or now_s - newest_s > GAP_S

    def agreeing_since_gap(self, now_s: float) -> int:
        """How many measurements agreed since the last gap; 0 during a gap."""
        return 0 if self.is_interrupted(now_s) else self.agreeing

    def range_age_s(self, now_s: float) -> float | None:
        """How old the newest range is; None if there was none yet."""
        return None if self.range_s is None else max(now_s - self.range_s, 0.0)

    def bearing_age_s(self, now_s: float) -> float | None:
        """How old the newest bearing is; None if there was none yet."""
        return None if self.bearing_s is None else max(now_s - self.bearing_s, 0.0)


def _later(a_s: float | None, b_s: float | None) -> float | None:
    if a_s is None or b_s is None:
        return b_s if a_s is None else a_s
    return max(a_s, b_s)
