"""Identification of an antenna that is not configured, by how well each kind explains bearings.

A radio that reports an angle does not report its kind. An azimuth about the vertical is as accurate
from above as from afar. That of a planar array has no information right above the emitter, and
tilts with the vehicle. A line of antennas reports an arcsine, which folds behind onto ahead. Far
off and ahead the three are equal; from above they differ, and so do the residuals of each model.

Each candidate is solved for its own position. Errors are assumed Laplacian with a scale that is
estimated as well, so that reflections have little weight and no noise needs to be known:

    cost = sum of log(sigma_i scale) + |u_i| / scale,    scale = mean |u_i|

with u the whitened residuals; ranges add their robust loss. Another antenna is accepted when the
difference of the costs to every other candidate is `DECISION_LOG_ODDS`, and more than three
standard deviations by noise, with the correlation of neighbours. Until then the planar array is
assumed, the least informative model. An angle beyond a right one rules out a line at once. A
bearing with a range that is too long is from a reflection or around an edge, and is not evidence. A
planar array is reported only where an azimuth's errors grow with the steepness: errors by
diffraction around an edge are as large from aside. Accurate bearings right above prove an azimuth
for good, and shadows and reflections only degrade them: so an azimuth is dropped only when the
evidence against it exceeds the largest evidence for it so far.

Source: Q. H. Vuong, Econometrica 57 (1989), for the comparison of models that need not be true.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from companion.estimation.antenna import AntennaKind
from companion.estimation.filters.target_filter import FilterParams, Inflation
from companion.estimation.measurement_model import BEARING, ELEVATION, RANGE, target_height_m
from companion.estimation.stepwise import Steps, Stepwise
from companion.estimation.unit_check import DECISION_LOG_ODDS
from companion.estimation.window.map_kernels import (
    AXES,
    VALUES,
    clipped,
    row_residuals,
    row_sigmas,
)
from companion.estimation.window.sandwich import SIGNIFICANT_SIGMAS, Scores, long_run_variance
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector

MIN_DIRECTIONS = 40
"""Minimum number of directions for a comparison of antennas, or for a test of the configured one.

