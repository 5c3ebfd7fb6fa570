"""What no setpoint may exceed, as the configuration says it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from companion.config.fence_source import read_fence
from companion.errors import ConfigError
from companion.geometry.geofence import GeoFence
from companion.geometry.obstacles import check_corners
from companion.guard.envelope import Envelope
from companion.guard.fence import Corners, Fence
from companion.guard.gate import GuardLimits
from companion.guard.reserve import Reserve
from companion.guard.stopping import Stopping
from companion.guidance.fencing import FencePlan, FencePolicy
from companion.params import NonNegative, Params, Positive

DEFAULT_FENCE = ((-150.0, -150.0), (150.0, -150.0), (150.0, 150.0), (-150.0, 150.0))


class LimitsConfig(Params, frozen=True):
    """What no setpoint may exceed; metres in the autopilot's local frame, east and north."""

    fence_enu_m: tuple[tuple[float, float], ...] = DEFAULT_FENCE
    """Corners of the fence polygon, about the autopilot's local origin."""
    fence_file: str | None = None
    """A QGroundControl .plan or a .kml file with the fence instead, relative to this file."""
    autopilot_fence: Literal["ignore", "compare", "require", "use"] = "compare"
    """What the autopilot's own fence is for; see `FencePolicy`."""
    fence_margin_m: NonNegative = 3.0
    """Distance that setpoints keep from the fence and from keep-outs, on the allowed side."""
    keep_out_enu_m: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Polygons that no setpoint enters, each by its corners."""
    altitude_min_m: Positive = 5.0
    """Above home."""
    altitude_max_m: Positive = 60.0
    """Above home."""
    speed_mps: Positive = 5.0
    climb_mps: Positive = 2.0
    acceleration_mps2: Positive = 2.5
    """Of setpoints, and what the vehicle surely brakes with."""
    step_m: Positive = 8.0
    """Farther ahead of the vehicle than this a setpoint is no faster than the vehicle."""
    latency_s: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.5
    """From a motion that is measured to a setpoint that is obeyed."""
    navigation_sigma_m: NonNegative = 0.3
    """Standard deviation of the vehicle's position, per axis."""
    distance_home_m: Positive | None = None
    """How far from home setpoints may be; null: as far as the fence."""
    battery_pct_per_km: Positive | None = 15.0
    """Charge that a kilometre of the way home takes; null: the battery is not looked at."""
    battery_reserve_pct: Annotated[float, msgspec.Meta(ge=0.0, lt=100.0)] = 20.0
    """Charge that is left at home."""

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        if self.fence_file is not None and self.fence_enu_m != DEFAULT_FENCE:
            raise ValueError("fence_file: fence_enu_m is given, too; one of them is enough")
        if self.autopilot_fence == "use" and self.fence_file is not None:
            raise ValueError("fence_file: autopilot_fence is `use`; one of them is enough")
        self.guard_limits()

    @property
    def is_fence_local(self) -> bool:
        """Whether the fence is known in the local frame from the start."""
        return self.fence_file is None and self.autopilot_fence != "use"

    def guard_limits(self) -> GuardLimits:
        """The same limits as the guard takes them, without a fence that is not local.

        Raises:
            ValueError: They contradict each other; the text begins with the name of one.
        """
        fence = self._fence(self.fence_enu_m if self.is_fence_local else _roomy(self))
        limits = GuardLimits(fence, self._envelope(), self._stopping(), *self._way_home())
        return limits if self.is_fence_local else replace(limits, fence=None)

    def fence_plan(self) -> FencePlan:
        """Where the guard's fence comes from.

        Raises:
            ConfigError: The fence's file cannot be read, or nothing of the fence is left; one line
                names the file and the element.
        """
        return FencePlan(
            self.guard_limits(),
            self.fence_margin_m,
            self.keep_out_enu_m,
            self._site(),
            FencePolicy(self.autopilot_fence),
        )

    def _site(self) -> GeoFence | None:
        if self.fence_file is None:
            return None
        path = Path(self.fence_file)
        site = read_fence(path)
        local = site.local(site.centre)
        keep_outs = (*local.keep_out_enu_m, *self.keep_out_enu_m)
        try:
            check_corners((local.polygon_enu_m, *keep_outs))
            Fence(local.polygon_enu_m, self.fence_margin_m, local.keep_out_enu_m)
        except ValueError as error:
            raise ConfigError(f"{path}: {error}") from None
        return site

    def _fence(self, polygon_enu_m: Corners) -> Fence:
        keep_outs = self.keep_out_enu_m if self.is_fence_local else ()
        try:
            return Fence(polygon_enu_m, self.fence_margin_m, keep_outs)
        except ValueError as error:
            text = str(error)
            keys = {"margin": "fence_margin_m", "keep-out": "keep_out_enu_m"}
            key = next((keys[word] for word in keys if word in text), "fence_enu_m")
            raise ValueError(f"{key}: {text}") from None

    def _envelope(self) -> Envelope:
        return Envelope(
            altitude_min_m=self.altitude_min_m,
            altitude_max_m=self.altitude_max_m,
            speed_mps=self.speed_mps,
            climb_mps=self.climb_mps,
            acceleration_mps2=self.acceleration_mps2,
            step_m=self.step_m,
        )

    def _stopping(self) -> Stopping:
        return Stopping(self.latency_s, self.acceleration_mps2, self.navigation_sigma_m)

    def _way_home(self) -> tuple[float, Reserve | None]:
        distance_m = math.inf if self.distance_home_m is None else self.distance_home_m
        if self.battery_pct_per_km is None:
            return distance_m, None
        return distance_m, Reserve(self.battery_reserve_pct, self.battery_pct_per_km)


def _roomy(limits: LimitsConfig) -> Corners:
    """A fence that is large enough for any margin, to check the other limits with."""
    side_m = 10.0 * (limits.fence_margin_m + 1.0)
    return ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m))
