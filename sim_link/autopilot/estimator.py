"""The autopilot's position estimate: GNSS, estimator, local frame.

Theory of operation. The world's frame is local east-north-up from the scenario's origin. The
autopilot's local frame has its zero at the EKF origin, which a station may move
(SET_GPS_GLOBAL_ORIGIN), and its estimate differs from the truth by a bias: the navigation's error
(`navigation`), commanded jumps, and the drift while there is no fix. White noise is in the reports
only. An autopilot steers by its estimate. The navigation's error is in that estimate, and so in
every position that it holds. A target goes into that frame, the world's as GNSS shows it, through
`world_from_local` or `world_from_geodetic`, which subtract jumps and drift; a position it merely
holds stays where it is then, because a real estimator announces a reset to its controllers.

Error of the autopilot's position estimate, and the motion as it estimates it.

Theory of operation. The horizontal error of a GNSS receiver is first-order Gauss-Markov on each
axis, correlation exp(-t / tau), stationary from the start: a whole search shares it. The height has
a process of its own (receiver and barometer), the compass a constant error. The autopilot steers by
its estimate, so it holds the estimated position and the true one wanders off by the error. A change
of the fix (RTK fixed, float, lost) is a jump: another error, of another size.

The reported accuracy is the true sigma times `reported_ratio`, below 1 for a receiver between walls
that does not detect reflections.

Source: P. Groves, Principles of GNSS, Inertial and Multisensor Integrated Navigation (2013), 9.3.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.domain import NonNegative, Params, PositionEnu, Positive
from companion.geometry.coordinates import LocalOrigin, wrap_pi
from sim_link.autopilot.incidents import EstimatorVote
from sim_link.world.point_mass import PointMass

FixName = Literal["3d", "dgps", "rtk_float", "rtk_fixed"]


class FixChange(Params, frozen=True):
    """Change of the kind of fix at a time."""

    at_s: NonNegative
    """Time since boot."""
    fix: FixName
    sigma_m: NonNegative
    height_sigma_m: NonNegative | None = None
    """Standard deviation of the height; None: as before."""


class NavigationParams(Params, frozen=True):
    """Errors of the vehicle's position and heading; by default none, as with RTK."""

    fix: FixName = "rtk_fixed"
    sigma_m: NonNegative = 0.0
    """Standard deviation of the horizontal position, per axis."""
    time_constant_s: Positive = 300.0
    """Time constant after which the error's correlation has fallen to 1/e."""
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
    def errs_in_position(self) -> bool:
        """True if the estimated position ever differs from the true one."""
        changed = any(each.sigma_m or each.height_sigma_m for each in self.fix_changes)
        return bool(self.sigma_m or self.height_sigma_m or changed)


class GpsParams(Params, frozen=True):
    """Effects of GNSS and estimator on the reported position."""

    drift_mps: NonNegative = 0.3
    """Drift of the estimate without a fix, in m/s."""
    valid_without_fix_s: NonNegative = 5.0
    """Time for which the estimate is used without a fix."""
    receivers: Literal[1, 2] = 1
    """GNSS receivers; the second one reports by GPS2_RAW."""


class NavigationError:
    """Estimated position minus the true one, over time."""

    def __init__(self, params: NavigationParams, rng: np.random.Generator) -> None:
        self._params = params
        self._rng = rng
        self._coming = sorted(params.fix_changes, key=lambda each: each.at_s, reverse=True)
        self.fix: FixName = params.fix
        self.sigma_m = params.sigma_m
        """Current standard deviation, per horizontal axis."""
        self.height_sigma_m = params.height_sigma_m
        self._normals: list[float] = rng.standard_normal(3).tolist()

    @property
    def enu_m(self) -> PositionEnu:
        """East, north and up."""
        e, n, u = self._normals
        return (self.sigma_m * e, self.sigma_m * n, self.height_sigma_m * u)

    def step(self, now_s: float, dt_s: float) -> None:
        """Advance by `dt_s` to `now_s` seconds since boot; always draws as much."""
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
        """True velocity: GNSS measures it to a few cm/s."""
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


Kinematics = PointMass | EstimatedMotion
"""Position and motion of a vehicle: the truth, or the autopilot's estimate."""

