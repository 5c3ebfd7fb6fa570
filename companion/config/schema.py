"""The companion's configuration: the packages' own parameters, composed.

Defaults live in the records; a file only says what differs. `load_config` also checks what no
single record can see.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec

from companion.config.load import load_yaml
from companion.config.process import LogConfig as LogConfig
from companion.config.process import ProcessConfig
from companion.errors import ConfigError
from companion.estimation.tracker import TrackerParams
from companion.guard.envelope import Envelope
from companion.guard.fence import Fence
from companion.guard.gate import GuardLimits
from companion.guard.reserve import Reserve
from companion.guard.stopping import Stopping
from companion.guidance.session import SessionParams
from companion.link.params import LinkParams, VehicleParams
from companion.params import NonNegative, Params, Positive
from companion.planning.base import PlanRequest
from companion.planning.fim import FimParams
from companion.planning.latched_crossing import LatchedCrossingParams
from companion.planning.patterns import (
    ExpandingSquareParams,
    Lawnmower,
    LawnmowerParams,
    SectorParams,
)
from companion.planning.reactive_crossing import ReactiveCrossingParams

DEFAULT_FENCE = ((-150.0, -150.0), (150.0, -150.0), (150.0, 150.0), (-150.0, 150.0))


class LimitsConfig(Params, frozen=True):
    """What no setpoint may exceed; metres in the autopilot's local frame, east and north."""

    fence_enu_m: tuple[tuple[float, float], ...] = DEFAULT_FENCE
    """Corners of the fence polygon, about the autopilot's local origin."""
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
    battery_pct_per_km: Positive | None = None
    """Charge that a kilometre of the way home takes; null: the battery is not looked at."""
    battery_reserve_pct: Annotated[float, msgspec.Meta(ge=0.0, lt=100.0)] = 20.0
    """Charge that is left at home."""

    def __post_init__(self) -> None:
        """Refuse limits that contradict each other."""
        self.guard_limits()

    def guard_limits(self) -> GuardLimits:
        """The same limits as the guard takes them.

        Raises:
            ValueError: They contradict each other.
        """
        fence = Fence(self.fence_enu_m, self.fence_margin_m, self.keep_out_enu_m)
        return GuardLimits(fence, self._envelope(), self._stopping(), *self._way_home())

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


PatternKind = Literal["lawnmower", "expanding_square", "sector"]
CrossingKind = Literal["latched_crossing", "reactive_crossing", "fim"]


class PlannerConfig(Params, frozen=True):
    """Which planner flies, and the parameters of each."""

    kind: CrossingKind | PatternKind = "latched_crossing"
    """A pattern here is flown whatever is heard; see `search` for one that ends with contact."""
    search: PatternKind | None = None
    """What is flown while there is no contact; null: hold."""
    lost_after_s: Positive = 20.0
    """Without a usable measurement for this long, the search goes on."""
    latched_crossing: LatchedCrossingParams = LatchedCrossingParams()
    reactive_crossing: ReactiveCrossingParams = ReactiveCrossingParams()
    fim: FimParams = FimParams()
    lawnmower: LawnmowerParams = LawnmowerParams()
    expanding_square: ExpandingSquareParams = ExpandingSquareParams()
    sector: SectorParams = SectorParams()

    def __post_init__(self) -> None:
        """Refuse a search before a search."""
        if self.search is not None and self.kind in get_args(PatternKind):
            raise ValueError(f"search must be null where kind is {self.kind}: it searches itself")


class CompanionConfig(Params, frozen=True):
    """Everything the companion can be told by a file."""

    mission: SessionParams = SessionParams()
    emitter_id: Annotated[int, msgspec.Meta(ge=0, le=65535)] | None = None
    """The emitter to look for; null: the first one heard."""
    estimation: TrackerParams = TrackerParams()
    planner: PlannerConfig = PlannerConfig()
    limits: LimitsConfig = LimitsConfig()
    vehicle: VehicleParams = VehicleParams()
    link: LinkParams = LinkParams()
    log: LogConfig = LogConfig()
    process: ProcessConfig = ProcessConfig()


def load_config(path: Path | None) -> CompanionConfig:
    """The configuration in a file, or the defaults without one.

    Raises:
        ConfigError: The file is wrong; one line names it, the place and the problem.
    """
    if path is None:
        return CompanionConfig()
    config = load_yaml(path, CompanionConfig)
    problem = inconsistency(config)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}")
    return config


def with_signing_key(config: CompanionConfig, path: Path) -> CompanionConfig:
    """The same configuration with another file that holds the signing key."""
    link = msgspec.structs.replace(config.link, signing_key_file=str(path))
    return msgspec.structs.replace(config, link=link)


def inconsistency(config: CompanionConfig) -> str | None:
    """What contradicts what between sections, with its YAML path, or None."""
    limits, mission = config.limits, config.mission
    if not limits.altitude_min_m <= mission.altitude_m <= limits.altitude_max_m:
        band = f"{limits.altitude_min_m:g} to {limits.altitude_max_m:g} m"
        return f"$.mission.altitude_m: {mission.altitude_m:g} m is outside $.limits ({band})"
    swing_m = config.planner.latched_crossing.altitude_swing_m
    low_m, high_m = mission.altitude_m - swing_m, mission.altitude_m + swing_m
    if not limits.altitude_min_m <= low_m <= high_m <= limits.altitude_max_m:
        return (
            f"$.planner.latched_crossing.altitude_swing_m: {low_m:g} to {high_m:g} m is not "
            "within $.limits"
        )
    if not _has_lanes(config):
        return "$.planner.lawnmower.area_enu_m: nothing of it is left by $.limits"
    own_r95_m = 2.45 * config.estimation.filter.own_position_sigma_m
    if mission.stop_radius_m <= own_r95_m:
        return (
            f"$.mission.stop_radius_m: {mission.stop_radius_m:g} m can never be reached with "
            f"$.estimation.filter.own_position_sigma_m (R95 is at least {own_r95_m:.2f} m)"
        )
    if mission.stop_radius_m > config.estimation.localised_r95_m:
        return (
            f"$.mission.stop_radius_m: {mission.stop_radius_m:g} m must not exceed "
            f"$.estimation.localised_r95_m ({config.estimation.localised_r95_m:g} m)"
        )
    return None


def _has_lanes(config: CompanionConfig) -> bool:
    """Whether a lawnmower that may fly has anything to fly."""
    planner, limits = config.planner, config.limits
    if "lawnmower" not in (planner.kind, planner.search):
        return True
    request = PlanRequest(
        limits.fence_enu_m[0],
        None,
        limits.fence_enu_m,
        limits.fence_margin_m,
        keep_out_enu_m=limits.keep_out_enu_m,
    )
    return bool(Lawnmower(planner.lawnmower).track(request, limits.fence_enu_m[0], 0))
