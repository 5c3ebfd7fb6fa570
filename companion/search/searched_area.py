"""Searched area: probability of detection by cell and of success, prior and reach at contact.

Theory of operation. Answers that were listened for at one position are not independent, because its
shadowing is the same for all of them: so looks are combined by squares of the shadowing's
correlation length. In a square, the log probabilities that an answer is missed add up for each
offset of cell and path; its path offset is integrated out when the square is left, and the square
counts once, whatever was listened for there. Over squares the log probabilities add up for each
offset of the cell, that is error of the reach and shadowing about the emitter; these are integrated
out when the state is asked for:

    miss(cell) = sum_k w_k prod_squares sum_j v_j prod_looks (1 - p(margin + r_k + u_j))^answers

    POD = 1 - miss,  POA' = POA miss / sum(POA miss),  POS = sum(POA POD)

A square that is entered again continues where it was left: its looks are applied again, and its
earlier contribution is removed. That would take too long at once, so work is queued, and `advance`
does one piece of it, an update of all cells. Probabilities are updated in blocks of cells for the
same reason.

At first contact the searched area gives the prior of the emitter's position, and the reach of the
radio.

Theory of operation of the prior. The emitter is less likely where a search did not hear it. The
posterior of the grid, POA (1 - POD), is the prior of the first hypotheses. It is limited: alone it
never decides between two positions, because the emitter may also be outside of the area, and a
wrong reach is an error common to all cells.

Theory of operation of the reach. Until contact, the searched area keeps the log probability that an
emitter in a cell was missed, for each offset of the cell: the sum of the error of the stated reach
and of the shadowing about the emitter. Once the emitter's position is known, that of its cell is
the likelihood of these offsets, times the probability that the first answer was received where it
was. Of the posterior offset the reach has the share of its variance in the prior, because one
emitter does not separate the two.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.domain import PositionEnu
from companion.geometry.polygons import Point
from companion.search.detection_model import (
    MIN_LOG,
    NODE_WEIGHTS,
    NODES,
    DetectionModel,
    MissTable,
    look_spacing_m,
)
from companion.search.search_grid import Floats, SearchGrid

Square = tuple[int, int]
Floats32 = NDArray[np.float32]
HEIGHT_STEP_M = 5.0
"""Height difference below which looks are merged; at 20 m that is 2 dB straight below."""
LISTENED_AGAIN_S = 5.0
"""Period at which a square that is listened from continuously counts its looks."""

ALL_CELLS = slice(None)
BLOCK = 5_000
"""Cells that are updated at once, 2 km^2 in cells of 20 m: about 3 ms in plain Python."""
GROUPS = 5
"""Groups of the offsets of a cell: a quadrature of five points."""


def _groups() -> tuple[Floats32, Floats]:
    """Return the matrix (nodes, groups) that sums nodes, and the groups' offsets in sigmas."""
    nodes = len(NODES)
    group = np.arange(nodes) * GROUPS // nodes
    matrix = np.zeros((nodes, GROUPS), dtype=np.float32)
    matrix[np.arange(nodes), group] = NODE_WEIGHTS
    weights = matrix.sum(axis=0)
    return matrix, (matrix.T.astype(float) @ NODES) / weights


GROUP_MATRIX, GROUP_SIGMAS = _groups()


@dataclass(slots=True)
class Look:
    """Answers that were listened for about one point, and none came."""

    east_m: float
    north_m: float
    up_m: float
    """Height above the ground of the search area."""
    answers: float
    """Number of answers of an emitter that is always awake."""

    @property
    def position_m(self) -> PositionEnu:
        """Position of the sensor."""
        return self.east_m, self.north_m, self.up_m

    def add(self, position_m: PositionEnu, answers: float) -> None:
        """Add answers from a position near it."""
        self.answers += answers
        share = answers / self.answers
        self.east_m += share * (position_m[0] - self.east_m)
        self.north_m += share * (position_m[1] - self.north_m)
        self.up_m += share * (position_m[2] - self.up_m)


