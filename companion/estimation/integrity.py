"""Evidence about an estimate and its radio: contact, agreement, contradictions, NIS, scatter.

Contact is the latest reception of the emitter: the age of each kind of measurement, and how many
agree. Agreement is the share of the latest measurements that fit the estimate at all; a
contradiction is a run of measurements that a confident estimate cannot explain.

Divergence. An estimate may also fail gradually, for instance because the target moves: innovations
are then merely too large, until the measured inflation has grown to hide them. So the NIS of the
last seconds is tested against its band: its median, because outliers are left to the gate, and
without ranges that are identified as reflections.

Scatter of successive measurements is the least noise that an unknown radio can have. A radio that
is not configured may report a standard deviation that it cannot hold, by an error or by forgery,
and a measurement that claims a micrometre outweighs all others. Noise also shows without an
estimate: a value differs from the line between its neighbours by its own error and theirs, and
hardly by the vehicle's motion. The median of these differences does not move with a few forged
ones. Reflections, which change slowly, do not show: this is a lower limit.

Sources: J. von Neumann et al., Annals of Mathematical Statistics 12 (1941), for the variance from
successive differences; F. R. Hampel, J. American Statistical Association 69 (1974), for the median.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, replace

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams, Inflation, UpdateReport
from companion.estimation.innovations import OPEN, Gate, mean_band
from companion.estimation.screen import Objection, RecentShare
from companion.estimation.window.antenna_check import MIN_DIRECTIONS, ConfiguredAntennaCheck
from companion.estimation.window.sandwich import MIN_MEASUREMENTS
from companion.estimation.window.shared_errors import GAP_S


@dataclass(frozen=True, slots=True)
class Contact:
    """Latest reception of the emitter, in times of measurement on the companion's clock.

    Only measurements that agree with the estimate count, not rejected ones, outliers or frozen
    values. Before there is an estimate, everything agrees.
    """

    range_s: float | None = None
    """Time of the newest range; None: none yet."""
    bearing_s: float | None = None
    agreeing: int = 0
    """Measurements that agreed since the last gap, or since the first one."""
    power_s: float | None = None
    newest_s: float | None = None
    """Time of the newest measurement of any kind; None: none yet."""

    def after(self, at_s: float, measured: tuple[bool, bool, bool], gate: Gate) -> Contact:
        """Return the contact after a measurement, which may be late.

        `measured` is true for each of range, direction and power that it has.
        """
        newest_s = self.newest_s
        agrees = gate.agrees_in_range, gate.agrees_in_bearing, gate.agrees_in_power
        counts = [has and fits for has, fits in zip(measured, agrees, strict=True)]
        if True not in counts:
            return self
        is_gap = newest_s is not None and at_s - newest_s > GAP_S
        agreeing = (0 if is_gap else self.agreeing) + all(agrees)
        of_each = (self.range_s, self.bearing_s, self.power_s, newest_s)
        range_s, bearing_s, power_s, newest_s = [
            before_s if not is_new else at_s if before_s is None else max(before_s, at_s)
            for before_s, is_new in zip(of_each, (*counts, True), strict=True)
        ]
        return Contact(range_s, bearing_s, agreeing, power_s, newest_s)

    def is_interrupted(self, now_s: float) -> bool:
        """Return True during a gap, and before the first contact."""
        newest_s = self.newest_s
        return newest_s is None or now_s - newest_s > GAP_S

    def agreeing_since_gap(self, now_s: float) -> int:
        """Return the number of measurements that agreed since the last gap; 0 during a gap."""
        return 0 if self.is_interrupted(now_s) else self.agreeing

    def range_age_s(self, now_s: float) -> float | None:
        """Return the age of the newest range; None: none yet."""
        return None if self.range_s is None else max(now_s - self.range_s, 0.0)

    def bearing_age_s(self, now_s: float) -> float | None:
        """Return the age of the newest bearing; None: none yet."""
        return None if self.bearing_s is None else max(now_s - self.bearing_s, 0.0)


PROVEN_COUNT = MIN_DIRECTIONS
"""Measurements that agreed before an estimate may reject outliers: as many as decide about an
antenna, 4 s of a radio of 10 Hz."""
CONTRADICTION_COUNT = PROVEN_COUNT
"""Consecutive contradicting measurements at which the track is discarded: as many as proved it.
Recorded walks reach 3, flights in rubble 7."""
CONTRADICTION_U = 3.0
"""Whitened innovation of a contradiction, in sigma: a bearing off to the same side, or a range too
short. Of normal errors one in 700 is, on each side."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Runs of measurements that contradict in the same way, ranges and bearings apart."""

    bearings: int = 0
    side: float = 0.0
    """Direction in which those bearings are off: +-1, or 3 where they point the other way."""
    ranges: int = 0
    """Ranges that are too short; long ones do not contradict, because reflections make them."""
    rejected_ranges: int = 0
    """Ranges that did not pass the gate: a long run of them is not a run of outliers."""
    rejected_bearings: int = 0
    is_conclusive: bool = False
    """True if the track should be discarded."""

    def after(self, report: UpdateReport, inflation: Inflation, gate: Gate = OPEN) -> Contradiction:
        """Return the counts after one more update."""
        bearings, side, ranges = self.bearings, self.side, self.ranges
        rejected_ranges, rejected_bearings = self.rejected_ranges, self.rejected_bearings
        ranged, borne, *_ = report.modalities
        range_u, bearing_u = [
            0.0  # the state's uncertainty dominates the innovation
            if row is None or row.prior_share >= 1.0
            else row.whitened_innovation / math.sqrt(c)
            for row, c in zip((ranged, borne), inflation, strict=False)
        ]
        if borne is not None:
            side = 0.0
            if abs(bearing_u) > CONTRADICTION_U:
                is_opposite = abs(borne.innovation) > 0.5 * math.pi
                side = 3.0 if is_opposite else math.copysign(1.0, bearing_u)
            bearings = 0 if side == 0.0 else (bearings + 1 if side == self.side else 1)
            rejected_bearings = 0 if gate.passes_bearing else rejected_bearings + 1
        if ranged is not None:
            ranges = ranges + 1 if range_u < -CONTRADICTION_U else 0
            rejected_ranges = 0 if gate.passes_range else rejected_ranges + 1
        counts = (ranges, rejected_ranges, rejected_bearings)
        is_conclusive = max(bearings, *counts) >= CONTRADICTION_COUNT
        return Contradiction(bearings, side, *counts, is_conclusive)


