"""The gate: which innovations a believable estimate can explain.

An innovation is judged in standard deviations of the estimate's own uncertainty and of the noise
that the run has shown. Reflections make ranges longer by any amount and are the robust loss's
task, but no path is shorter than the straight one: a range that is too short by more than the gate
is wrong, and so is a bearing that is off by more. Those are not fused. A range that is longer than
reflections make it is fused, because the loss holds it at bay, but agrees with nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from companion.domain import RangingMeasurement
from companion.estimation.base import Inflation, ModalityReport, UpdateReport
from companion.estimation.refusal import Refusal

GATE_SIGMAS = 6.0
"""Recorded Wi-Fi and UWB walks and flights in the shadow of buildings stay within it."""
LONG_SIGMAS = 25.0
"""Reflections reach 20 of the inflated standard deviations now and then."""


@dataclass(frozen=True, slots=True)
class Gate:
    """What became of one measurement at the gate."""

    passes_range: bool = True
    """False: too short to be fused."""
    passes_bearing: bool = True
    """False: off by too much to be fused."""
    agrees_in_range: bool = True
    """Whether the range, if there is one, agrees with the estimate: neither too short nor absurdly
    long."""
    agrees_in_bearing: bool = True
    """The same of the bearing."""

    @property
    def is_open(self) -> bool:
        """Whether all that was measured is fused."""
        return self.passes_range and self.passes_bearing

    @property
    def agrees(self) -> bool:
        """Whether all that was measured agrees with the estimate."""
        return self.agrees_in_range and self.agrees_in_bearing

    @classmethod
    def of(cls, report: UpdateReport, inflation: Inflation) -> Gate:
        """The gate's judgement of an update.

        Args:
            report: Of the update.
            inflation: Variance inflation of range, bearing and elevation in force at the update.
        """
        ranged = _in_sigmas(report.range, inflation[0])
        borne = _in_sigmas(report.bearing, inflation[1])
        is_short, is_off = ranged < -GATE_SIGMAS, abs(borne) > GATE_SIGMAS
        return cls(
            passes_range=not is_short,
            passes_bearing=not is_off,
            agrees_in_range=not is_short and ranged <= LONG_SIGMAS,
            agrees_in_bearing=not is_off,
        )

    def unarmed(self) -> Gate:
        """The same judgement with nothing kept out, while the estimate has yet to prove itself."""
        return replace(self, passes_range=True, passes_bearing=True)

    def joined(self, other: Gate) -> Gate:
        """The judgement of two hypotheses: what either can explain is no outlier."""
        return Gate(
            self.passes_range or other.passes_range,
            self.passes_bearing or other.passes_bearing,
            self.agrees_in_range or other.agrees_in_range,
            self.agrees_in_bearing or other.agrees_in_bearing,
        )

    @property
    def refusal(self) -> Refusal:
        """What a measurement that does not pass is counted as."""
        return Refusal.BEARING_OUTLIER if self.passes_range else Refusal.RANGE_OUTLIER

    def passed(self, measurement: RangingMeasurement) -> RangingMeasurement | None:
        """What of a measurement is fused; None: nothing."""
        if self.is_open:
            return measurement
        if not self.passes_range:
            measurement = replace(measurement, range_m=None)
        if not self.passes_bearing:
            measurement = replace(measurement, bearing_enu_rad=None, bearing_body_rad=None)
        has_any = measurement.range_m is not None or measurement.bearing_enu_rad is not None
        return measurement if has_any else None


OPEN = Gate()


def _in_sigmas(report: ModalityReport | None, inflation: float) -> float:
    """The innovation in its own standard deviations; 0 where nothing was measured."""
    if report is None:
        return 0.0
    return report.innovation / (report.noise_sigma * math.sqrt(inflation + report.prior_share))
