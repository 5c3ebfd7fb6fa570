"""Check of the autopilot's local against its global positions, and fit of their difference.

Theory of operation. LOCAL_POSITION_NED and GLOBAL_POSITION_INT come from one estimate, so the
position of the one, converted with the origin and the autopilot's projection, is that of the other
to two centimetres. Where it is not (another firmware, another origin than reported), reported
positions and setpoints would be off by as much. So pairs of one moment are compared all the time. A
difference is used once it is significant: as another projection, if one explains all pairs, which
then holds far away, too; otherwise as an offset and a scale of each axis, fitted by least squares
with a zero prior. A pair that differs from the one before counts only once the next one differs by
as much, so that a single wrong report enters no fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from companion.domain import MAX_COORDINATE_M, PositionEnu
from companion.geometry.coordinates import LocalOrigin, Projection

PAIR_SIGMA_M = 0.05
"""Error of a pair: 1e-7 degrees are a centimetre, and so is a millisecond at 10 m/s."""
ALIKE_M = 3.0 * math.sqrt(2.0) * PAIR_SIGMA_M
"""Three sigma of the difference of two pairs; farther apart one of them is wrong."""
PRIOR_OFFSET_M, PRIOR_SCALE = 10.0, 0.01
"""Prior standard deviations of the fitted offset, metres, and scale."""
MIN_PAIRS = 20
"""Minimum number of pairs before a fit is used: ten seconds of them."""
MIN_OFF_M = 0.1
"""Largest difference of positions that agree."""
RENEW_OFF_M = 0.05
"""Change of the current position above which a fit is replaced."""
EXPLAINED_M = 0.03
"""Root mean square difference below which a projection is the autopilot's."""
FARTHEST_OFF_M = 200.0
"""Difference beyond which the positions are in different frames, and nothing is fitted."""
MAX_GAP_S = 0.3
"""Longest interval of local positions over which one is interpolated."""


@dataclass(slots=True)
class _Line:
    """Fit `local = projected + offset + stretch * projected` by recursive least squares."""

    offset_m: float = 0.0
    stretch: float = 0.0
    _variance: list[float] = field(default_factory=lambda: [PRIOR_OFFSET_M**2, 0.0, PRIOR_SCALE**2])

    def add(self, projected_m: float, local_m: float) -> None:
        """Process a pair."""
        pp, ps, ss = self._variance
        to_offset, to_stretch = pp + ps * projected_m, ps + ss * projected_m
        total = to_offset + to_stretch * projected_m + PAIR_SIGMA_M**2
        rest_m = local_m - projected_m - self.at_m(projected_m)
        self.offset_m += to_offset / total * rest_m
        self.stretch += to_stretch / total * rest_m
        self._variance = [
            pp - to_offset * to_offset / total,
            ps - to_offset * to_stretch / total,
            ss - to_stretch * to_stretch / total,
        ]

    def at_m(self, projected_m: float) -> float:
        """Return the difference of the two at a position."""
        return self.offset_m + self.stretch * projected_m


class GeodesyFit:
    """Comparison of an autopilot's positions about the origin that it `reported`."""

    def __init__(self, reported: LocalOrigin) -> None:
        self.reported = reported
        self.off_m = 0.0
        """Difference of the newest pair without the fit."""
        self._lines = (_Line(), _Line(), _Line())
        self.origin = reported
        """Reported origin with the fit applied."""
        self._candidates = [replace(reported, projection=each) for each in Projection]
        self._squares_m2 = [0.0] * len(self._candidates)
        """Sum of squared differences of the pairs for each projection."""
        self._pairs = 0
        self._rest_m: PositionEnu = (0.0, 0.0, 0.0)
        """Local minus projected position of the pair before."""
        self._before: tuple[float, PositionEnu] | None = None
        self._latest: tuple[float, PositionEnu] | None = None
        self._waiting: tuple[float, tuple[float, float, float]] | None = None

    def note_local(self, stamp_s: float, enu_m: PositionEnu) -> bool:
        """Process a local position with the autopilot's stamp; return True if the fit changed."""
        east_m, north_m, up_m = map(abs, enu_m)
        if not (
            east_m <= MAX_COORDINATE_M and north_m <= MAX_COORDINATE_M and up_m <= MAX_COORDINATE_M
        ):
            return False
        self._before, self._latest = self._latest, (stamp_s, enu_m)
        return self._compare()

    def note_global(self, stamp_s: float, geodetic: tuple[float, float, float]) -> bool:
        """Process degrees and altitude in metres; return True if the fit changed."""
        self._waiting = (stamp_s, geodetic)
        return self._compare()

    def _compare(self) -> bool:
        """Compare a global position with the local ones around it; True if the fit changed."""
        if self._waiting is None or self._before is None or self._latest is None:
            return False
        (stamp_s, geodetic), (from_s, start) = self._waiting, self._before
        until_s, end = self._latest
        if stamp_s > until_s:
            return False
        self._waiting = None
        if not from_s <= stamp_s or not 0.0 < until_s - from_s <= MAX_GAP_S:
            return False
        share = (stamp_s - from_s) / (until_s - from_s)
        east, north, up = (a + share * (b - a) for a, b in zip(start, end, strict=True))
        return self._take(geodetic, (east, north, up))

    def _take(self, geodetic: tuple[float, float, float], local: PositionEnu) -> bool:
        projected = self.reported.enu_from_geodetic(*geodetic)
        (e, n, u), (pe, pn, pu) = local, projected
        before_m, self._rest_m = self._rest_m, (e - pe, n - pn, u - pu)
        off_m = math.hypot(*self._rest_m)
        if not off_m <= FARTHEST_OFF_M or math.dist(before_m, self._rest_m) > ALIKE_M:
            return False
        self.off_m = off_m
        for line, projected_m, local_m in zip(self._lines, projected, local, strict=True):
            line.add(projected_m, local_m)
        for number, candidate in enumerate(self._candidates):
            self._squares_m2[number] += (
                math.dist(candidate.enu_from_geodetic(*geodetic), local) ** 2
            )
        self._pairs += 1
        fitted = [p + line.at_m(p) for line, p in zip(self._lines, projected, strict=True)]
        least_m = MIN_OFF_M if self.origin == self.reported else RENEW_OFF_M
        is_near = math.dist(fitted, self.origin.enu_from_geodetic(*geodetic)) <= least_m
        if self._pairs < MIN_PAIRS or is_near:
            return False
        before, self.origin = self.origin, self._best(fitted[2] - projected[2])
        return self.origin != before

    def _best(self, up_m: float) -> LocalOrigin:
        """Return the origin that explains the pairs; `up_m` is local minus projected height."""
        least_m2, number = min((each, n) for n, each in enumerate(self._squares_m2))
        if math.sqrt(least_m2 / self._pairs) <= EXPLAINED_M:
            return self._candidates[number]
        east, north, _ = self._lines
        offset_enu_m = (east.offset_m, north.offset_m, up_m)
        scale_en = (1.0 + east.stretch, 1.0 + north.stretch)
        return replace(self.reported, offset_enu_m=offset_enu_m, scale_en=scale_en)
