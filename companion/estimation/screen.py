"""Screen of raw measurements: invalid, repeated, frozen or in a wrong unit, with reasons.

It needs no estimate. An `Objection` forbids guidance on an estimate that exists: a radio that is
misread in one way may be misread in others, too.

Frozen: a value that stays constant while the vehicle moves was not measured. A radio that hangs
repeats its last number with fresh stamps. Noise never repeats itself to the last bit, and a radio
with coarse numbers repeats them only while the vehicle moves little compared to its steps.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import dataclass, replace
from enum import Enum

from companion.domain import (
    POWER_LIMITS_DBM,
    Params,
    PositionEnu,
    Positive,
    RangingMeasurement,
)
from companion.estimation.antenna import (
    ABOUT_VERTICAL,
    MAX_BEARING_RAD,
    MAX_ELEVATION_RAD,
    lost_direction,
)
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.unit_check import (
    BEARINGS,
    RANGES,
    BearingCheck,
    Sample,
    Sampling,
    UnitCheck,
)


class RejectReason(Enum):
    """Reason for rejecting a measurement; a rejected one does not change the filter."""

    OTHER_EMITTER = "other emitter"
    NOTHING_MEASURED = "nothing measured"
    NOT_FINITE = "not finite"
    DENORMAL = "denormal"
    RANGE_NOT_POSITIVE = "range not positive"
    RANGE_ABSURD = "range impossible in m"
    BEARING_ABSURD = "bearing impossible in rad"
    ELEVATION_ABSURD = "elevation impossible in rad"
    POWER_ABSURD = "received power impossible in dBm"
    SIGMA_NOT_POSITIVE = "sigma not positive"
    FROM_THE_FUTURE = "from the future"
    STALE = "stale"
    TOO_MANY = "too many at once"
    DUPLICATE = "duplicate"
    FROZEN = "frozen while the vehicle moves"
    WRONG_UNIT = "in a wrong unit, as it seems"
    RANGE_OUTLIER = "range too short for the estimate"
    BEARING_OUTLIER = "bearing off the estimate"
    POWER_OUTLIER = "signal too strong for the estimate"
    NO_POSITION = "vehicle position unknown at its time"
    NO_YAW = "vehicle yaw unknown at its time"
    NO_ATTITUDE = "vehicle roll, pitch or yaw unknown at its time"
    NO_ANTENNA = "angle of an antenna array that is not configured"
    BY_NORTH = "bearing by north, but an antenna array is configured"
    OUT_OF_VIEW = "outside the antenna's field of view"
    OWN_JUMP = "vehicle position or yaw jumped about its time"


class AcceptanceParams(Params, frozen=True):
    """Limits of a plausible and timely measurement."""

    max_range_m: Positive = 2000.0
    """Longest plausible range; a longer one is an error of the radio or of its unit."""
    max_age_s: Positive = 1.0
    """Maximum age of a measurement; a younger one is fused at its own time."""


FUTURE_TOLERANCE_S = 0.1
"""Error of clock synchronisation that is tolerated, s.

