"""What speaks for and against an estimate: contact, agreement, contradictions, NIS, restarts.

Contact is what was heard of the emitter lately, the age of each kind and how much of it agrees.
Agreement is whether the measurements of the last seconds fit the estimate at all; a contradiction
is a run of them that a confident estimate cannot explain.

Divergence. An estimate may fail more gently, for instance because the target moves: innovations are
merely larger than they should be, until the measured inflation has grown to hide them. So the NIS
of the last seconds is held against its band: its median, because outliers are the gate's task, and
without ranges that are taken for reflections.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

from companion.domain import RangingMeasurement
from companion.estimation.filter_bank import OPEN, Gate
from companion.estimation.filters.target_filter import Inflation, ModalityReport, UpdateReport
from companion.estimation.noise.innovations import mean_band
from companion.estimation.screening.measurement_screen import Objection

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
    agreeing: int = 0
    """Measurements that agreed since the last gap, or since the first one."""

    def after(self, measurement: RangingMeasurement, gate: Gate) -> Contact:
        """With a measurement, its bearing in ENU; a late one makes nothing younger or older."""
        at_s, newest_s = measurement.measured_at_s, self.newest_s
        range_s, bearing_s = self.range_s, self.bearing_s
        has_range = measurement.range_m is not None and gate.agrees_in_range
        has_bearing = measurement.bearing_enu_rad is not None or measurement.array is not None
        has_bearing = has_bearing and gate.agrees_in_bearing
        if not (has_range or has_bearing):
            return self
        if has_range:
            range_s = at_s if range_s is None else max(range_s, at_s)
        if has_bearing:
            bearing_s = at_s if bearing_s is None else max(bearing_s, at_s)
        is_gap = newest_s is not None and at_s - newest_s > GAP_S
        return Contact(range_s, bearing_s, (0 if is_gap else self.agreeing) + gate.agrees)

    @property
    def newest_s(self) -> float | None:
        """When the newest measurement of any kind was made."""
        times_s = [time_s for time_s in (self.range_s, self.bearing_s) if time_s is not None]
        return max(times_s, default=None)

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


WINDOW_S = 2.0
WINDOW_COUNT = 10
"""The window holds at least so much time and so many measurements."""
PROVEN_COUNT = 40
"""An estimate that agreed with so many measurements has a say in which are outliers."""
LOST_SHARE, FOUND_SHARE = 0.2, 0.5
"""With less of the window agreeing than the first there is no agreement, until it is the second."""
HOPELESS_S, HOPELESS_COUNT = 5.0, 20
"""Without agreement for so long and so many measurements, the target is no longer where it was."""


class Agreement:
    """Counts which of the last measurements agreed."""

    def __init__(self) -> None:
        self._window: deque[tuple[float, bool]] = deque()
        self._agreed = 0
        self._lost_s = 0.0
        self._since_lost = 0
        self.is_proven = False
        """Whether enough measurements agreed since the estimate began."""
        self.is_lost = False
        """Whether next to nothing that is measured agrees with the estimate."""
        self.is_hopeless = False
        """Whether that has lasted so long that the estimate should be given up."""

    def add(self, time_s: float, *, agrees: bool) -> None:
        """Take in a measurement."""
        self._agreed += agrees
        self.is_proven = self._agreed >= PROVEN_COUNT
        self._window.append((time_s, agrees))
        while len(self._window) > WINDOW_COUNT and self._window[0][0] < time_s - WINDOW_S:
            self._window.popleft()
        if len(self._window) < WINDOW_COUNT:
            return
        share = sum(agreed for _, agreed in self._window) / len(self._window)
        was_lost = self.is_lost
        self.is_lost = share < (FOUND_SHARE if was_lost else LOST_SHARE)
        if not was_lost:
            self._lost_s, self._since_lost = time_s, 0
        self._since_lost += 1
        has_lasted = time_s - self._lost_s >= HOPELESS_S and self._since_lost >= HOPELESS_COUNT
        self.is_hopeless = self.is_lost and has_lasted


CONTRADICTION_COUNT = 40
"""How many measurements in a row must contradict the estimate before it is given up."""
CONTRADICTION_U = 3.0
"""Whitened innovation that contradicts: a bearing off to the same side, a range too short."""

BEHIND = 3.0
"""A bearing that is off to neither side (+-1), but points the other way."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How many measurements in a row contradicted in the same way, ranges and bearings apart."""

    bearings: int = 0
    side: float = 0.0
    """Where those bearings are off to: +-1 or `BEHIND`."""
    ranges: int = 0
    """Ranges that are too short; too long ones say nothing, because that is what reflections do."""
    rejected_ranges: int = 0
    """Ranges that did not pass the gate: a run of them is no run of outliers."""
    rejected_bearings: int = 0

    @property
    def is_conclusive(self) -> bool:
        """Whether the estimate should be given up."""
        counts = (self.bearings, self.ranges, self.rejected_ranges, self.rejected_bearings)
        return max(counts) >= CONTRADICTION_COUNT

    def after(self, report: UpdateReport, inflation: Inflation, gate: Gate = OPEN) -> Contradiction:
        """The counts after one more update."""
        bearings, side, ranges = self.bearings, self.side, self.ranges
        rejected_ranges, rejected_bearings = self.rejected_ranges, self.rejected_bearings
        if report.bearing is not None:
            side = _side(report.bearing, inflation[1])
            bearings = 0 if side == 0.0 else (bearings + 1 if side == self.side else 1)
            rejected_bearings = 0 if gate.passes_bearing else rejected_bearings + 1
        if report.range is not None:
            is_too_short = _whitened(report.range, inflation[0]) < -CONTRADICTION_U
            ranges = ranges + 1 if is_too_short else 0
            rejected_ranges = 0 if gate.passes_range else rejected_ranges + 1
        return Contradiction(bearings, side, ranges, rejected_ranges, rejected_bearings)