NIS_WINDOW_COUNT = PROVEN_COUNT
"""Minimum number of measurements in the NIS window, as many as prove an estimate."""
RESTART_MEMORY_S = 60.0
"""Time in which resets of the track are counted, s.

A shorter one misses a track that is discarded again and again, a longer one counts resets that have
nothing to do with each other; no recorded walk and none of 30 flights of the field has any.
"""


class NisWindow:
    """Normalised innovations squared of the last seconds, per degree of freedom.

    `TrackIntegrity` leaves out measurements on reflected paths.
    """

    def __init__(self) -> None:
        self._values: deque[tuple[float, float, int]] = deque()
        self._dof = 0
        """Degrees of freedom in the window."""
        self._above_since_s: float | None = None
        self._above_count = 0

    def add(self, report: UpdateReport, inflation: Inflation, time_s: float) -> bool:
        """Process an update; return True if the NIS was above its band for too long."""
        squares = [
            row.whitened_innovation**2 / (c / row.weight + row.prior_share)
            for row, c in zip(report.modalities, inflation, strict=False)
            if row is not None
        ]
        if not squares:
            return False
        self._values.append((time_s, statistics.fmean(squares), len(squares)))
        self._dof += len(squares)
        least_span_s = 3.0  # at high rates; 30 flights of the field are above for up to 2.9 s
        since_s = time_s - least_span_s
        while len(self._values) > NIS_WINDOW_COUNT and self._values[0][0] < since_s:
            self._dof -= self._values.popleft()[2]
        values = [value for _, value, _ in self._values]
        band = math.inf  # too few measurements
        if len(values) >= NIS_WINDOW_COUNT:
            dof = self._dof / len(values)
            band = mean_band(dof, len(values))[1] / dof
        if statistics.median(values) <= band:
            self._above_since_s = None
            self._above_count = 0
            return False
        if self._above_since_s is None:
            self._above_since_s = time_s
        self._above_count += 1
        # another whole window above the band, and of a slow radio ten values: one is chance
        has_lasted = time_s - self._above_since_s >= least_span_s and self._above_count >= 10
        # the window's median lags behind the end of an excursion, that of its newest five does not
        is_over = statistics.median(values[-5:]) <= band
        return has_lasted and not is_over


