"""How far from home a vehicle may go: a leash, and the battery that it takes to come back.

Theory of operation. The way home costs charge in proportion to its length, and the reserve is not
to be touched, so what is left beyond the reserve is a distance. Who is farther than that is not
pulled back (that is for the pilot, or for the autopilot's own failsafe) but goes no farther. A
battery that nobody knows is not a full one: its distance is nothing. Standard library only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

M_PER_KM = 1000.0
FULL_PCT = 100.0


@dataclass(frozen=True, slots=True)
class Reserve:
    """What it takes to come back.

    Raises:
        ValueError: A reserve that is no share of a battery, or a cost that is not positive; the
            text begins with the name of the limit.
    """

    reserve_pct: float
    """Charge that is kept for landing."""
    cost_pct_per_km: float
    """Charge that a kilometre of the way home takes, into the wind."""

    def __post_init__(self) -> None:
        """Refuse what is not a number or reserves nothing."""
        if not 0.0 <= self.reserve_pct < FULL_PCT:
            raise ValueError("battery_reserve_pct: must be from 0 to below 100")
        if not 0.0 < self.cost_pct_per_km < math.inf:
            raise ValueError("battery_pct_per_km: must be a finite number above 0")

    def reach_m(self, battery_pct: float | None) -> float:
        """How far from home there is charge to come back; 0 if nobody knows the charge."""
        if battery_pct is None:
            return 0.0
        return max(0.0, battery_pct - self.reserve_pct) / self.cost_pct_per_km * M_PER_KM