def _side(report: ModalityReport, inflation: float) -> float:
    u = _whitened(report, inflation)
    if abs(u) <= CONTRADICTION_U:
        return 0.0
    is_behind = abs(report.innovation) > 0.5 * math.pi
    return BEHIND if is_behind else math.copysign(1.0, u)


def _whitened(report: ModalityReport, inflation: float) -> float:
    """The innovation in standard deviations; 0 where the state's own uncertainty dominates."""
    if report.prior_share >= 1.0:
        return 0.0
    return report.whitened_innovation / math.sqrt(inflation)


NIS_WINDOW_S = 3.0
NIS_WINDOW_COUNT = 30
"""The window holds at least so much time and so many measurements."""
OUT_OF_BAND_S = 3.0
OUT_OF_BAND_COUNT = 10
"""The NIS must be above its band for at least so long and so many measurements in a row."""
NEWEST_COUNT = 5
"""So many of the newest say whether it still is."""
RESTART_MEMORY_S = 60.0
MAX_RESTARTS = 2
"""An estimate that was started anew this often within that time is not flown on."""


class NisWindow:
    """The normalised innovations squared of the last seconds, per degree of freedom."""

    def __init__(self) -> None:
        self._values: deque[tuple[float, float, int]] = deque()
        self._dof = 0
        """Degrees of freedom of all of them."""
        self._above_since_s: float | None = None
        self._above_count = 0

    def add(self, report: UpdateReport, inflation: Inflation, time_s: float) -> bool:
        """Take in an update, by the inflation shown; whether the NIS has been too high too long."""
        squares = _normalised_squares(report, inflation)
        if not squares:
            return False
        self._values.append((time_s, statistics.fmean(squares), len(squares)))
        self._dof += len(squares)
        while len(self._values) > NIS_WINDOW_COUNT and self._values[0][0] < time_s - NIS_WINDOW_S:
            self._dof -= self._values.popleft()[2]
        values = [value for _, value, _ in self._values]
        band = math.inf  # while there are too few
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
        has_lasted = time_s - self._above_since_s >= OUT_OF_BAND_S
        # the window is slow to see that it is over
        is_over = statistics.median(values[-NEWEST_COUNT:]) <= band
        return has_lasted and self._above_count >= OUT_OF_BAND_COUNT and not is_over


def _normalised_squares(report: UpdateReport, inflation: Inflation) -> list[float]:
    """Of each innovation over its variance; none where the range is taken for a reflection."""
    if _is_reflected(report):
        return []
    squares = []
    for row, c in zip(report.modalities, inflation, strict=True):
        if row is not None:
            squares.append(row.whitened_innovation**2 / (c / row.weight + row.prior_share))
    return squares


