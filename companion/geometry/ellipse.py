"""Confidence ellipses in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

Point = tuple[float, float]
Covariance = tuple[tuple[float, float], tuple[float, float]]

CHI2_95_TWO = 5.991464547107979
"""95 % quantile of chi-square with two degrees of freedom, -2 ln 0.05."""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse about a point in local east and north."""

    centre_enu_m: Point
    semi_major_m: float
    semi_minor_m: float
    major_enu_rad: float
    """Direction of the major axis, counter-clockwise from east, in (-pi/2, pi/2]."""

    def corners_enu_m(self, count: int = 48) -> tuple[Point, ...]:
        """Points along the ellipse, counter-clockwise, the first one not repeated.

        Args:
            count: How many; at least 3.
        """
        along, across = math.cos(self.major_enu_rad), math.sin(self.major_enu_rad)
        corners = []
        for index in range(max(3, count)):
            turn = 2.0 * math.pi * index / max(3, count)
            major = self.semi_major_m * math.cos(turn)
            minor = self.semi_minor_m * math.sin(turn)
            east = self.centre_enu_m[0] + major * along - minor * across
            north = self.centre_enu_m[1] + major * across + minor * along
            corners.append((east, north))
        return tuple(corners)


def ellipse_95(centre_enu_m: Point, covariance_m2: Covariance) -> Ellipse:
    """The ellipse that holds 95 % of a plane normal distribution.

    Args:
        centre_enu_m: Its mean.
        covariance_m2: Symmetric, east first; rounding that makes an axis negative counts as zero.
    """
    (east, cross), (_, north) = covariance_m2
    middle, half = 0.5 * (east + north), 0.5 * (east - north)
    reach = math.hypot(half, cross)
    major = math.sqrt(max(0.0, middle + reach) * CHI2_95_TWO)
    minor = math.sqrt(max(0.0, middle - reach) * CHI2_95_TWO)
    turn = 0.5 * math.atan2(cross, half)  # atan2(0, 0) is 0: a circle points east
    return Ellipse(centre_enu_m, major, minor, turn)