@dataclass(slots=True)
class _SquareLooks:
    """Looks in one square of the shadowing's correlation length, by squares of a look."""

    looks: dict[tuple[int, int, int], Look] = field(default_factory=dict)
    is_counted: bool = False
    """True if the sum over positions contains it."""


@dataclass(frozen=True, slots=True)
class _Piece:
    """A piece of work: apply answers from a point, or (None) leave or remove the square."""

    square: Square
    position_m: PositionEnu | None = None
    answers: float = 0.0
    is_return: bool = False
    is_contact: bool = False
    """True: keep the state as that of the first contact."""


class SearchedArea:
    """Accumulates looks over one grid by one model of detection."""

    def __init__(self, grid: SearchGrid, model: DetectionModel) -> None:
        self.grid, self.model = grid, model
        self.table = MissTable(model)
        self._spread = self.table.spread_matrix()
        self._centres = grid.centres_enu_m
        cells = len(grid.poa)
        self._left = np.zeros((cells, len(NODE_WEIGHTS)), dtype=np.float32)
        """Log probability of a miss, of all squares that were left, (cells, nodes)."""
        self._here = np.zeros((cells, self._spread.shape[0]), dtype=np.float32)
        """Log probability of a miss in the square that is listened from, (cells, offsets)."""
        self.missed: Floats32 = np.tile(GROUP_MATRIX.sum(axis=0), (cells, 1))
        """Probability of offset group and miss at the last update, (cells, groups)."""
        self._renewing = np.empty_like(self.missed)
        self._renewed_cells = 0
        self._looks: dict[Square, _SquareLooks] = {}
        self._square: Square | None = None
        """Square of the last look; work may still be behind."""
        self._here_square: Square | None = None
        self._pending: Look | None = None
        self._pending_key: tuple[int, int, int] = (0, 0, 0)
        self._pending_s = 0.0
        self._work: deque[_Piece] = deque()
        self._spacing_m = look_spacing_m(model)
        self.missed_before_contact: Floats32 | None = None
        """`log_missed` at the first contact, once the work until then is done."""

    def listen(self, position_m: PositionEnu, seconds: float) -> None:
        """Add a time without any answer at a position; up is above the ground."""
        answers = seconds / self.model.interval_s
        key = _key_of(position_m, self._spacing_m)
        pending = self._pending
        is_due = self._pending_s >= LISTENED_AGAIN_S
        if pending is not None and (key != self._pending_key or is_due):
            self._commit(pending, self._pending_key)
            pending = None
        if pending is None:
            self._pending, self._pending_key = Look(*position_m, answers), key
            self._pending_s = seconds
        else:
            pending.add(position_m, answers)
            self._pending_s += seconds

    def note_contact(self) -> None:
        """Keep the state until now as that of the first contact; counting may continue."""
        self._commit_pending()
        if self._square is not None:
            self._work.append(_Piece(self._square, is_contact=True))

    def take(self, looks: Iterable[Look]) -> None:
        """Process looks of an earlier flight, and do all the work."""
        for look in looks:
            self._commit(look, _key_of(look.position_m, self._spacing_m))
            self.finish()

    @property
    def looks(self) -> list[Look]:
        """All looks so far; those from one point are merged."""
        looks = [look for square in self._looks.values() for look in square.looks.values()]
        return looks if self._pending is None else [*looks, self._pending]

    @property
    def squares(self) -> Iterable[Square]:
        """Squares of the shadowing's correlation length that the radio has listened from."""
        return self._looks.keys()

    @property
    def has_work(self) -> bool:
        """True if `advance` has something to do."""
        return bool(self._work)

    def advance(self) -> bool:
        """Do one piece of pending work; return False without any."""
        if not self._work:
            return False
        piece = self._work.popleft()
        self._here_square = piece.square
        if piece.is_contact:
            self.missed_before_contact = self.log_missed()
        elif piece.position_m is not None:
            index = self.table.index_of(self.model.margin_db(self._centres, piece.position_m))
            self._here += np.float32(piece.answers) * self.table.rows[index]
            np.maximum(self._here, np.float32(MIN_LOG), out=self._here)
        elif piece.is_return:
            self._left -= self._counted()
            self._looks[piece.square].is_counted = False
        else:
            self._left += self._counted()
            self._looks[piece.square].is_counted = True
            self._here.fill(0.0)
        return True

    def finish(self) -> None:
        """Do all pending work, include the looks until now, and update."""
        self._commit_pending()
        while self.advance():
            pass
        self._renewed_cells = 0
        while not self.renew():
            pass

    def renew(self) -> bool:
        """Compute one block of `missed`; True: it was the last one, and `missed` is updated."""
        block = slice(self._renewed_cells, self._renewed_cells + BLOCK)
        self._renewing[block] = np.exp(self.log_missed(block)) @ GROUP_MATRIX
        self._renewed_cells += BLOCK
        if self._renewed_cells < len(self._renewing):
            return False
        self.missed, self._renewing = self._renewing, np.empty_like(self.missed)
        self._renewed_cells = 0
        return True

    @property
    def state(self) -> SearchState:
        """State of the search, as of the last update."""
        return _state(self.grid, self.missed.sum(axis=1, dtype=float))

    def _commit_pending(self) -> None:
        if self._pending is not None:
            self._commit(self._pending, self._pending_key)
            self._pending = None

    def _commit(self, look: Look, key: tuple[int, int, int]) -> None:
        """Queue the work of a look, and of the change of squares that it means."""
        side_m = self.model.propagation.correlation_m
        square = (math.floor(look.east_m / side_m), math.floor(look.north_m / side_m))
        own = self._looks.setdefault(square, _SquareLooks())
        if square != self._square:
            if self._square is not None:
                self._work.append(_Piece(self._square))
            self._square = square
            self._work.extend(_Piece(square, n.position_m, n.answers) for n in own.looks.values())
            if own.looks:
                self._work.append(_Piece(square, is_return=True))
        self._work.append(_Piece(square, look.position_m, look.answers))
        if key in own.looks:
            own.looks[key].add(look.position_m, look.answers)
        else:
            own.looks[key] = Look(*look.position_m, look.answers)

    def _counted(self, block: slice = ALL_CELLS) -> Floats32:
        """Return the log probability of a miss in the current square, (cells, nodes)."""
        missed = np.exp(self._here[block]) @ self._spread
        counted: Floats32 = np.log(np.maximum(missed, np.float32(math.exp(MIN_LOG))))
        return counted

    def log_missed(self, block: slice = ALL_CELLS) -> Floats32:
        """Return the log probability of a miss for each offset of a cell, (cells, nodes).

        Of a square that is entered again, the earlier contribution stays until it was removed.
        """
        left = self._left[block]
        square = self._here_square
        if square is not None and not self._looks[square].is_counted:
            return left + self._counted(block)
        return left.copy()


