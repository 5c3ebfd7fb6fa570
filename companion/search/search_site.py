"""Possible locations of the emitter, in degrees: weighted polygons, or a raster of weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Corners
from companion.search.search_grid import (
    Floats,
    SearchGrid,
    WeightedArea,
    are_inside,
    grid_of_weights,
    grid_over,
)

LatLon = tuple[float, float]
MOST_AWAY_KM = 20.0
"""Farther from the vehicle's origin than any flight: the file is of another place."""


@dataclass(frozen=True, slots=True)
class SiteArea:
    """A polygon in degrees, its holes, and its chance against the other polygons."""

    corners_deg: tuple[LatLon, ...]
    weight: float = 1.0
    holes_deg: tuple[tuple[LatLon, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class SiteRaster:
    """Weights on a grid in degrees; over the antimeridian, east exceeds 180."""

    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float
    weights: Floats
    """(rows, columns) from the south-west; NaN: outside of the area."""


SearchSite = tuple[SiteArea, ...] | SiteRaster


def grid_of_site(
    site: SearchSite, origin: LocalOrigin, cell_m: float, fence_enu_m: Corners | None = None
) -> SearchGrid:
    """Return the grid about a local origin.

    Raises:
        ValueError: it is more than 20 km away, has too many cells, nothing has a weight, or it lies
            wholly outside of the fence.
    """
    grid = _of_site(site, origin, cell_m)
    if fence_enu_m is not None and share_outside(grid, fence_enu_m) > 1.0 - 1e-9:
        raise ValueError("the search area lies wholly outside the fence")
    return grid


def share_outside(grid: SearchGrid, fence_enu_m: Corners) -> float:
    """Return the probability that the emitter is outside of the fence."""
    return float(grid.poa[~are_inside(fence_enu_m, grid.centres_enu_m)].sum())


def _of_site(site: SearchSite, origin: LocalOrigin, cell_m: float) -> SearchGrid:
    if isinstance(site, SiteRaster):
        return _of_raster(site, origin, cell_m)
    areas = [
        WeightedArea(
            _local(each.corners_deg, origin),
            each.weight,
            tuple(_local(hole, origin) for hole in each.holes_deg),
        )
        for each in site
    ]
    return grid_over(areas, cell_m)


def _local(corners_deg: tuple[LatLon, ...], origin: LocalOrigin) -> Corners:
    corners = tuple(origin.enu_from_geodetic(*each, origin.altitude_m)[:2] for each in corners_deg)
    away_km = _most_km(corners)
    if away_km <= MOST_AWAY_KM:
        return corners
    swapped = (origin.enu_from_geodetic(lon, lat, origin.altitude_m) for lat, lon in corners_deg)
    hint = ""
    if _most_km(tuple(each[:2] for each in swapped)) <= MOST_AWAY_KM:
        hint = "; latitude and longitude are swapped: longitude comes first"
    raise ValueError(f"a corner is {away_km:.0f} km from the vehicle's origin{hint}")


def _most_km(corners: Corners) -> float:
    return max(math.hypot(*corner) for corner in corners) / 1000.0


def _of_raster(site: SiteRaster, origin: LocalOrigin, cell_m: float) -> SearchGrid:
    """Cells of the local frame with the weights of the raster cells that hold their centres."""
    rows, columns = site.weights.shape
    box = _local(((site.south_deg, site.west_deg), (site.north_deg, site.east_deg)), origin)
    (west_m, south_m), (east_m, north_m) = box
    whole = ((west_m, south_m), (east_m, south_m), (east_m, north_m), (west_m, north_m))
    shape = grid_over([WeightedArea(whole)], cell_m)
    places = shape.centres_enu_m
    row = np.clip(rows * (places[:, 1] - south_m) / (north_m - south_m), 0, rows - 1).astype(int)
    column = np.clip(columns * (places[:, 0] - west_m) / (east_m - west_m), 0, columns - 1)
    sampled = site.weights[row, column.astype(int)]
    weights = shape.on_map(sampled, float("nan"))
    return grid_of_weights(shape.west_m, shape.south_m, shape.cell_m, weights)
