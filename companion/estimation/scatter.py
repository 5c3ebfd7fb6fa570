"""Scatter of successive measurements: the least noise that an unknown radio can have.

Theory of operation. A radio that is not configured may report a standard deviation that it cannot
hold, by an error or by forgery, and a measurement that claims a micrometre outweighs all others.
Noise also shows without an estimate: a value differs from the line between its neighbours by its
own error and theirs, and hardly by the vehicle's motion. The median of these differences does not
move with a few forged ones. Reflections, which change slowly, do not show: this is a lower limit.

Sources: J. von Neumann et al., Annals of Mathematical Statistics 12 (1941), for the variance from
successive differences; F. R. Hampel, J. American Statistical Association 69 (1974), for the median.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import replace

from companion.domain import RangingMeasurement
from companion.estimation.filters.target_filter import FilterParams

NORMAL_OF_MEDIAN = 1.482602218505602
"""Standard deviation of a normal distribution over the median of its absolute values."""
MIN_COUNT, MAX_COUNT = 12, 60
"""Fewest and most differences: of 60, the median is known to a seventh."""
LONGEST_GAP_S = 2.0
"""Time between three neighbours beyond which the vehicle's motion is no line."""


class Scatter:
    """Scatter of one component of a radio's measurements."""

    def __init__(self, *, is_angle: bool = False) -> None:
        self._is_angle = is_angle
        self._latest: deque[tuple[float, float]] = deque(maxlen=3)
        self._differences: deque[float] = deque(maxlen=MAX_COUNT)

    def add(self, time_s: float, value: float) -> None:
        """Add a value; one that is not later than the one before is a repetition."""
        latest = self._latest
        if latest and time_s <= latest[-1][0]:
            return
        latest.append((time_s, value))
        if len(latest) < 3 or time_s - latest[0][0] > LONGEST_GAP_S:
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
        if len(self._differences) < MIN_COUNT:
            return None
        return NORMAL_OF_MEDIAN * statistics.median(self._differences)


class ReportedSigmas:
    """Limits of the standard deviations that a radio reports, if none is configured."""

    def __init__(self) -> None:
        self._scatters = Scatter(), Scatter(is_angle=True), Scatter(is_angle=True)

    def limited(self, measurement: RangingMeasurement, params: FilterParams) -> RangingMeasurement:
        """Return the measurement with the least standard deviations that count.

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