Chosen: less rejects all of a radio whose clock is ahead, more takes a measurement for newer than it
is.
"""


def reject_reason_of(
    measurement: RangingMeasurement, now_s: float, params: AcceptanceParams
) -> RejectReason | None:
    """Return the reason why the measurement is invalid by itself; None if it is valid."""
    m = measurement
    bearings = [b for b in (m.bearing_enu_rad, m.bearing_body_rad) if b is not None]
    ranges = [] if m.range_m is None else [m.range_m]
    elevations = [] if m.elevation_rad is None else [m.elevation_rad]
    reported = (m.range_sigma_m, m.bearing_sigma_rad, m.elevation_sigma_rad)
    sigmas = [sigma for sigma in reported if sigma is not None]
    powers = [] if m.power_dbm is None else [m.power_dbm]
    numbers = [*ranges, *bearings, *elevations, *powers, *sigmas]
    least_normal = 2.0**-126  # of float32: a smaller number, except zero, was no float
    if not (ranges or bearings or powers):
        return RejectReason.NOTHING_MEASURED
    if not all(map(math.isfinite, (*numbers, m.measured_at_s))):
        return RejectReason.NOT_FINITE
    checks = (
        ([v for v in numbers if 0.0 < abs(v) < least_normal], RejectReason.DENORMAL),
        (min(ranges, default=1.0) <= 0.0, RejectReason.RANGE_NOT_POSITIVE),
        (max(ranges, default=0.0) > params.max_range_m, RejectReason.RANGE_ABSURD),
        (max(map(abs, bearings), default=0.0) > MAX_BEARING_RAD, RejectReason.BEARING_ABSURD),
        (max(map(abs, elevations), default=0.0) > MAX_ELEVATION_RAD, RejectReason.ELEVATION_ABSURD),
        (
            powers and not POWER_LIMITS_DBM[0] <= powers[0] <= POWER_LIMITS_DBM[1],
            RejectReason.POWER_ABSURD,
        ),
        (min(sigmas, default=1.0) <= 0.0, RejectReason.SIGMA_NOT_POSITIVE),
        (m.measured_at_s > now_s + FUTURE_TOLERANCE_S, RejectReason.FROM_THE_FUTURE),
        (now_s - m.measured_at_s > params.max_age_s, RejectReason.STALE),
    )
    for is_wrong, reason in checks:
        if is_wrong:
            return reason
    return None


def identity_of(measurement: RangingMeasurement) -> Hashable:
    """Return the key that two copies of a measurement share; range and bearing may share a stamp.

    The bearing in ENU is not part of it, because it may be turned by a later yaw in a copy.
    """
    m = measurement
    bearing_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
    stamp = m.measured_at_s if m.stamp_us is None else m.stamp_us
    return (stamp, m.range_m, bearing_rad, m.elevation_rad, m.power_dbm)


class Objection(Enum):
    """Gravest reason against the estimate; the values are shown to the operator."""

    RANGE_UNIT = "ranges do not fit the vehicle's motion: wrong unit?"
    BEARING_UNIT = "bearings make no sense: wrong unit?"
    UNSTABLE = "the filter was reset twice within a minute"
    CONTRADICTED = "measurements do not agree with the estimate"
    RECOVERING = "the filter is recovering from a contradiction"


FROZEN_COUNT = 5
"""Equal values in a row before a value may be frozen."""
FROZEN_S = 1.0
"""Minimum duration of equal values before they are frozen, s."""
FROZEN_M = 2.0
"""Minimum motion of the vehicle during equal values before they are frozen, m.

