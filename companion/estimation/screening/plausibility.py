"""What can be said against measurements without any estimate: frozen, absurd, in a wrong unit.

Frozen values are as good as none. Values in a wrong unit are not fused either, but they also speak
against flying at all: a radio that is read wrongly may be read wrongly in other ways, too.

Frozen: a value that stands still while the vehicle moves was not measured. A radio that hangs
repeats its last number with fresh stamps. Noise never repeats itself to the last bit, and a radio
with coarse numbers repeats them only while the vehicle hardly moves.

Bearings: their scatter tells whether they are in radians. In degrees a bearing is mostly more than
half a turn, which is refused, or turns at random, because two degrees of noise are more than a
hundred then. Divided instead, it hardly leaves zero, whatever the vehicle flies by: a direction
finder that is quiet beside its own noise measures nothing.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.screening.unit_check import UnitCheck
from companion.estimation.screening.validation import Objection, RejectReason
from companion.geometry.coordinates import wrap_pi

FROZEN_COUNT = 5
FROZEN_S = 1.0
FROZEN_M = 2.0
"""So many equal values in a row, over so much time and own motion, are frozen."""


class FrozenValue:
    """Watches one value of one radio."""

    def __init__(self) -> None:
        self._value: float | None = None
        self._since_s = 0.0
        self._since_enu_m: PositionEnu = (0.0, 0.0, 0.0)
        self._count = 0

    def clear(self) -> None:
        """Forget everything."""
        self._value = None

    def forget_samples(self) -> None:
        """The same: there is nothing else to keep."""
        self.clear()

    def add(self, value: float, time_s: float, sensor_enu_m: PositionEnu) -> bool:
        """Take in a value; whether it is frozen."""
        if value != self._value:
            self._value, self._count = value, 1
            self._since_s, self._since_enu_m = time_s, sensor_enu_m
            return False
        self._count += 1
        has_moved = math.dist(sensor_enu_m, self._since_enu_m) >= FROZEN_M
        return has_moved and self._count >= FROZEN_COUNT and time_s - self._since_s >= FROZEN_S


QUIET_S, RANDOM_S = 2.5, 4.0
"""How far back is looked for either."""
MIN_COUNT, MAX_COUNT = 16, 96
EVERY = 4
"""Bearings between two judgements."""
MIN_PATH_M = 5.0
"""Own motion before being quiet means anything."""
QUIET_SIGMAS = 1.0 / 6.0
"""Between the outer tenths of the bearings; noise alone makes it 2.6."""
RANDOM_COSINE = 0.1
"""Mean cosine of the turns from one bearing to the next: about 0 for bearings from anywhere, 0.36
with two outliers among five."""
RANDOM_COUNT = 32
"""Turns needed to tell the two."""


class BearingCheck:
    """Watches the bearings of one emitter."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float, PositionEnu]] = deque(maxlen=MAX_COUNT)
        self._since = 0
        self.is_quiet = False
        """Whether bearings stand still beside their own noise while the vehicle moves."""
        self.is_random = False
        """Whether each bearing points elsewhere than the one before."""

    @property
    def is_condemned(self) -> bool:
        """Whether bearings must not be used."""
        return self.is_quiet or self.is_random

    def clear(self) -> None:
        """Forget everything, a condemnation included."""
        self.forget_samples()
        self.is_quiet = self.is_random = False

    def forget_samples(self) -> None:
        """Forget what was measured, but not a condemnation."""
        self._samples.clear()
        self._since = 0

    def add(
        self, time_s: float, bearing_rad: float, sigma_rad: float, sensor_enu_m: PositionEnu
    ) -> None:
        """Take in a bearing, and judge now and then."""
        self._samples.append((time_s, bearing_rad, sigma_rad, sensor_enu_m))
        while len(self._samples) > MIN_COUNT and self._samples[0][0] < time_s - RANDOM_S:
            self._samples.popleft()
        self._since += 1
        if self._since < EVERY or len(self._samples) < MIN_COUNT:
            return
        self._since = 0
        self.is_random = self._looks_random()
        self._judge_quiet(time_s)

    def _looks_random(self) -> bool:
        bearings = [bearing for _, bearing, _, _ in self._samples]
        if len(bearings) <= RANDOM_COUNT:
            return False
        cosines = [math.cos(after - before) for before, after in pairwise(bearings)]
        return statistics.fmean(cosines) < RANDOM_COSINE

    def _judge_quiet(self, now_s: float) -> None:
        recent = [sample for sample in self._samples if sample[0] >= now_s - QUIET_S]
        if len(recent) < MIN_COUNT:
            recent = list(self._samples)[-MIN_COUNT:]
        bearings = [bearing for _, bearing, _, _ in recent]
        sigma_rad = statistics.median([sigma for _, _, sigma, _ in recent])
        middle = math.atan2(math.fsum(map(math.sin, bearings)), math.fsum(map(math.cos, bearings)))
        off = [wrap_pi(bearing - middle) for bearing in bearings]
        low, *_, high = statistics.quantiles(off, n=10, method="inclusive")
        if high - low >= QUIET_SIGMAS * sigma_rad:
            self.is_quiet = False
        elif _path_m([place for _, _, _, place in recent]) >= MIN_PATH_M:
            self.is_quiet = True


