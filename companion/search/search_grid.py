"""The cells of a search area, and the probability of area (POA) of each.

A cell belongs to the area if its centre lies in one of its polygons. POA sums to 1 over the cells:
given that the emitter is in the area, where it is (IAMSAR manual, volume II, chapter 4).

A site states where the emitter may be in degrees: weighted polygons, or a raster of weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry.coordinates import LocalOrigin
from companion.geometry.polygons import Corners, Point, Polygon, area_m2

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MAX_CELLS = 40_000
"""Maximum number of cells, 16 km^2 in cells of 20 m; an update takes about 10 ms of one core."""
MIN_M2 = 1.0
"""Smallest area of a polygon, as for a fence."""
MIN_CELLS_ACROSS = 10
"""Minimum number of cells across the shorter side of a small area, so that a gap has a shape."""


@dataclass(frozen=True, slots=True)
class WeightedArea:
    """A polygon with its weight: the relative probability that the emitter is in it."""

    corners_enu_m: tuple[Point, ...]
    weight: float = 1.0
    holes_enu_m: tuple[tuple[Point, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class SearchGrid:
    """Square cells over the box of a search area; rows run to the north, columns to the east."""

    west_m: float
    south_m: float
    cell_m: float
    inside: Bools
    """Membership of each cell, (rows, columns): True where it belongs to the area."""
    poa: Floats
    """Probability of area of the cells inside, (cells,), row by row; sums to 1."""

    @property
    def centres_enu_m(self) -> Floats:
        """(cells, 2) centres of the cells inside, east and north."""
        return _centres(self.west_m, self.south_m, self.cell_m, self.inside)

    def on_map(self, values: Floats, outside: float = 0.0) -> Floats:
        """(rows, columns) of a value for each cell inside."""
        image = np.full(self.inside.shape, outside)
        image[self.inside] = values
        return image


def grid_over(areas: Sequence[WeightedArea], cell_m: float) -> SearchGrid:
    """Return the grid over all areas, with their weights spread evenly over each.

    An area that contains no centre of a cell has its weight in the nearest one. Cells grow beyond
    `cell_m` for at most `MAX_CELLS`, and shrink in a small area. `ValueError`: no weight, or no
    area.
    """
    corners = np.array([corner for area in areas for corner in area.corners_enu_m], dtype=float)
    if not len(corners) or not any(area.weight > 0.0 for area in areas):
        raise ValueError("no polygon of the search area has a weight above 0")
    west_m, south_m = corners.min(axis=0)
    width_m, height_m = corners.max(axis=0) - (west_m, south_m)
    if not min(width_m, height_m) > 0.0:
        raise ValueError("the search area encloses nothing")
    cell_m = min(cell_m, min(width_m, height_m) / MIN_CELLS_ACROSS)
    if math.ceil(width_m / cell_m) * math.ceil(height_m / cell_m) > MAX_CELLS:
        half_m, most = 0.5 * (width_m + height_m), MAX_CELLS - 1
        cell_m = (half_m + math.sqrt(half_m**2 + most * width_m * height_m)) / most
    columns, rows = max(1, math.ceil(width_m / cell_m)), max(1, math.ceil(height_m / cell_m))
    everywhere = np.ones((rows, columns), dtype=bool)
    centres = _centres(float(west_m), float(south_m), cell_m, everywhere)
    mass = np.zeros(len(centres))
    covered = np.zeros(len(centres), dtype=bool)
    for area in areas:
        within = _within(area, centres)
        if not within.any():
            holes_m2 = sum(area_m2(hole) for hole in area.holes_enu_m)
            if area_m2(area.corners_enu_m) - holes_m2 < MIN_M2:
                raise ValueError("a polygon of the search area encloses nothing")
            middle = np.mean(area.corners_enu_m, axis=0)
            within[np.hypot(*(centres - middle).T).argmin()] = True
        covered |= within
        mass[within] += area.weight / np.count_nonzero(within)
    poa = mass[covered] / mass.sum()
    inside = covered.reshape(rows, columns)
    return SearchGrid(float(west_m), float(south_m), float(cell_m), inside, poa)


def grid_of_weights(west_m: float, south_m: float, cell_m: float, weights: Floats) -> SearchGrid:
    """Return the grid of weights (rows, columns), rows counted from the south-west corner.

    Missing or infinite ones are outside. `ValueError`: no weight, or more than `MAX_CELLS` cells.
    """
    if weights.size > MAX_CELLS:
        raise ValueError(f"{weights.size} cells; at most {MAX_CELLS}: make cells larger")
    inside = np.isfinite(weights) & (weights > 0.0)
    if not inside.any():
        raise ValueError("no cell of the search area has a weight above 0")
    mass = weights[inside]
    return SearchGrid(west_m, south_m, cell_m, inside, mass / mass.sum())


def _centres(west_m: float, south_m: float, cell_m: float, inside: Bools) -> Floats:
    rows, columns = np.nonzero(inside)
    return np.column_stack((west_m + (columns + 0.5) * cell_m, south_m + (rows + 0.5) * cell_m))


def _within(area: WeightedArea, points: Floats) -> Bools:
    corners = np.array(area.corners_enu_m)
    low, high = corners.min(axis=0), corners.max(axis=0)
    inside: Bools = ((points >= low) & (points <= high)).all(axis=1)
    inside[inside] = are_inside(area.corners_enu_m, points[inside])
    for hole in area.holes_enu_m:
        inside &= ~are_inside(hole, points)
    return inside


def are_inside(polygon: Polygon, points: Floats) -> Bools:
    """Return (n,) True for the points, (n, 2), inside a polygon, by the crossing number."""
    east, north = points[:, 0], points[:, 1]
    inside = np.zeros(len(points), dtype=bool)
    e0, n0 = polygon[-1]
    for e1, n1 in polygon:
        if n0 != n1:
            spans = (n0 > north) != (n1 > north)
            inside ^= spans & (east < (e1 - e0) * (north - n0) / (n1 - n0) + e0)
        e0, n0 = e1, n1
    return inside


LatLon = tuple[float, float]
MAX_DISTANCE_KM = 20.0
"""Longest distance of a site from the vehicle's origin; a farther file is of another site."""