@dataclass(frozen=True, slots=True)
class SearchState:
    """State of the search at one moment."""

    grid: SearchGrid
    pod: Floats
    """Probability of detection, (cells,): had the emitter been there, it would be heard."""

    @property
    def pos(self) -> float:
        """Probability of success: had the emitter been in the area, it would have been heard."""
        return float(self.grid.poa @ self.pod)

    @property
    def poa(self) -> Floats:
        """(cells,) probability of area after the search, given that the emitter is in it."""
        left: Floats = self.grid.poa * (1.0 - self.pod)
        total = left.sum()
        return left / total if total > 0.0 else self.grid.poa

    def share_at(self, pod: float) -> float:
        """Share of the area that was searched with at least this probability of detection."""
        return float(np.count_nonzero(self.pod >= pod) / len(self.pod))

    @property
    def area_m2(self) -> float:
        """Area of all cells, m^2."""
        return len(self.pod) * self.grid.cell_m**2


def state_of(*areas: SearchedArea) -> SearchState:
    """The state of one search, or of several over the same grid.

    Where they assume different models, the errors of their reaches are taken as one: what one
    overstates the others overstate, too.
    """
    missed = np.exp(sum(area.log_missed() for area in areas)) @ NODE_WEIGHTS
    return _state(areas[0].grid, missed.astype(float))