4 s of a radio of 10 Hz: of as many the mean error is known to a sixth. With 20, flights of a planar
array end in the same way.
"""

Candidate = Literal["azimuth", "planar", "line"]
CANDIDATES: tuple[Candidate, ...] = ("planar", "azimuth", "line")
"""Kinds that are compared, the default first."""


def with_antenna(params: FilterParams, kind: AntennaKind) -> FilterParams:
    """Return the same assumptions with another antenna."""
    antenna = msgspec.structs.replace(params.antenna, kind=kind)
    return msgspec.structs.replace(params, antenna=antenna)


def rows_as(rows: Matrix, kind: AntennaKind) -> Matrix:
    """Return rows of a planar array, (n, 16), as if another antenna had reported their angles."""
    if kind not in ("azimuth", "line"):
        return rows
    other = np.array(rows)
    ahead, right = rows[:, AXES : AXES + 3], rows[:, AXES + 3 : AXES + 6]
    printed_rad = rows[:, VALUES + BEARING]
    if kind == "azimuth":
        other[:, VALUES + BEARING] = np.arctan2(ahead[:, 1], ahead[:, 0]) - printed_rad
        return other
    other[:, VALUES + BEARING] = np.sin(printed_rad)
    other[:, AXES : AXES + 3] = right
    other[:, AXES + 3 : AXES + 6] = np.cross(right, ahead)
    return other


class AntennaCheck:
    """Running comparison of the candidate antennas."""

    def __init__(self, params: FilterParams) -> None:
        self._params = {kind: with_antenna(params, kind) for kind in CANDIDATES}
        self._maps = {kind: WindowMap(each) for kind, each in self._params.items()}
        self.clear()

    def clear(self) -> None:
        """Forget all evidence about the antenna."""
        self.hypothesis: Candidate = "planar"
        self.is_identified = False
        """True if bearings show that they are an azimuth, or that they are none."""
        self._azimuth_gain = 0.0
        """Largest cost difference by which an accepted azimuth beat the next candidate."""
        self._solutions = 0

    @property
    def params(self) -> FilterParams:
        """Filter parameters with the accepted antenna."""
        return self._params[self.hypothesis]

    @property
    def identified(self) -> str | None:
        """Kind that the bearings identify; None: none yet."""
        return self.hypothesis if self.is_identified else None

    @Stepwise
    def look(self, rows: Matrix, mean: Vector, inflation: Inflation) -> Steps[bool]:
        """Compare the candidates on rows (n, 18), from `mean` (k,); return True on a change.

        The rows are those of a planar array, each with its reported angle.
        """
        self._solutions += 1
        before = self.hypothesis
        printed_rad = rows[:, VALUES + BEARING]
        is_borne = ~np.isnan(printed_rad)
        is_no_line = bool(np.any(np.abs(printed_rad[is_borne]) > 0.5 * math.pi))
        if is_no_line and before == "line":
            self._accept("planar", is_identified=False)
        # an identified antenna costs three solutions at every fourth one only
        is_due = not self.is_identified or self._solutions % 4 == 0
        if is_due and np.count_nonzero(is_borne) >= MIN_DIRECTIONS:
            kinds = [kind for kind in CANDIDATES if kind != "line" or not is_no_line]
            found = yield from self._fits.steps(kinds, rows, mean, inflation)
            direct = without_nlos(rows, list(found.values()))
            if direct is not None:
                found = yield from self._fits.steps(kinds, direct, mean, inflation)
            if self.hypothesis in found:
                self._judge(found)
        return self.hypothesis != before

    @Stepwise
    def _fits(
        self, kinds: Sequence[Candidate], rows: Matrix, mean: Vector, inflation: Inflation
    ) -> Steps[dict[Candidate, AntennaFit]]:
        found: dict[Candidate, AntennaFit] = {}
        for kind in kinds:
            each = yield from self._fit_of(kind, rows, mean, inflation)
            found |= {} if each is None else {kind: each}
        return found

    def _judge(self, found: dict[Candidate, AntennaFit]) -> None:
        """Accept the best candidate if it is significantly better than every other."""
        best = min(found, key=lambda kind: found[kind].cost)
        others = [found[kind] for kind in found if kind != best]
        is_identified = bool(others) and all(
            is_significant(each, found[best], DECISION_LOG_ODDS) for each in others
        )
        if best == "planar" and "azimuth" in found:
            is_identified &= grows_with_steepness(found["azimuth"])
        gain = min((other.cost for other in others), default=0.0) - found[best].cost
        if best != self.hypothesis:
            if not is_identified or gain < self._azimuth_gain + DECISION_LOG_ODDS:
                self.is_identified = self._azimuth_gain > 0.0
                return
            self._accept(best, is_identified=True)
        self.is_identified = is_identified
        if best == "azimuth" and is_identified:
            self._azimuth_gain = max(self._azimuth_gain, gain)

    def _accept(self, kind: Candidate, *, is_identified: bool) -> None:
        self.hypothesis, self.is_identified = kind, is_identified
        self._azimuth_gain = 0.0

    def _fit_of(
        self, kind: Candidate, rows: Matrix, mean: Vector, inflation: Inflation
    ) -> Steps[AntennaFit | None]:
        """Return the fit of one antenna to the rows at its best position; None without one."""
        window_map, params = self._maps[kind], self._params[kind]
        window_map.set_bearing_inflation(inflation)
        seen = rows_as(rows, kind)
        solution = yield from window_map.solve.steps(seen, mean)
        if solution is None:
            return None
        model = params.model._replace(bearing_inflation=inflation[BEARING])
        sigmas = row_sigmas(seen, solution[0], model)
        u = row_residuals(seen, solution[0], sigmas, model)
        psi = clipped(u, params.thresholds)[RANGE]
        is_borne = ~np.isnan(rows[:, VALUES + BEARING])
        off = np.abs(u[BEARING][is_borne])
        scale = max(float(off.mean()), 1e-3)
        spread_rad = scale * sigmas[BEARING][is_borne]
        if kind == "line":  # error of the angle, not of its sine
            spread_rad /= np.maximum(np.cos(rows[is_borne, VALUES + BEARING]), 1e-3)
        # normalised over half a turn: no angle is off by more, however vague
        costs = np.log(spread_rad) + off / scale + np.log(-np.expm1(-math.pi / spread_rad))
        ranging_cost = float(np.sum(psi * (u[RANGE] - 0.5 * psi)))
        away = rows[is_borne, :2] - solution[0][:2]
        rise_m = rows[is_borne, 2] - target_height_m(solution[0], params.model)
        rise_rad = np.arctan2(np.abs(rise_m), np.hypot(away[:, 0], away[:, 1]))
        cost = ranging_cost + float(costs.sum())
        return AntennaFit(cost, spread_rad, off / scale, rise_rad, u[RANGE][is_borne])


class ConfiguredAntennaCheck:
    """Test of directions against the configured antenna, mount and field of view.

    It uses their median, because reflections are gross but fewer than a half, and requires that the
    contradiction lasts, because early on the position itself is wrong.
    """

    def __init__(self) -> None:
        self.is_contradicted = False
        self._since_s = math.inf

    def look(self, scores: Scores, time_s: float) -> None:
        """Process the directions' residuals at the estimated position."""
        directions = [scores.u[row][scores.is_measured[row]] for row in (BEARING, ELEVATION)]
        off = [float(np.median(np.abs(u))) for u in directions if len(u) >= MIN_DIRECTIONS]
        # sigma; white errors have a median of 0.67; apart, so that it does not change all the time
        contradicted, cleared, lasting_s = 4.0, 2.0, 10.0
        if max(off, default=0.0) > contradicted:
            self._since_s = min(self._since_s, time_s)
            self.is_contradicted = time_s - self._since_s >= lasting_s
        elif max(off, default=0.0) < cleared:
            self._since_s, self.is_contradicted = math.inf, False