def _is_reflected(report: UpdateReport) -> bool:
    """Whether the range says that the signal came by another way; then so did its bearing."""
    row = report.range
    return row is not None and row.weight < 1.0 and row.innovation > 0.0


DETOUR_S = 15.0
"""How long a shadow may last before what is measured in it speaks against the estimate."""
KNOWN_RAD = math.radians(5.0)
"""An estimate that foretells a bearing this well, one standard deviation, knows better."""


def _is_detour(report: UpdateReport, gate: Gate) -> bool:
    """Whether the signal came around an edge: farther than it is, from somewhere else.

    That is what a shadow does, and the vehicle must fly out of it to know better. A range that is
    too long for any reflection is none of it, and what a vague estimate expects counts for nothing.
    """
    row = report.bearing
    if row is None or row.noise_sigma * math.sqrt(row.prior_share) > KNOWN_RAD:
        return False
    return _is_reflected(report) and gate.agrees_in_range and not gate.agrees_in_bearing


class TrackIntegrity:
    """Counts how measurements agree with the estimate that they meet."""

    def __init__(self) -> None:
        self.contact = Contact()
        """How old each kind of measurement is, and how many agreed since the last gap."""
        self.restarts = 0
        """How often the estimate was given up."""
        self._restarts_s: deque[float] = deque(maxlen=MAX_RESTARTS)
        self._recovered_at = 0
        """Measurements accepted until the estimate is believed again."""
        self.reset()

    def reset(self) -> None:
        """Forget what was counted for and against the estimate, because it is another one."""
        self.agreement = Agreement()
        self._contradiction = Contradiction()
        self._detour_since_s: float | None = None
        """Since when every measurement came on a detour; None: the newest did not."""
        self._nis = NisWindow()
        self._inflation_at_loss: Inflation | None = None
        """Shown when agreement was lost; None: it is not."""

    def judging(self, shown: Inflation) -> Inflation:
        """The inflation that measurements are judged by.

        Once next to nothing agrees, that itself inflates what the run shows, until everything would
        agree again with an estimate that nothing speaks for.
        """
        if self._inflation_at_loss is None:
            return shown
        range_, bearing, elevation = map(min, shown, self._inflation_at_loss)
        return (range_, bearing, elevation)

    def begin(self, measurement: RangingMeasurement) -> None:
        """Note the first measurement of an estimate, which agrees with everything."""
        self.contact = self.contact.after(measurement, OPEN)

    def note(
        self, measurement: RangingMeasurement, report: UpdateReport, gate: Gate, judging: Inflation
    ) -> bool:
        """Note how a measurement agrees; whether the estimate should be given up."""
        at_s = measurement.measured_at_s
        self.contact = self.contact.after(measurement, gate)
        if not (self.agreement.is_proven and _is_detour(report, gate)):
            self._detour_since_s = None
        elif self._detour_since_s is None:
            self._detour_since_s = at_s
        if self._detour_since_s is not None and at_s - self._detour_since_s < DETOUR_S:
            return False
        self.agreement.add(at_s, agrees=gate.agrees)
        self._contradiction = self._contradiction.after(report, judging, gate)
        is_out_of_band = self._nis.add(report, judging, at_s)
        if not self.agreement.is_lost:
            self._inflation_at_loss = None
        elif self._inflation_at_loss is None:
            self._inflation_at_loss = judging
        is_conclusive = self._contradiction.is_conclusive or self.agreement.is_hopeless
        return is_conclusive or is_out_of_band

    def give_up(self, time_s: float, accepted: int) -> None:
        """The estimate is started anew; what was counted against the old one is void."""
        self.restarts += 1
        self._restarts_s.append(time_s)
        self._recovered_at = accepted + 1 + CONTRADICTION_COUNT
        self.reset()

    def forget(self) -> None:
        """Forget the contact, too, because the frame may have moved."""
        self.contact = Contact()
        self.reset()

    def is_recovering(self, accepted: int) -> bool:
        """Whether the estimate was given up so few measurements ago that it is not believed."""
        return accepted < self._recovered_at

    def objection(self, now_s: float) -> Objection | None:
        """The gravest of what speaks against flying on the estimate."""
        restarts_s = self._restarts_s
        if len(restarts_s) == MAX_RESTARTS and now_s - restarts_s[0] <= RESTART_MEMORY_S:
            return Objection.UNSTABLE
        return Objection.CONTRADICTED if self.agreement.is_lost else None
