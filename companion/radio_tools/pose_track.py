"""Poses of the vehicle while a radio was calibrated, and the tests that it performed.

Theory of operation. Everything is evaluated at a time, so that a lag is a shift of it. Positions
and roll and pitch are interpolated, yaw along its shorter way. The tests are recognised by yaw and
distance: a turn changes yaw without moving, a circle moves about the point without a change of
distance, a line has several distances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.domain import PositionEnu
from companion.io.radio_recording import TimedPose
from companion.radio_tools.clustered_fit import Flags, Matrix, Vector

MOST_GAP_S = 1.5
"""Poses are not interpolated over longer gaps."""
STANDING_MPS = 0.5
TURN_RAD = math.radians(330.0)
CIRCLE_RAD = math.radians(270.0)
STEP_S = 0.25
LEAST_DISTANCE_M = 1.0
"""Distances that are nearer to each other, or within a twentieth, are one."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The point as seen from the vehicle at some times, (n,) each."""

    place_m: Matrix
    """Vehicle positions, (n, 3)."""
    distance_m: Vector
    """Slant."""
    closing_mps: Vector
    """Rate of the distance, positive when it grows."""
    speed_mps: Vector
    north_rad: Vector
    """Direction to the point, clockwise from north."""


class PoseTrack:
    """Poses by time; `point_m` is the emitter's known position."""

    def __init__(self, poses: Sequence[TimedPose], point_m: PositionEnu) -> None:
        ordered = sorted(poses, key=lambda pose: pose.t_s)
        kept = [p for i, p in enumerate(ordered) if i == 0 or p.t_s > ordered[i - 1].t_s]
        self.times_s: Vector = np.array([pose.t_s for pose in kept])
        self.places_m: Matrix = np.array([pose.enu_m for pose in kept]).reshape(-1, 3)
        self.point_m = point_m
        oriented = [pose for pose in kept if pose.yaw_rad is not None]
        self._yaw_times_s: Vector = np.array([pose.t_s for pose in oriented])
        self._yaws_rad = np.unwrap(np.array([pose.yaw_rad for pose in oriented], dtype=float))
        tilts = [(pose.roll_rad or 0.0, pose.pitch_rad or 0.0) for pose in oriented]
        self._tilts_rad: Matrix = np.array(tilts).reshape(-1, 2)
        sigmas = [pose.sigma_m for pose in kept if pose.sigma_m is not None]
        self.sigma_m = float(np.median(sigmas)) if sigmas else None
        """Median accuracy of the vehicle's position; None: not reported."""

    @property
    def has_yaw(self) -> bool:
        """Return True if attitudes are known."""
        return len(self._yaw_times_s) > 1

    def knows(self, times_s: Vector, *, with_yaw: bool = False) -> Flags:
        """Return flags, (n,), of the times with poses near on both sides."""
        known = self._yaw_times_s if with_yaw else self.times_s
        if len(known) < 2:
            return np.zeros(len(times_s), dtype=np.bool_)
        after = np.clip(np.searchsorted(known, times_s), 1, len(known) - 1)
        is_inside = (times_s >= known[0]) & (times_s <= known[-1])
        is_near = known[after] - known[after - 1] <= MOST_GAP_S
        return np.asarray(is_inside & is_near)

    def place(self, times_s: Vector) -> Matrix:
        """Return interpolated positions, (n, 3), m."""
        columns = [np.interp(times_s, self.times_s, column) for column in self.places_m.T]
        return np.stack(columns, axis=1)

    def yaw_rad(self, times_s: Vector) -> Vector:
        """Return the yaw clockwise from north, unwrapped, (n,)."""
        return np.interp(times_s, self._yaw_times_s, self._yaws_rad)

    def seen(self, times_s: Vector) -> Seen:
        """Return the point as seen from the vehicle."""
        place = self.place(times_s)
        way = np.array(self.point_m) - place
        distance = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
        half_s = 0.2
        velocity = (self.place(times_s + half_s) - self.place(times_s - half_s)) / (2.0 * half_s)
        closing = -np.sum(velocity * way, axis=1) / distance
        speed = np.linalg.norm(velocity, axis=1)
        return Seen(place, distance, closing, speed, np.arctan2(way[:, 0], way[:, 1]))

    def in_body(self, times_s: Vector) -> Matrix:
        """Return unit vectors to the point along nose, right and down, (n, 3)."""
        way = np.array(self.point_m) - self.place(times_s)
        way /= np.maximum(np.linalg.norm(way, axis=1), 1e-6)[:, None]
        north, east, down = way[:, 1], way[:, 0], -way[:, 2]
        yaw = self.yaw_rad(times_s)
        roll, pitch = (
            np.interp(times_s, self._yaw_times_s, column) for column in self._tilts_rad.T
        )
        ahead = np.cos(yaw) * north + np.sin(yaw) * east
        right = -np.sin(yaw) * north + np.cos(yaw) * east
        nose = np.cos(pitch) * ahead - np.sin(pitch) * down
        below = np.sin(pitch) * ahead + np.cos(pitch) * down
        right, below = (
            np.cos(roll) * right + np.sin(roll) * below,
            -np.sin(roll) * right + np.cos(roll) * below,
        )
        return np.stack([nose, right, below], axis=1)


def distances_of(distances_m: Vector) -> list[float]:
    """Return the distinct distances, ascending."""
    found: list[float] = []
    for distance in np.sort(distances_m):
        if not found or distance - found[-1] > max(LEAST_DISTANCE_M, 0.05 * found[-1]):
            found.append(float(distance))
    return found


@dataclass(frozen=True, slots=True)
class FieldTests:
    """Tests that the vehicle performed."""

    turned_rad: float = 0.0
    """Yaw over ground that it did not leave, both ways together."""
    circled_rad: float = 0.0
    """About the point, at one distance."""
    circle_m: float = 0.0

    @property
    def has_turn(self) -> bool:
        """Return True if it turned once about itself."""
        return self.turned_rad >= TURN_RAD

    @property
    def has_circle(self) -> bool:
        """Return True if it went about the point."""
        return self.circled_rad >= CIRCLE_RAD


def find_tests(track: PoseTrack) -> FieldTests:
    """Find turn and circle by yaw and distance."""
    if len(track.times_s) < 2:
        return FieldTests()
    times = np.arange(track.times_s[0], track.times_s[-1], STEP_S)
    seen = track.seen(times)
    is_known = track.knows(times)
    stands = is_known & (seen.speed_mps < STANDING_MPS)
    turned = 0.0
    if track.has_yaw and len(times) > 1:
        steps = np.abs(np.diff(track.yaw_rad(times)))
        turned = float(steps[stands[1:] & stands[:-1]].sum())
    about = is_known & (seen.speed_mps > 2.0 * STANDING_MPS)
    about &= np.abs(seen.closing_mps) < 0.3 * seen.speed_mps
    if len(times) < 2 or not about.any():
        return FieldTests(turned)
    radius = float(np.median(seen.distance_m[about]))
    about &= np.abs(seen.distance_m - radius) < 0.2 * radius
    steps = np.diff(np.unwrap(seen.north_rad))
    circled = abs(float(steps[about[1:] & about[:-1]].sum()))
    return FieldTests(turned, circled, radius)