class TrackIntegrity:
    """Bookkeeping of how measurements agree with the estimate."""

    def __init__(self) -> None:
        self.contact = Contact()
        """Ages of the measurements, and the number that agreed since the last gap."""
        self.configured_antenna = ConfiguredAntennaCheck()
        """Consistency of the directions with the antenna, if one is configured."""
        self.restarts = 0
        """Number of tracks that were discarded."""
        self._restarts_s: deque[float] = deque(maxlen=2)
        """Latest resets, as many as forbid guidance on the estimate."""
        self._recovered_at = 0
        """Number of accepted measurements after which the estimate is trusted again."""
        self.reset()

    def reset(self) -> None:
        """Clear the evidence, because there is another estimate."""
        self._recent = RecentShare()
        """Share of the latest measurements that agree with the estimate."""
        self._agreed = self._since_lost = 0
        self._lost_s = 0.0
        self.is_proven = False
        """True if enough measurements agreed since the estimate began."""
        self.is_lost = False
        """True if hardly any measurement agrees with the estimate."""
        self._contradiction = Contradiction()
        self._nis = NisWindow()
        self._inflation_at_loss: Inflation | None = None
        """Measured inflation when agreement was lost; None if it is not lost."""

    def gate_inflation(self, measured: Inflation) -> Inflation:
        """Return the inflation that the gate works with.

        Once agreement is lost, the disagreement itself raises the measured inflation, until
        everything would agree again with an unfounded estimate. So it is capped at its value before
        the loss.
        """
        if self._inflation_at_loss is None:
            return measured
        return tuple(map(min, measured, self._inflation_at_loss))

    def begin(self, measurement: RangingMeasurement) -> None:
        """Count the first measurement of an estimate, which agrees by definition."""
        m = measurement
        measured = m.range_m is not None, m.has_direction, m.power_dbm is not None
        self.contact = self.contact.after(m.measured_at_s, measured, OPEN)

    def update(
        self, at_s: float, report: UpdateReport, gate: Gate, gate_inflation: Inflation
    ) -> bool:
        """Count how a measurement agrees; return True if the track should be discarded."""
        ranged, borne, _, *powers = report.modalities
        measured = ranged is not None, borne is not None, powers not in ([], [None])
        self.contact = self.contact.after(at_s, measured, gate)
        is_reflected = ranged is not None and ranged.weight < 1.0 and ranged.innovation > 0.0
        is_track_lost = self.note_agreement(at_s, agrees=gate.agrees)
        self._contradiction = self._contradiction.after(report, gate_inflation, gate)
        is_out_of_band = not is_reflected and self._nis.add(report, gate_inflation, at_s)
        if not self.is_lost:
            self._inflation_at_loss = None
        elif self._inflation_at_loss is None:
            self._inflation_at_loss = gate_inflation
        return self._contradiction.is_conclusive or is_track_lost or is_out_of_band

    def note_agreement(self, time_s: float, *, agrees: bool) -> bool:
        """Count a measurement; return True if agreement was lost for too long to keep the track."""
        self._agreed += agrees
        self.is_proven = self._agreed >= PROVEN_COUNT
        self._recent.add(time_s, is_true=agrees)
        share, was_lost = self._recent.share, self.is_lost
        if share is None:
            return False
        # apart, so that it does not change back and forth; 71 recorded walks stay above 0.6, and 30
        # flights of the field above 0.29
        self.is_lost = share < (0.5 if was_lost else 0.2)
        if not was_lost:
            self._lost_s, self._since_lost = time_s, 0
        self._since_lost += 1
        # less discards a track for one reflection, more flies on with a wrong one; none of 71 walks
        # and 30 flights is lost at all
        has_lasted = time_s - self._lost_s >= 5.0 and self._since_lost >= 20
        return self.is_lost and has_lasted

    def give_up(self, time_s: float, accepted: int) -> None:
        """Count a discarded track, and clear the evidence that led to it."""
        self.restarts += 1
        self._restarts_s.append(time_s)
        self._recovered_at = accepted + 1 + CONTRADICTION_COUNT
        self.reset()

    def forget(self) -> None:
        """Clear contact and antenna as well, because the frame may have moved."""
        self.contact = Contact()
        self.configured_antenna = ConfiguredAntennaCheck()
        self.reset()

    def is_recovering(self, accepted: int) -> bool:
        """Return True if the track was reset too recently to be trusted."""
        return accepted < self._recovered_at

    def objection(self, now_s: float) -> Objection | None:
        """Return the gravest reason not to use the estimate for guidance; None if there is none."""
        restarts_s = self._restarts_s
        is_full = len(restarts_s) == restarts_s.maxlen
        if is_full and now_s - restarts_s[0] <= RESTART_MEMORY_S:
            return Objection.UNSTABLE
        return Objection.CONTRADICTED if self.is_lost else None