class AntennaFit(NamedTuple):
    """Fit of one antenna to the window."""

    cost: float
    spread_rad: Vector
    """(m,) expected error of each bearing."""
    error: Vector
    """(m,) absolute error of each bearing in that unit."""
    rise_rad: Vector
    """(m,) angle of the emitter below the horizon."""
    excess: Vector
    """(m,) residual of its range, in its standard deviations; positive when too long."""


def without_nlos(rows: Matrix, found: Sequence[AntennaFit]) -> Matrix | None:
    """Return the rows (n, 18) without bearings whose range is too long for any candidate.

    None if there are none, or too few others for a comparison.
    """
    is_long = np.any([each.excess > SIGNIFICANT_SIGMAS for each in found], axis=0)
    if not is_long.any() or np.count_nonzero(~is_long) < MIN_DIRECTIONS:
        return None
    direct = np.array(rows)
    bearings: Vector = direct[:, VALUES + BEARING]
    bearings[np.flatnonzero(~np.isnan(bearings))[is_long]] = np.nan
    return direct


def grows_with_steepness(azimuth: AntennaFit) -> bool:
    """Return True if an azimuth's errors grow with steepness, by rank; not so around an edge."""
    off_rad = azimuth.error * azimuth.spread_rad
    is_steep = azimuth.rise_rad > math.radians(45.0)  # below the horizon
    steep, level = off_rad[is_steep], off_rad[~is_steep]
    if min(len(steep), len(level)) < 8:  # by chance the share of so many exceeds 0.6 once in four
        return False
    share = float(np.mean(steep[:, None] > level[None, :]))  # 0.5 by chance (Mann and Whitney)
    return share > 0.6


def is_significant(before: AntennaFit, better: AntennaFit, log_odds: float) -> bool:
    """Return True if the second fit is better by these log odds, and significantly so.

    If it is true, an error that is larger by d raises the difference by (ratio - 1) d, with the
    ratio of both expected errors: the rest of the difference is geometry.
    """
    gain = before.cost - better.cost
    if gain < log_odds:
        return False
    noise = (better.spread_rad / before.spread_rad - 1.0) * (better.error - 1.0)
    scatter2 = float(long_run_variance(noise[:, None])[0, 0])
    return gain > 3.0 * math.sqrt(max(scatter2, 0.0))  # by chance once in 700
