"""What became of one measurement."""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.base import UpdateReport
from companion.estimation.refusal import Refusal


@dataclass(frozen=True, slots=True)
class FusionReport:
    """What became of one measurement."""

    refusal: Refusal | None
    update: UpdateReport | None = None
    """The best hypothesis' update; None for a refusal and for the first measurement."""
    restarted: bool = False
    """The filter lost its covariance or contradicted its measurements, and was started anew."""
    agrees: bool = True
    """Whether all that was measured agrees with the estimate."""
    measurement: RangingMeasurement | None = None
    """What was measured, its bearing in the local frame, where the log is to tell it."""
    sensor_enu_m: PositionEnu | None = None
    """Where it was measured."""
