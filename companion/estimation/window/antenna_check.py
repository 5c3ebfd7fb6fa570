"""Which antenna measured the bearings, where nobody says: the one that explains them best.

A radio that tells an angle does not say of which direction. An azimuth about the vertical is as
accurate from above as from afar. That of a planar array is worth nothing right above the emitter,
and leans with the vehicle. A line of antennas prints an arcsine, which folds behind onto ahead. Far
off and ahead the three are the same; from above they differ, and so do the errors that each of them
leaves.

Each is solved for its own place. Errors are taken to be Laplacian with a scale that is found along
with them, so that reflections weigh little and no noise needs to be known:

    cost = sum of log(sigma_i scale) + |u_i| / scale,    scale = mean |u_i|

with u the whitened residuals; ranges add their robust loss. An antenna is taken for another when
the difference of the costs is `DECIDED`, and more than `DECIDED_SIGMAS` of what the noise that was
drawn makes of it, the repetition of neighbours counted: from each of the others. Until then the
planar array is believed, which promises the least. An angle beyond a right one refutes a line at
once. A bearing beside a range that is too long came by reflection or around an edge, and tells of
no antenna. A planar array is shown only where an azimuth's errors grow with the steepness: those
around an edge are as large from aside. Bearings that are good right above prove an azimuth for
good, shadows and reflections only spoil them: so an azimuth is given up when more speaks against it
than ever did for it.

Source: Q. H. Vuong, Econometrica 57 (1989), for models that need not be true.
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
from companion.estimation.window.map_kernels import (
    AXES,
    VALUES,
    clipped,
    row_residuals,
    row_sigmas,
)
from companion.estimation.window.sandwich import Scores, long_run_variance
from companion.estimation.window.window_map import WindowMap
from companion.kernel import Matrix, Vector

MIN_BEARINGS = 40
DECIDED, DECIDED_ALONE = math.log(1000.0), 4.0 * math.log(1000.0)
"""Odds between two antennas; and without ranges, where bearings find each a place that suits it."""
DECIDED_SIGMAS = 3.0
EVERY = 4
"""An antenna that was found is looked at again at each of so many solutions."""

LONG_SIGMAS = 2.0
"""A range too long by so much came by reflection or around an edge, and so did its bearing."""

STEEP_RAD = math.radians(45.0)
MIN_STEEP = 8
"""Bearings from above, and from aside, before errors can be seen to grow."""
WORSE_SHARE = 0.6
"""Of pairs of both in which the steeper one is farther off."""

CONTRADICTED, CALM = 4.0, 2.0
"""Standard deviations that half of the directions are off by, at least; and where that is over."""
MIN_CONTRADICTING = 40
CONTRADICTED_FOR_S = 10.0

Candidate = Literal["azimuth", "planar", "line"]
CANDIDATES: tuple[Candidate, ...] = ("planar", "azimuth", "line")


def with_antenna(params: FilterParams, kind: AntennaKind) -> FilterParams:
    """The same beliefs about bearings of another antenna."""
    antenna = msgspec.structs.replace(params.antenna, kind=kind)
    return msgspec.structs.replace(params, antenna=antenna)


def rows_as(rows: Matrix, kind: AntennaKind) -> Matrix:
    """Rows of a planar array, (n, 16), as if another antenna had printed their angles."""
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
    """Keeps what is believed of the antenna."""

    def __init__(self, params: FilterParams) -> None:
        self._params = {kind: with_antenna(params, kind) for kind in CANDIDATES}
        self._maps = {kind: WindowMap(each) for kind, each in self._params.items()}
        self.clear()

    def clear(self) -> None:
        """Nothing is known of the antenna any more."""
        self.taken: Candidate = "planar"
        self.is_shown = False
        """Whether the bearings show that they are no azimuth, or an azimuth."""
        self._azimuth_gain = 0.0
        """By how much an azimuth that is taken was better than the next, at the most."""
        self._solutions = 0

    @property
    def params(self) -> FilterParams:
        """What is believed with the antenna that is taken."""
        return self._params[self.taken]

    @property
    def shown(self) -> str | None:
        """What the bearings show, in a word; None: nothing yet."""
        return self.taken if self.is_shown else None

    @Stepwise
    def look(self, rows: Matrix, mean: Vector, inflation: Inflation) -> Steps[bool]:
        """Compare the candidates on the rows (n, 16), from `mean` (k,); whether another is taken.

        The rows are those of a planar array, each with its printed angle.
        """
        self._solutions += 1
        before = self.taken
        printed_rad = rows[:, VALUES + BEARING]
        is_borne = ~np.isnan(printed_rad)
        is_no_line = bool(np.any(np.abs(printed_rad[is_borne]) > 0.5 * math.pi))
        if is_no_line and before == "line":
            self._take("planar", is_shown=False)
        is_due = not self.is_shown or self._solutions % EVERY == 0
        if is_due and np.count_nonzero(is_borne) >= MIN_BEARINGS:
            kinds = [kind for kind in CANDIDATES if kind != "line" or not is_no_line]
            found = yield from self._explanations.steps(kinds, rows, mean, inflation)
            direct = without_long(rows, list(found.values()))
            if direct is not None:
                found = yield from self._explanations.steps(kinds, direct, mean, inflation)
            if self.taken in found:
                has_ranges = not np.isnan(rows[:, VALUES + RANGE]).all()
                self._judge(found, DECIDED if has_ranges else DECIDED_ALONE)
        return self.taken != before

    @Stepwise
    def _explanations(
        self, kinds: Sequence[Candidate], rows: Matrix, mean: Vector, inflation: Inflation
    ) -> Steps[dict[Candidate, Explained]]:
        found: dict[Candidate, Explained] = {}
        for kind in kinds:
            each = yield from self._explained(kind, rows, mean, inflation)
            found |= {} if each is None else {kind: each}
        return found

    def _judge(self, found: dict[Candidate, Explained], decided: float) -> None:
        """Take the best, if it is better than each of the others beyond doubt."""
        best = min(found, key=lambda kind: found[kind].cost)
        others = [found[kind] for kind in found if kind != best]
        is_shown = bool(others) and all(is_decided(each, found[best], decided) for each in others)
        if best == "planar" and "azimuth" in found:
            is_shown &= is_worse_from_above(found["azimuth"])
        gain = min((other.cost for other in others), default=0.0) - found[best].cost
        if best != self.taken:
            if not is_shown or gain < self._azimuth_gain + decided:
                self.is_shown = self._azimuth_gain > 0.0
                return
            self._take(best, is_shown=True)
        self.is_shown = is_shown
        if best == "azimuth" and is_shown:
            self._azimuth_gain = max(self._azimuth_gain, gain)

    def _take(self, kind: Candidate, *, is_shown: bool) -> None:
        self.taken, self.is_shown = kind, is_shown
        self._azimuth_gain = 0.0

    def _explained(
        self, kind: Candidate, rows: Matrix, mean: Vector, inflation: Inflation
    ) -> Steps[Explained | None]:
        """The rows as one antenna explains them, at the place where it does best; None: nowhere."""
        window_map, params = self._maps[kind], self._params[kind]
        window_map.expect(inflation)
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
        if kind == "line":  # the error of the angle, not of its sine
            spread_rad /= np.maximum(np.cos(rows[is_borne, VALUES + BEARING]), 1e-3)
        # an angle is off by no more than half a turn, however vague
        costs = np.log(spread_rad) + off / scale + np.log(-np.expm1(-math.pi / spread_rad))
        ranging_cost = float(np.sum(psi * (u[RANGE] - 0.5 * psi)))
        away = rows[is_borne, :2] - solution[0][:2]
        rise_m = rows[is_borne, 2] - target_height_m(solution[0], params.model)
        rise_rad = np.arctan2(np.abs(rise_m), np.hypot(away[:, 0], away[:, 1]))
        cost = ranging_cost + float(costs.sum())
        return Explained(cost, spread_rad, off / scale, rise_rad, u[RANGE][is_borne])


class ToldAntennaWatch:
    """Whether directions contradict the antenna, mount and field of view that are told.

    Most of them, not the noise of all: reflections are gross, but fewer than a half. And for long,
    because early on the place itself is wrong.
    """

    def __init__(self) -> None:
        self.is_contradicted = False
        self._since_s = math.inf

    def look(self, scores: Scores, time_s: float) -> None:
        """Take in the directions as they are seen from the place that is believed in."""
        directions = [scores.u[row][scores.is_measured[row]] for row in (BEARING, ELEVATION)]
        off = [float(np.median(np.abs(u))) for u in directions if len(u) >= MIN_CONTRADICTING]
        if max(off, default=0.0) > CONTRADICTED:
            self._since_s = min(self._since_s, time_s)
            self.is_contradicted = time_s - self._since_s >= CONTRADICTED_FOR_S
        elif max(off, default=0.0) < CALM:
            self._since_s, self.is_contradicted = math.inf, False


class Explained(NamedTuple):
    """What one antenna makes of the window."""

    cost: float
    spread_rad: Vector
    """(m,) how far off each bearing is expected to be."""
    error: Vector
    """(m,) how far off it is, in that unit."""
    rise_rad: Vector
    """(m,) how steep the emitter lies below."""
    excess: Vector
    """(m,) by how much the range beside it is too long, in its standard deviations."""


def without_long(rows: Matrix, found: Sequence[Explained]) -> Matrix | None:
    """The rows (n, 16) without bearings beside a range too long for the place of any antenna.

    None: there are none, or too few others to tell antennas apart.
    """
    is_long = np.any([each.excess > LONG_SIGMAS for each in found], axis=0)
    if not is_long.any() or np.count_nonzero(~is_long) < MIN_BEARINGS:
        return None
    direct = np.array(rows)
    bearings: Vector = direct[:, VALUES + BEARING]
    bearings[np.flatnonzero(~np.isnan(bearings))[is_long]] = np.nan
    return direct


def is_worse_from_above(azimuth: Explained) -> bool:
    """Whether an azimuth's errors grow with the steepness, by rank: not so around an edge."""
    off_rad = azimuth.error * azimuth.spread_rad
    is_steep = azimuth.rise_rad > STEEP_RAD
    steep, level = off_rad[is_steep], off_rad[~is_steep]
    if min(len(steep), len(level)) < MIN_STEEP:
        return False
    share = float(np.mean(steep[:, None] > level[None, :]))  # a half by chance (Mann and Whitney)
    return share > WORSE_SHARE


def is_decided(before: Explained, better: Explained, decided: float) -> bool:
    """Whether the second is better by these log odds, and not by the very noise that was drawn.

    Where it is true, an error that is larger by d raises the difference by (ratio - 1) d, with the
    ratio of what is expected of both: the rest of the difference is geometry.
    """
    gain = before.cost - better.cost
    if gain < decided:
        return False
    noise = (better.spread_rad / before.spread_rad - 1.0) * (better.error - 1.0)
    scatter2 = float(long_run_variance(noise[:, None])[0, 0])
    return gain > DECIDED_SIGMAS * math.sqrt(max(scatter2, 0.0))
