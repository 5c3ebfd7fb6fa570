"""The companion's configuration: the packages' own parameters, composed.

Defaults live in the records; a file only says what differs. `load_config` also checks what no
single record can see.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec

from companion.config.limits import DEFAULT_FENCE
from companion.config.limits import LimitsConfig as LimitsConfig
from companion.config.load import load_yaml
from companion.config.process import LogConfig as LogConfig
from companion.config.process import ProcessConfig
from companion.errors import ConfigError
from companion.estimation.tracker_params import TrackerParams
from companion.guidance.emitters import QueueParams
from companion.guidance.session import SessionParams
from companion.link.params import LinkParams, VehicleParams
from companion.params import Params, Positive
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
    emitters: QueueParams = QueueParams()
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
    if config.limits.fence_file is not None:
        beside = str(path.parent / config.limits.fence_file)
        limits = msgspec.structs.replace(config.limits, fence_file=beside)
        config = msgspec.structs.replace(config, limits=limits)
        limits.fence_plan()
    problem = inconsistency(config)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}")
    return config


def with_fence(config: CompanionConfig, path: Path) -> CompanionConfig:
    """The same with the fence of a file instead of its own.

    Raises:
        ConfigError: The file holds no fence; one line names it, the element and the problem.
    """
    policy = config.limits.autopilot_fence
    limits = msgspec.structs.replace(
        config.limits,
        fence_file=str(path),
        fence_enu_m=DEFAULT_FENCE,
        autopilot_fence="compare" if policy == "use" else policy,
    )
    limits.fence_plan()
    return msgspec.structs.replace(config, limits=limits)


def with_signing_key(config: CompanionConfig, path: Path) -> CompanionConfig:
    """The same configuration with another file that holds the signing key."""
    link = msgspec.structs.replace(config.link, signing_key_file=str(path))
    return msgspec.structs.replace(config, link=link)


def inconsistency(config: CompanionConfig) -> str | None:
    """What contradicts what between sections, with its YAML path, or None."""
    limits, mission = config.limits, config.mission
    least_m, most_m = limits.guard_limits().altitude_m
    if not least_m <= mission.altitude_m <= most_m:
        band = f"{least_m:g} to {most_m:g} m, 3 navigation_sigma_m inside"
        return f"$.mission.altitude_m: {mission.altitude_m:g} m is outside $.limits ({band})"
    if config.emitter_id is not None and config.emitters.order != "first":
        return (
            f"$.emitters.order: {config.emitters.order} looks for several emitters, but "
            "$.emitter_id names one; list several in $.emitters.listed"
        )
    swing_m = config.planner.latched_crossing.altitude_swing_m
    low_m, high_m = mission.altitude_m - swing_m, mission.altitude_m + swing_m
    if not least_m <= low_m <= high_m <= most_m:
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
    if "lawnmower" not in (planner.kind, planner.search) or not limits.is_fence_local:
        return True
    request = PlanRequest(
        limits.fence_enu_m[0],
        None,
        limits.fence_enu_m,
        limits.fence_margin_m,
        keep_out_enu_m=limits.keep_out_enu_m,
    )
    return bool(Lawnmower(planner.lawnmower).track(request, limits.fence_enu_m[0], 0))
