"""Reach of the radio as the first contact of a flight shows it.

Theory of operation. Until contact, the searched area keeps the log probability that an emitter in a
cell was missed, for each offset of the cell: the sum of the error of the stated reach and of the
shadowing about the emitter. Once the emitter's position is known, that of its cell is the
likelihood of these offsets, times the probability that the first answer was received where it was.
Of the posterior offset the reach has the share of its variance in the prior, because one emitter
does not separate the two.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from companion.domain import PositionEnu
from companion.geometry.polygons import Point
from companion.search.detection_model import NODE_WEIGHTS, NODES, DetectionModel
from companion.search.searched_area import SearchedArea


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

    None: the emitter lies outside of the searched area, where nothing was counted.
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