@dataclass(frozen=True, slots=True)
class SiteArea:
    """A polygon in degrees, its holes, and its weight relative to the other polygons."""

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
    """Weights from the south-west, (rows, columns); NaN: outside of the area."""


SearchSite = tuple[SiteArea, ...] | SiteRaster


def grid_of_site(
    site: SearchSite, origin: LocalOrigin, cell_m: float, fence_enu_m: Corners | None = None
) -> SearchGrid:
    """Return the grid about a local origin.

    `ValueError`: more than 20 km away, too many cells, no weight, or all outside of the fence.
    """
    grid = _of_site(site, origin, cell_m)
    if fence_enu_m is not None and share_outside(grid, fence_enu_m) > 1.0 - 1e-9:
        raise ValueError("the search area lies entirely outside the fence")
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
    if away_km <= MAX_DISTANCE_KM:
        return corners
    swapped = (origin.enu_from_geodetic(lon, lat, origin.altitude_m) for lat, lon in corners_deg)
    hint = ""
    if _most_km(tuple(each[:2] for each in swapped)) <= MAX_DISTANCE_KM:
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
    centres = shape.centres_enu_m
    row = np.clip(rows * (centres[:, 1] - south_m) / (north_m - south_m), 0, rows - 1).astype(int)
    column = np.clip(columns * (centres[:, 0] - west_m) / (east_m - west_m), 0, columns - 1)
    sampled = site.weights[row, column.astype(int)]
    weights = shape.on_map(sampled, float("nan"))
    return grid_of_weights(shape.west_m, shape.south_m, shape.cell_m, weights)