def _state(grid: SearchGrid, missed: Floats) -> SearchState:
    return SearchState(grid, 1.0 - np.clip(missed, 0.0, 1.0))


def _key_of(position_m: PositionEnu, spacing_m: float) -> tuple[int, int, int]:
    east, north, up = position_m
    return (
        math.floor(east / spacing_m),
        math.floor(north / spacing_m),
        math.floor(up / HEIGHT_STEP_M),
    )


MIN_ODDS = 0.1
"""Minimum odds of a position to the likeliest one: two such positions are still ambiguous, as the
estimate counts it (a second position of 5 % or more)."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchPrior:
    """Log of the prior density on a map, relative to its maximum."""

    grid: SearchGrid
    log_map: Floats
    """Log density, (rows, columns); cells of the box that are not of the area count as its mean."""
    shift_en_m: Point = (0.0, 0.0)
    """Sum of the jumps of the vehicle's navigation since it was made."""

    @classmethod
    def of(cls, state: SearchState) -> SearchPrior:
        """Return the prior that a search leaves."""
        left = state.grid.poa * (1.0 - state.pod)
        density = state.grid.on_map(left, float(left.mean()))
        return cls(state.grid, np.log(np.maximum(density / density.max(), MIN_ODDS)))

    def log_at(self, position_enu_m: Point) -> float:
        """Return the log of the odds of a position to the likeliest one.

        Beyond the map it is as at its border: the fence rarely ends where the emitter may be.
        """
        grid = self.grid
        rows, columns = self.log_map.shape
        east, north = (p - s for p, s in zip(position_enu_m, self.shift_en_m, strict=True))
        row = math.floor((north - grid.south_m) / grid.cell_m)
        column = math.floor((east - grid.west_m) / grid.cell_m)
        return float(self.log_map[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])

    def moved(self, shift_en_m: Point) -> SearchPrior:
        """Return the prior after a jump of the vehicle's navigation."""
        east, north = self.shift_en_m
        return replace(self, shift_en_m=(east + shift_en_m[0], north + shift_en_m[1]))


class LearntReach(msgspec.Struct, frozen=True):
    """Reach after the first contact."""

    reach_m: float
    reach_sigma_db: float

    def model(self, before: DetectionModel) -> DetectionModel:
        """Return the detection model with this reach."""
        return msgspec.structs.replace(
            before, reach_m=self.reach_m, reach_sigma_db=max(0.5, self.reach_sigma_db)
        )


def learnt_reach(
    area: SearchedArea, contact_m: PositionEnu, emitter_enu_m: Point
) -> LearntReach | None:
    """Return the reach after an emitter at a known position was first heard from `contact_m`.

    None if the emitter lies outside of the searched area, where nothing was counted.
    """
    model, grid, table = area.model, area.grid, area.table
    away = np.abs(grid.centres_enu_m - np.array(emitter_enu_m)).max(axis=1)
    cell = int(away.argmin())
    if away[cell] > 0.5 * grid.cell_m + 1e-9:
        return None
    margin = model.margin_db(np.array([emitter_enu_m]), contact_m)
    missed_one = np.exp(table.rows[table.index_of(margin)[0]]) @ table.spread_matrix()
    before = area.missed_before_contact
    log_missed = area.log_missed() if before is None else before
    posterior = NODE_WEIGHTS * np.exp(log_missed[cell]) * (1.0 - missed_one)
    if not posterior.sum() > 0.0:
        return None
    posterior = posterior / posterior.sum()
    offsets_db = model.cell_sigma_db * NODES
    mean_db = float(posterior @ offsets_db)
    variance = float(posterior @ (offsets_db - mean_db) ** 2)
    share = (model.reach_sigma_db / model.cell_sigma_db) ** 2
    sigma_db = math.sqrt(model.reach_sigma_db**2 * (1.0 - share) + share**2 * variance)
    factor = 10.0 ** (share * mean_db / (10.0 * model.propagation.exponent))
    return LearntReach(round(model.reach_m * factor, 1), round(sigma_db, 2))
