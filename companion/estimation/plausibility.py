"""What can be said against measurements without any estimate: frozen, absurd, in a wrong unit.

Frozen values are as good as none. Values in a wrong unit are not fused either, but they also speak
against flying at all: a radio that is read wrongly may be read wrongly in other ways, too.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

from companion.domain import PositionEnu, RangingMeasurement
from companion.estimation.bearing_check import BearingCheck
from companion.estimation.filter_params import FilterParams
from companion.estimation.frozen import FrozenValue
from companion.estimation.objections import Objection
from companion.estimation.refusal import Refusal
from companion.estimation.unit_check import UnitCheck

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
    reason: Refusal | None = None
    """Why not all of it."""


class Plausibility:
    """Watches the raw values of one emitter.

    Args:
        params: What is believed of the radio.
        max_range_m: No target is farther.
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

    def refused(self, reason: Refusal, now_s: float) -> None:
        """Note a measurement that was refused by itself."""
        if reason is Refusal.RANGE_ABSURD:
            self._absurd_ranges.add(now_s, is_absurd=True)
        elif reason is Refusal.BEARING_ABSURD:
            self._absurd_bearings.add(now_s, is_absurd=True)

    def judge(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> Judgement:
        """What of a measurement may be used.

        Args:
            measurement: Its bearing, if any, in ENU, and in the body frame if it came in that.
            sensor_enu_m: Where the antenna was at its time.
            now_s: The present.
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
    ) -> Refusal | None:
        range_m, time_s = measurement.range_m, measurement.measured_at_s
        if range_m is None:
            return None
        self._absurd_ranges.add(now_s, is_absurd=False)
        if self._frozen_range.add(range_m, time_s, sensor_enu_m):
            return Refusal.FROZEN
        self._units.add(time_s, range_m, sensor_enu_m)
        return Refusal.WRONG_UNIT if self._units.is_condemned else None

    def _bearing_reason(
        self, measurement: RangingMeasurement, sensor_enu_m: PositionEnu, now_s: float
    ) -> Refusal | None:
        m = measurement
        raw_rad = m.bearing_enu_rad if m.bearing_body_rad is None else m.bearing_body_rad
        if raw_rad is None or m.bearing_enu_rad is None:
            return None
        self._absurd_bearings.add(now_s, is_absurd=False)
        if self._frozen_bearing.add(raw_rad, m.measured_at_s, sensor_enu_m):
            return Refusal.FROZEN
        height_m = abs(sensor_enu_m[2] - self._params.target_height_m)
        if m.range_m is None or m.range_m > STEEP_RATIO * height_m:
            _, sigma_rad, _ = self._params.seen_sigmas(m)
            self._bearings.add(m.measured_at_s, raw_rad, sigma_rad, sensor_enu_m)
        return Refusal.WRONG_UNIT if self._bearings.is_condemned else None