class Scatter:
    """Scatter of one component of a radio's measurements."""

    def __init__(self, *, is_angle: bool = False) -> None:
        self._is_angle = is_angle
        self._latest: deque[tuple[float, float]] = deque(maxlen=3)
        self._differences: deque[float] = deque(maxlen=60)
        """Latest ones; of 60, the median is known to a seventh."""

    def add(self, time_s: float, value: float) -> None:
        """Add a value; one that is not later than the one before is a repetition."""
        latest = self._latest
        if latest and time_s <= latest[-1][0]:
            return
        latest.append((time_s, value))
        if len(latest) < 3 or time_s - latest[0][0] > GAP_S:
            return
        (t0, before), (t1, middle), (t2, after) = latest
        share = (t1 - t0) / (t2 - t0)
        one, other = middle - before, after - before
        if self._is_angle:
            one, other = math.remainder(one, math.tau), math.remainder(other, math.tau)
        scale = math.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
        self._differences.append(abs(one - share * other) / scale)

    @property
    def sigma(self) -> float | None:
        """Standard deviation of white noise with this scatter; None: too few values."""
        if len(self._differences) < MIN_MEASUREMENTS:
            return None
        normal_of_median = 1.482602218505602  # 1 / (75 % quantile): sigma over median deviation
        return normal_of_median * statistics.median(self._differences)


class ReportedSigmas:
    """Limits of the standard deviations that a radio reports, if none is configured."""

    def __init__(self) -> None:
        self._scatters = Scatter(), Scatter(is_angle=True), Scatter(is_angle=True)

    def limited(self, measurement: RangingMeasurement, params: FilterParams) -> RangingMeasurement:
        """Return the measurement with the smallest standard deviations that count.

        They are the scatter of its radio, or the assumed ones of `params` if these are smaller or
        the scatter is not known yet.
        """
        m, array = measurement, measurement.array
        direction = m.bearing_enu_rad if array is None else array.first
        elevation = m.elevation_rad if array is None else array.second
        least: list[float | None] = []
        for scatter, value, configured, assumed in zip(
            self._scatters,
            (m.range_m, direction, elevation),
            m.least_sigmas,
            params.configured_sigmas,
            strict=True,
        ):
            if value is not None:
                scatter.add(m.measured_at_s, value)
            seen = scatter.sigma
            shown = assumed if seen is None else min(assumed, seen)
            least.append(shown if configured is None else configured)
        return replace(m, least_sigmas=(least[0], least[1], least[2]))