Less drops a true value that happens to repeat, more uses a wrong one: on recorded walks a value is
the same up to 6 times and for up to 1.6 m, and that of a receiver that hangs for good.
"""


class FrozenValue:
    """Detector of a value of one radio that stays constant while the vehicle moves."""

    def __init__(self, least_m: float = FROZEN_M) -> None:
        self._least_m = least_m
        """Motion of the vehicle after which equal values are frozen."""
        self._value: float | None = None
        self._since_s = 0.0
        self._since_enu_m: PositionEnu = (0.0, 0.0, 0.0)
        self._count = 0

    def add(self, value: float, time_s: float, sensor_enu_m: PositionEnu) -> bool:
        """Process a value; return True if it is frozen."""
        if value != self._value:
            self._value, self._count = value, 1
            self._since_s, self._since_enu_m = time_s, sensor_enu_m
            return False
        self._count += 1
        has_moved = math.dist(sensor_enu_m, self._since_enu_m) >= self._least_m
        return has_moved and self._count >= FROZEN_COUNT and time_s - self._since_s >= FROZEN_S


class SampleHistory:
    """Latest values of one kind, from which a check of their unit is made periodically."""

    def __init__(self, sampling: Sampling, check: UnitCheck | BearingCheck) -> None:
        self.check = check
        self._sampling = sampling
        self._samples: deque[Sample] = deque(maxlen=sampling.most)
        self._since = 0

    def add(self, sample: Sample) -> None:
        """Process a value as reported, and check the unit if that is due."""
        samples, (span_s, least, _, every) = self._samples, self._sampling
        samples.append(sample)
        while len(samples) > least and samples[0].time_s < sample.time_s - span_s:
            samples.popleft()
        self._since += 1
        if self._since >= every and len(samples) >= least:
            self._since = 0
            self.check.judge(samples)


class RecentShare:
    """Share of the latest measurements, or of values of one kind, for which something is true."""

    def __init__(self) -> None:
        self._window: deque[tuple[float, bool]] = deque()
        self._true_count = 0
        self.share: float | None = None
        """Share of them; None: too few so far."""
        self.is_most = False
        """True if the share exceeds a half."""

    def add(self, time_s: float, *, is_true: bool) -> None:
        """Add one that arrived at this time."""
        self._window.append((time_s, is_true))
        self._true_count += is_true
        # where 80 % are true, one of ten or none is once in 240,000; ten also of a slow radio
        least_s, least = 2.0, 10
        while len(self._window) > least and self._window[0][0] < time_s - least_s:
            self._true_count -= self._window.popleft()[1]
        count = len(self._window)
        if count >= least:  # as in all that follow: only a longer window is shortened
            self.share = self._true_count / count
            self.is_most = self.share > 0.5


@dataclass(frozen=True, slots=True)
class Judgement:
    """Result of the screen for one measurement."""

    passed: RangingMeasurement | None
    """Components that may be used; None: none."""
    reason: RejectReason | None = None
    """Reason if not all of it may be used."""
    is_newly_objected: bool = False
    """True if an objection begins with this measurement: earlier ones were no better."""


class MeasurementScreen:
    """Screen of one emitter's raw measurements."""

    def __init__(self, params: FilterParams, acceptance: AcceptanceParams) -> None:
        self.rejected: Counter[RejectReason] = Counter()
        """Counts of measurements, or components of them, that were not fused, by reason."""
        self.has_body_bearings = False
        """True if the newest bearing is relative to the vehicle's heading."""
        self._params, self._acceptance = params, acceptance
        self.objection: Objection | None = None
        """Reason not to use such values for guidance; None if there is none."""
        self.clear()

    def clear(self) -> None:
        """Forget all measurements and results."""
        self._recent: dict[Hashable, None] = {}
        """Identities of the latest valid measurements, oldest first."""
        self._units = UnitCheck(self._params, self._acceptance.max_range_m)
        self._bearings = BearingCheck()
        self._absurd_ranges, self._absurd_bearings = RecentShare(), RecentShare()
        self.objection = None
        self.forget_motion()

    def forget_motion(self) -> None:
        """Forget positions from before a jump of the vehicle's navigation."""
        self._ranges = SampleHistory(RANGES, self._units)
        self._directions = SampleHistory(BEARINGS, self._bearings)
        # two steps, because motion across the line of sight changes no range
        least_m = max(FROZEN_M, 2.0 * self._params.range_step_m)
        self._frozen_range, self._frozen_bearing = FrozenValue(least_m), FrozenValue()
        self._frozen_power = FrozenValue(50.0)  # m: two steps of 1 dB at 300 m and exponent 3

    def _present_objection(self) -> Objection | None:
        if self._units.is_rejected or self._absurd_ranges.is_most:
            return Objection.RANGE_UNIT
        if self._bearings.is_rejected or self._absurd_bearings.is_most:
            return Objection.BEARING_UNIT
        return None

    def admit(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu | None, now_s: float
    ) -> RejectReason | None:
        """Return the reason to refuse a measurement; None if it is valid and new: remembered."""
        reason = reject_reason_of(measurement, now_s, self._acceptance)
        identity = identity_of(measurement)
        if reason is None and identity in self._recent:
            reason = RejectReason.DUPLICATE
        elif reason is None and not (sensor_enu_m and all(map(math.isfinite, sensor_enu_m))):
            reason = RejectReason.NO_POSITION
        elif reason is None and measurement.range_m is None and measurement.power_dbm is None:
            reason = self._lost_direction(measurement)
        if reason is RejectReason.RANGE_ABSURD:
            self._absurd_ranges.add(now_s, is_true=True)
        elif reason is RejectReason.BEARING_ABSURD:
            self._absurd_bearings.add(now_s, is_true=True)
        if reason is None:
            self._recent[identity] = None
            if len(self._recent) > 256:  # 2.5 s of a radio of 100 Hz
                del self._recent[next(iter(self._recent))]
        else:
            self.objection = self._present_objection()
        return reason

    def _lost_direction(self, measurement: RangingMeasurement) -> RejectReason | None:
        """Return the reason why a bearing gives no direction; None if it does, or if absent."""
        antenna = self._params.antenna
        loss = lost_direction(measurement, antenna)
        if measurement.has_direction and loss != "north":
            return None
        match loss:
            case "north":
                return RejectReason.BY_NORTH
            case "array":
                return RejectReason.NO_ANTENNA
            case "arcsine":
                return RejectReason.BEARING_ABSURD
            case "view":
                return RejectReason.OUT_OF_VIEW
        is_turned_by_yaw = antenna.kind in ABOUT_VERTICAL
        return RejectReason.NO_YAW if is_turned_by_yaw else RejectReason.NO_ATTITUDE

    def judge(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> Judgement:
        """Return the usable components of a valid measurement; body bearings have an ENU one."""
        was_plausible = self.objection is None
        range_reason = self._range_reason(measurement, sensor_enu_m, now_s)
        bearing_reason = self._bearing_reason(measurement, sensor_enu_m, now_s)
        self.objection = self._present_objection()
        is_new = was_plausible and self.objection is not None
        passed, power_dbm = measurement, measurement.power_dbm
        if range_reason is not None:
            passed = replace(passed, range_m=None)
        if bearing_reason is not None:
            passed = passed.without_direction()
        reason, time_s = range_reason or bearing_reason, measurement.measured_at_s
        if power_dbm is not None and self._frozen_power.add(power_dbm, time_s, sensor_enu_m):
            passed, reason = replace(passed, power_dbm=None), reason or RejectReason.FROZEN
        is_any_left = passed is measurement or passed.has_any
        return Judgement(passed if is_any_left else None, reason, is_new)

    def _range_reason(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> RejectReason | None:
        range_m, time_s = measurement.range_m, measurement.measured_at_s
        if range_m is None:
            return None
        self._absurd_ranges.add(now_s, is_true=False)
        if self._frozen_range.add(range_m, time_s, sensor_enu_m):
            return RejectReason.FROZEN
        self._ranges.add(Sample(time_s, range_m, sensor_enu_m))
        return RejectReason.WRONG_UNIT if self._units.is_rejected else None

    def _bearing_reason(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> RejectReason | None:
        m = measurement
        raw_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
        if raw_rad is None:
            return None
        is_plain = m.bearing_enu_rad is not None and self._params.antenna.kind in ABOUT_VERTICAL
        lost = None if is_plain else self._lost_direction(m)
        if lost is not None:
            return lost
        self._absurd_bearings.add(now_s, is_true=False)
        if self._frozen_bearing.add(raw_rad, m.measured_at_s, sensor_enu_m):
            return RejectReason.FROZEN
        height_m = abs(sensor_enu_m[2] - self._params.target_height_m)
        # less than 42 degrees below the horizon: nearer to the vertical, bearings are arbitrary
        is_flat = m.range_m is not None and m.range_m > 1.5 * height_m
        # without a range only azimuths about the vertical can be tested: the steepness is unknown
        if is_flat or (m.range_m is None and m.array is None):
            _, sigma_rad, _ = self._params.effective_sigmas(m)
            self._directions.add(Sample(m.measured_at_s, raw_rad, sensor_enu_m, sigma_rad))
        if self._bearings.is_rejected:
            return RejectReason.WRONG_UNIT
        self.has_body_bearings = m.bearing_body_rad is not None
        return None