REACQUIRE_RATE_PER_S = 1.0
"""Rate at which the drift of a loss decays once there is a fix again, per s."""
GOOD_RATIO, BLIND_RATIO = 0.05, 0.6
PERFECT = NavigationParams()
RTK_SIGMA_M, RTK_HEIGHT_SIGMA_M = 0.02, 0.04
"""Accuracy that a receiver without a simulated error reports: ZED-F9P, 0.01 m + 1 ppm, its base 10
km off; heights twice as much."""


class Estimator:
    """GPS receiver and EKF of one vehicle.

    Args:
        origin: Zero of the world's frame, and of the local frame at boot.
        noise_m: Standard deviation per axis of the reported position.
        navigation: Errors of position and heading; by default there are none.
    """

    def __init__(
        self,
        origin: LocalOrigin,
        gps: GpsParams,
        noise_m: float,
        rng: np.random.Generator,
        navigation: NavigationParams = PERFECT,
    ) -> None:
        self.world_origin = origin
        self.origin = origin
        self.reported_enu_m: PositionEnu = (0.0, 0.0, 0.0)
        """Reported position in the world's frame."""
        self.has_fix = True
        self.is_position_valid = True
        self.yaw_bias_rad = math.radians(navigation.compass_error_deg)
        """Estimated heading minus the true one."""
        self.navigation = navigation
        self.error: NavigationError | None = None
        """Error of the estimated position; None if it has none."""
        if navigation.errs_in_position:
            self.error = NavigationError(navigation, rng.spawn(1)[0])
        self._origin_enu_m: PositionEnu = (0.0, 0.0, 0.0)
        self._gps = gps
        self._noise_m = noise_m
        self._rng = rng
        self._jumped: PositionEnu = (0.0, 0.0, 0.0)
        self._drift: PositionEnu = (0.0, 0.0, 0.0)
        self._heading_rad = 0.0
        self._lost_s: float | None = None
        self._lost_until_s: float | None = None
        self._receivers_lost_until_s = [-math.inf] * gps.receivers
        self._poor_ratio = 0.0
        self._poor_of: EstimatorVote = "all"
        self._poor_until_s = -math.inf
        self._now_s = 0.0

    @property
    def bias_enu_m(self) -> PositionEnu:
        """Estimate minus truth."""
        if self.error is None:
            return self._shift_enu_m
        (e, n, u), (de, dn, du) = self._shift_enu_m, self.error.enu_m
        return (e + de, n + dn, u + du)

    @property
    def _shift_enu_m(self) -> PositionEnu:
        """Estimate minus the state that the vehicle steers by."""
        jumped, drift = self._jumped, self._drift
        return (jumped[0] + drift[0], jumped[1] + drift[1], jumped[2] + drift[2])

    @property
    def fix(self) -> FixName:
        """Return the kind of the fix while there is one."""
        return self.navigation.fix if self.error is None else self.error.fix

    @property
    def reported_accuracy_m(self) -> tuple[float, float]:
        """Reported horizontal and vertical sigma; 0: unknown. By default of white RTK noise."""
        ratio, noise_m = self.navigation.reported_ratio, self._noise_m
        if not self.navigation.reports_accuracy:
            return (0.0, 0.0)
        if self.error is None or self.error.sigma_m == 0.0:
            sigmas_m = (math.hypot(RTK_SIGMA_M, noise_m), math.hypot(RTK_HEIGHT_SIGMA_M, noise_m))
        else:
            sigmas_m = (self.error.sigma_m, self.error.height_sigma_m)
        return (ratio * sigmas_m[0], ratio * sigmas_m[1])

    @property
    def local_enu_m(self) -> PositionEnu:
        """The reported position relative to the EKF origin."""
        return self.local_from_world(self.reported_enu_m)

    def test_ratio(self, of: EstimatorVote) -> float:
        """Return the innovation test ratio (PX4) or variance (ArduPilot) of a measurement."""
        ratio = GOOD_RATIO if self.has_fix else BLIND_RATIO
        if of == "compass":
            ratio = GOOD_RATIO
        is_poor = self._now_s < self._poor_until_s and self._poor_of in (of, "all")
        return max(ratio, self._poor_ratio) if is_poor else ratio

    def receiver_has_fix(self, receiver: int) -> bool | None:
        """Return True if a GNSS receiver, counted from 0, has a fix; None if it is not fitted."""
        if receiver >= len(self._receivers_lost_until_s):
            return None
        return self.has_fix and self._now_s >= self._receivers_lost_until_s[receiver]

    def lose_fix(self, until_s: float, receiver: int | None = None) -> None:
        """Let one receiver see no satellite until a time, or all of them (None)."""
        lost_until_s = self._receivers_lost_until_s
        for number in range(len(lost_until_s)):
            if receiver in (None, number):
                lost_until_s[number] = until_s
        if min(lost_until_s) >= until_s:
            self._lost_until_s = until_s

    def degrade(self, ratio: float, until_s: float, of: EstimatorVote = "all") -> None:
        """Let measurements contradict the estimate until a time."""
        self._poor_ratio, self._poor_until_s, self._poor_of = ratio, until_s, of

    def jump(self, offset_enu_m: PositionEnu, yaw_rad: float) -> None:
        """Reset the estimate by this offset."""
        (e, n, u), (de, dn, du) = self._jumped, offset_enu_m
        self._jumped = (e + de, n + dn, u + du)
        self.yaw_bias_rad = wrap_pi(self.yaw_bias_rad + yaw_rad)

    def step(self, now_s: float, true_enu_m: PositionEnu, dt_s: float) -> None:
        """Report a position at `now_s` seconds since boot."""
        self._now_s = now_s
        if self._lost_until_s is not None:
            self._watch_fix(now_s, dt_s, self._lost_until_s)
        if self.error is not None:
            self.error.step(now_s, dt_s)
        (e, n, u), (be, bn, bu) = true_enu_m, self.bias_enu_m
        if self._noise_m > 0.0:
            de, dn, du = (self._noise_m * self._rng.standard_normal(3)).tolist()
            be, bn, bu = be + de, bn + dn, bu + du
        self.reported_enu_m = (e + be, n + bn, u + bu)

    def _watch_fix(self, now_s: float, dt_s: float, lost_until_s: float) -> None:
        self.has_fix = now_s >= lost_until_s
        if self.has_fix:
            self._lost_s = None
            self.is_position_valid = True
            kept = math.exp(-REACQUIRE_RATE_PER_S * dt_s)
            self._drift = (kept * self._drift[0], kept * self._drift[1], 0.0)
            return
        if self._lost_s is None:
            self._lost_s = now_s
            self._heading_rad = float(self._rng.uniform(-math.pi, math.pi))
        self.is_position_valid = now_s - self._lost_s < self._gps.valid_without_fix_s
        step_m = self._gps.drift_mps * dt_s
        e, n, _ = self._drift
        cos, sin = math.cos(self._heading_rad), math.sin(self._heading_rad)
        self._drift = (e + step_m * cos, n + step_m * sin, 0.0)

    def set_origin(self, origin: LocalOrigin) -> None:
        """Move the zero of the local frame; the vehicle stays where it is."""
        self.origin = origin
        self._origin_enu_m = self.world_origin.enu_from_geodetic(
            origin.latitude_deg, origin.longitude_deg, origin.altitude_m
        )

    def shift_origin(self, offset_enu_m: PositionEnu) -> None:
        """Move the zero of the local frame."""
        (e, n, u), (de, dn, du) = self._origin_enu_m, offset_enu_m
        position = self.world_origin.geodetic_from_enu((e + de, n + dn, u + du))
        self.set_origin(LocalOrigin(*position, self.world_origin.projection))

    def local_from_world(self, enu_m: PositionEnu) -> PositionEnu:
        """Convert a position from the world's frame to the EKF's local frame, without the bias."""
        (e, n, u), (oe, on, ou) = enu_m, self._origin_enu_m
        return (e - oe, n - on, u - ou)

    def shown_from_world(self, enu_m: PositionEnu) -> PositionEnu:
        """Return the estimated local position of a true one; inverse of `world_from_local`."""
        (e, n, u), (oe, on, ou), (be, bn, bu) = enu_m, self._origin_enu_m, self._shift_enu_m
        return (e - oe + be, n - on + bn, u - ou + bu)

    def world_from_local(self, enu_m: PositionEnu) -> PositionEnu:
        """Return the true position at which the vehicle arrives when sent to a local position."""
        (e, n, u), (oe, on, ou), (be, bn, bu) = enu_m, self._origin_enu_m, self._shift_enu_m
        return (e + oe - be, n + on - bn, u + ou - bu)

    def world_from_geodetic(
        self, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> PositionEnu:
        """Return the true position that the vehicle reaches when sent to a geodetic one."""
        position = self.world_origin.enu_from_geodetic(latitude_deg, longitude_deg, altitude_m)
        (e, n, u), (be, bn, bu) = position, self._shift_enu_m
        return (e - be, n - bn, u - bu)
