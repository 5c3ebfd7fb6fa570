"""Are bearings in radians? Their scatter tells.

In degrees a bearing is mostly more than half a turn, which is refused, or turns at random, because
two degrees of noise are more than a hundred then. Divided instead, it hardly leaves zero, whatever
the vehicle flies by: a direction finder that is quiet beside its own noise measures nothing.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

from companion.domain import PositionEnu
from companion.geometry.frames import wrap_pi

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
        """Take in a bearing, and judge now and then.

        Args:
            time_s: When it was measured.
            bearing_rad: As the radio has it.
            sigma_rad: Its noise.
            sensor_enu_m: Where the antenna was.
        """
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