def _path_m(places: Sequence[PositionEnu]) -> float:
    return sum(math.dist(before, after) for before, after in pairwise(places))


ABSURD_S = 2.0
ABSURD_COUNT = 10
"""The window of absurd values holds at least so much time and so many values."""
STEEP_RATIO = 1.5
"""Nearer than this many heights the emitter is below, where bearings may point anywhere."""


class AbsurdShare:
    """How many of the last values of one kind were absurd."""

    def __init__(self) -> None:
        self._window: deque[tuple[float, bool]] = deque()
        self._absurd_count = 0

    def clear(self) -> None:
        """Forget everything."""
        self._window.clear()
        self._absurd_count = 0

    def add(self, time_s: float, *, is_absurd: bool) -> None:
        """Take in a value that arrived at a time."""
        self._window.append((time_s, is_absurd))
        self._absurd_count += is_absurd
        while len(self._window) > ABSURD_COUNT and self._window[0][0] < time_s - ABSURD_S:
            self._absurd_count -= self._window.popleft()[1]

    @property
    def is_most(self) -> bool:
        """Whether it is more than a half."""
        return len(self._window) >= ABSURD_COUNT and 2 * self._absurd_count > len(self._window)


@dataclass(frozen=True, slots=True)
class Judgement:
    """What of a measurement may be used."""

    passed: RangingMeasurement | None
    """None: nothing of it."""
    reason: RejectReason | None = None
    """Why not all of it."""


class Plausibility:
    """Watches the raw values of one emitter.

    Args:
        params: What is believed of the radio.
    """

    def __init__(self, params: FilterParams, max_range_m: float) -> None:
        self._params = params
        self._units = UnitCheck(params, max_range_m)
        self._bearings = BearingCheck()
        self._frozen_range, self._frozen_bearing = FrozenValue(), FrozenValue()
        self._absurd_ranges, self._absurd_bearings = AbsurdShare(), AbsurdShare()

    def clear(self) -> None:
        """Forget everything, condemnations included."""
        parts = (self._units, self._bearings, self._frozen_range, self._frozen_bearing)
        for part in (*parts, self._absurd_ranges, self._absurd_bearings):
            part.clear()

    def jumped(self) -> None:
        """The vehicle's own position jumped: nothing before it is compared with what follows."""
        parts = (self._units, self._bearings, self._frozen_range, self._frozen_bearing)
        for part in parts:
            part.forget_samples()

    @property
    def objection(self) -> Objection | None:
        """Why nothing should be flown on such values."""
        if self._units.is_condemned or self._absurd_ranges.is_most:
            return Objection.RANGE_UNIT
        if self._bearings.is_condemned or self._absurd_bearings.is_most:
            return Objection.BEARING_UNIT
        return None

    def refused(self, reason: RejectReason, now_s: float) -> None:
        """Note a measurement that was refused by itself."""
        if reason is RejectReason.RANGE_ABSURD:
            self._absurd_ranges.add(now_s, is_absurd=True)
        elif reason is RejectReason.BEARING_ABSURD:
            self._absurd_bearings.add(now_s, is_absurd=True)

    def judge(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> Judgement:
        """What of a measurement may be used.

        Args:
            measurement: Its bearing, if any, in ENU, and in the body frame if it came in that.
            sensor_enu_m: Where the antenna was at its time.
        """
        range_reason = self._range_reason(measurement, sensor_enu_m, now_s)
        bearing_reason = self._bearing_reason(measurement, sensor_enu_m, now_s)
        if range_reason is None and bearing_reason is None:
            return Judgement(measurement)
        passed = measurement
        if range_reason is not None:
            passed = replace(passed, range_m=None)
        if bearing_reason is not None:
            passed = replace(passed, bearing_enu_rad=None, bearing_body_rad=None)
        has_any = passed.range_m is not None or passed.bearing_enu_rad is not None
        return Judgement(passed if has_any else None, range_reason or bearing_reason)

    def _range_reason(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> RejectReason | None:
        range_m, time_s = measurement.range_m, measurement.measured_at_s
        if range_m is None:
            return None
        self._absurd_ranges.add(now_s, is_absurd=False)
        if self._frozen_range.add(range_m, time_s, sensor_enu_m):
            return RejectReason.FROZEN
        self._units.add(time_s, range_m, sensor_enu_m)
        return RejectReason.WRONG_UNIT if self._units.is_condemned else None

    def _bearing_reason(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> RejectReason | None:
        m = measurement
        raw_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
        if raw_rad is None or m.bearing_enu_rad is None:
            return None
        self._absurd_bearings.add(now_s, is_absurd=False)
        if self._frozen_bearing.add(raw_rad, m.measured_at_s, sensor_enu_m):
            return RejectReason.FROZEN
        height_m = abs(sensor_enu_m[2] - self._params.target_height_m)
        if m.range_m is None or m.range_m > STEEP_RATIO * height_m:
            _, sigma_rad, _ = self._params.seen_sigmas(m)
            self._bearings.add(m.measured_at_s, raw_rad, sigma_rad, sensor_enu_m)
        return RejectReason.WRONG_UNIT if self._bearings.is_condemned else None
