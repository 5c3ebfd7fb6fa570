"""Which measurements never reach a filter, and why: validity checks and the validation gate.

An `Objection` is why an estimate must not be flown on, although there is one.

The gate tells which innovations a believable estimate can explain. An innovation is judged in
standard deviations of the estimate's own uncertainty and of the noise that the run has shown.
Reflections make ranges longer by any amount and are the robust loss's task, but no path is shorter
than the straight one: a range that is too short by more than the gate is wrong, and so is a bearing
that is off by more. Those are not fused. A range that is longer than reflections make it is fused,
because the loss holds it at bay, but agrees with nothing.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, replace
from enum import Enum

from companion.domain import Params, Positive, RangingMeasurement
from companion.estimation.filters.target_filter import Inflation, ModalityReport, UpdateReport


class RejectReason(Enum):
    """Why a measurement was refused; the filter is untouched by it."""

    OTHER_EMITTER = "other emitter"
    NOTHING_MEASURED = "nothing measured"
    NOT_FINITE = "not finite"
    DENORMAL = "denormal"
    RANGE_NOT_POSITIVE = "range not positive"
    RANGE_ABSURD = "range absurd"
    BEARING_ABSURD = "bearing absurd"
    ELEVATION_ABSURD = "elevation absurd"
    SIGMA_NOT_POSITIVE = "sigma not positive"
    FROM_THE_FUTURE = "from the future"
    STALE = "stale"
    TOO_MANY = "too many at once"
    DUPLICATE = "duplicate"
    FROZEN = "frozen while the vehicle moves"
    WRONG_UNIT = "in a wrong unit, as it seems"
    RANGE_OUTLIER = "range too short for the estimate"
    BEARING_OUTLIER = "bearing off the estimate"
    NO_POSITION = "own position unknown at its time"
    NO_YAW = "own yaw unknown at its time"
    OWN_JUMP = "own position or yaw jumped about its time"


class AcceptanceParams(Params, frozen=True):
    """What counts as a plausible and timely measurement."""

    max_range_m: Positive = 2000.0
    """A longer range is a fault of the radio or its unit."""
    max_age_s: Positive = 1.0
    """An older measurement is refused; a younger one is fused at its own time."""


FUTURE_TOLERANCE_S = 0.1
MAX_ELEVATION_RAD = 0.5 * math.pi + 1e-6
"""A right angle, which in the wire's 32 bits is a little more than one."""
MAX_BEARING_RAD = math.pi + 1e-6
"""Half a turn, in the same way; more is most likely another unit."""
LEAST_NORMAL = 2.0**-126
"""Of 32 bits. Nothing is measured as finely: what is smaller, but not zero, was no float."""


def reject_reason_of(
    measurement: RangingMeasurement, now_s: float, params: AcceptanceParams
) -> RejectReason | None:
    """Why the measurement cannot be used, judged by itself, or None if it can."""
    m = measurement
    values = (m.range_m, m.bearing_enu_rad, m.bearing_body_rad)
    if all(value is None for value in values):
        return RejectReason.NOTHING_MEASURED
    sigmas = (m.range_sigma_m, m.bearing_sigma_rad, m.elevation_sigma_rad)
    measured = [v for v in (*values, m.elevation_rad, *sigmas) if v is not None]
    if not all(map(math.isfinite, (*measured, m.measured_at_s))):
        return RejectReason.NOT_FINITE
    if any(0.0 < abs(number) < LEAST_NORMAL for number in measured):
        return RejectReason.DENORMAL
    if m.range_m is not None and m.range_m <= 0.0:
        return RejectReason.RANGE_NOT_POSITIVE
    if m.range_m is not None and m.range_m > params.max_range_m:
        return RejectReason.RANGE_ABSURD
    bearings = (m.bearing_enu_rad, m.bearing_body_rad)
    if any(b is not None and abs(b) > MAX_BEARING_RAD for b in bearings):
        return RejectReason.BEARING_ABSURD
    if m.elevation_rad is not None and abs(m.elevation_rad) > MAX_ELEVATION_RAD:
        return RejectReason.ELEVATION_ABSURD
    if any(sigma is not None and sigma <= 0.0 for sigma in sigmas):
        return RejectReason.SIGMA_NOT_POSITIVE
    if m.measured_at_s > now_s + FUTURE_TOLERANCE_S:
        return RejectReason.FROM_THE_FUTURE
    if now_s - m.measured_at_s > params.max_age_s:
        return RejectReason.STALE
    return None


def identity_of(measurement: RangingMeasurement) -> Hashable:
    """What two copies of one measurement share: the stamp alone is shared by range and bearing.

    Not the bearing that was turned from the body frame, because a copy may see a later yaw.
    """
    m = measurement
    bearing_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
    stamp = m.measured_at_s if m.stamp_us is None else m.stamp_us
    return (stamp, m.range_m, bearing_rad, m.elevation_rad)


class Objection(Enum):
    """The gravest of what speaks against the estimate; values are for the operator."""

    RANGE_UNIT = "ranges do not fit the own motion: wrong unit?"
    BEARING_UNIT = "bearings make no sense: wrong unit?"
    UNSTABLE = "the filter was started anew twice within a minute"
    CONTRADICTED = "measurements do not agree with the estimate"
    RECOVERING = "the filter is recovering from a contradiction"


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
    def refusal(self) -> RejectReason:
        """What a measurement that does not pass is counted as."""
        return RejectReason.BEARING_OUTLIER if self.passes_range else RejectReason.RANGE_OUTLIER

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
