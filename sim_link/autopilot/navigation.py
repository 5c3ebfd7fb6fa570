"""Error of the autopilot's position estimate, and the motion as it estimates it.

Theory of operation. The horizontal error of a GNSS receiver is first-order Gauss-Markov on each
axis, correlation exp(-t / tau), stationary from the start: a whole search shares it. The height has
a process of its own (receiver and barometer), the compass a constant error. The autopilot steers by
its estimate, so it holds the estimated position and the true one wanders off by the error. A change
of the fix (RTK fixed, float, lost) is a jump: another error, of another size.

The reported accuracy is the true sigma times `reported_ratio`, below 1 for a receiver between walls
that does not know of its reflections.

Source: P. Groves, Principles of GNSS, Inertial and Multisensor Integrated Navigation (2013), 9.3.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.domain import NonNegative, Params, PositionEnu, Positive
from sim_link.world.point_mass import PointMass

FixName = Literal["3d", "dgps", "rtk_float", "rtk_fixed"]


class FixChange(Params, frozen=True):
    """Change of the kind of fix at a time."""

    at_s: NonNegative
    """Since boot."""
    fix: FixName
    sigma_m: NonNegative
    height_sigma_m: NonNegative | None = None
    """None: as before."""


class NavigationParams(Params, frozen=True):
    """The errors of the vehicle's position and heading; by default none, as with RTK."""

    fix: FixName = "rtk_fixed"
    sigma_m: NonNegative = 0.0
    """Horizontal, per axis."""
    time_constant_s: Positive = 300.0
    """After which it has forgotten itself to 1/e."""
    height_sigma_m: NonNegative = 0.0
    height_time_constant_s: Positive = 300.0
    compass_error_deg: Annotated[float, msgspec.Meta(ge=-180.0, le=180.0)] = 0.0
    """Estimated heading minus the true one, clockwise positive."""
    reports_accuracy: bool = True
    """True if the accuracies are reported; otherwise they are 0, unknown."""
    reported_ratio: NonNegative = 1.0
    """Reported accuracy as a multiple of the true one."""
    fix_changes: tuple[FixChange, ...] = ()
    """Changes of the fix, in any order."""

    @property
    def errs_in_place(self) -> bool:
        """True if the estimated position ever differs from the true one."""
        changed = any(each.sigma_m or each.height_sigma_m for each in self.fix_changes)
        return bool(self.sigma_m or self.height_sigma_m or changed)


class NavigationError:
    """Estimated position minus the true one, over time."""

    def __init__(self, params: NavigationParams, rng: np.random.Generator) -> None:
        self._params = params
        self._rng = rng
        self._coming = sorted(params.fix_changes, key=lambda each: each.at_s, reverse=True)
        self.fix: FixName = params.fix
        self.sigma_m = params.sigma_m
        """Per horizontal axis, of now."""
        self.height_sigma_m = params.height_sigma_m
        self._normals: list[float] = rng.standard_normal(3).tolist()

    @property
    def enu_m(self) -> PositionEnu:
        """East, north and up."""
        e, n, u = self._normals
        return (self.sigma_m * e, self.sigma_m * n, self.height_sigma_m * u)

    def step(self, now_s: float, dt_s: float) -> None:
        """Go on for `dt_s` to `now_s` seconds since boot; always draws as much."""
        params = self._params
        fresh: list[float] = self._rng.standard_normal(3).tolist()
        kept = math.exp(-dt_s / params.time_constant_s)
        kept_up = math.exp(-dt_s / params.height_time_constant_s)
        self._normals = [
            share * old + math.sqrt(1.0 - share * share) * new
            for share, old, new in zip((kept, kept, kept_up), self._normals, fresh, strict=True)
        ]
        while self._coming and self._coming[-1].at_s <= now_s:
            change = self._coming.pop()
            self.fix, self.sigma_m = change.fix, change.sigma_m
            if change.height_sigma_m is not None:
                self.height_sigma_m = change.height_sigma_m
            self._normals = self._rng.standard_normal(3).tolist()


class EstimatedMotion:
    """Motion as the autopilot estimates it: the true one, displaced by the navigation error.

    The ground is displaced as well, so that a vehicle on the ground is on it in the estimate, too.
    """

    def __init__(self, body: PointMass, error: NavigationError) -> None:
        self._body = body
        self._error = error

    @property
    def position_enu_m(self) -> PositionEnu:
        """Local east, north and up, as estimated."""
        (e, n, u), (de, dn, du) = self._body.position_enu_m, self._error.enu_m
        return (e + de, n + dn, u + du)

    @property
    def ground_up_m(self) -> float:
        """Height of the ground on the estimated scale."""
        return self._body.ground_up_m + self._error.enu_m[2]

    @property
    def velocity_enu_mps(self) -> PositionEnu:
        """True velocity: GNSS measures it to some cm/s."""
        return self._body.velocity_enu_mps

    @property
    def yaw_ned_rad(self) -> float:
        """True yaw; the compass error is in commands and reports."""
        return self._body.yaw_ned_rad

    @property
    def height_m(self) -> float:
        """Height above the ground."""
        return self._body.height_m

    @property
    def is_on_ground(self) -> bool:
        """True if the vehicle touches the ground."""
        return self._body.is_on_ground

    @property
    def drift_mps(self) -> float:
        """Horizontal speed that the wind adds to every command."""
        return self._body.drift_mps
