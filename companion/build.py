"""From a configuration to planner, session and endpoint."""

from __future__ import annotations

import math
from typing import Any

from companion.config.schema import CompanionConfig, CrossingKind, PatternKind, PlannerConfig
from companion.guard.gate import Guard
from companion.guidance.emitters import EmitterQueue
from companion.guidance.session import GuidanceSession
from companion.link.endpoint import CompanionEndpoint
from companion.link.inputs import InputRecorder
from companion.link.journal import Journal
from companion.mav.signing import Signing
from companion.planning.base import Planner
from companion.planning.fim import FimPlanner
from companion.planning.latched_crossing import LatchedCrossing
from companion.planning.patterns import ExpandingSquare, Lawnmower, SectorSearch
from companion.planning.reactive_crossing import ReactiveCrossing
from companion.planning.search import Pattern, SearchPlanner
from companion.planning.search_then_cross import SearchThenCross
from companion.tuning import Tunables


def build_planner(config: CompanionConfig) -> Planner[Any]:
    """The planner that the configuration names."""
    planner = config.planner
    if planner.search is None:
        return _build_one(planner.kind, config)
    search = SearchPlanner(_build_pattern(planner.search, planner))
    return SearchThenCross(search, _build_one(planner.kind, config), planner.lost_after_s)


def _build_one(kind: CrossingKind | PatternKind, config: CompanionConfig) -> Planner[Any]:
    planner, noise = config.planner, config.estimation.filter
    match kind:
        case "latched_crossing":
            return LatchedCrossing(planner.latched_crossing)
        case "reactive_crossing":
            return ReactiveCrossing(planner.reactive_crossing)
        case "fim":
            bearing_sigma_rad = math.radians(noise.bearing_sigma_deg)
            return FimPlanner(planner.fim, noise.range_sigma_m, bearing_sigma_rad)
        case _:
            return SearchPlanner(_build_pattern(kind, planner))


def _build_pattern(kind: PatternKind, config: PlannerConfig) -> Pattern:
    match kind:
        case "lawnmower":
            return Lawnmower(config.lawnmower)
        case "expanding_square":
            return ExpandingSquare(config.expanding_square)
        case "sector":
            return SectorSearch(config.sector)


def build_session(config: CompanionConfig) -> GuidanceSession:
    """The guidance of one flight."""
    return GuidanceSession(
        config.mission,
        EmitterQueue(config.estimation, config.emitters, config.emitter_id),
        build_planner(config),
        Guard(config.limits.guard_limits()),
        needs_origin=config.vehicle.setpoint == "global_int",
        fence_plan=config.limits.fence_plan(),
    )


def build_endpoint(
    config: CompanionConfig,
    journal: Journal,
    ranging_links: int = 0,
    *,
    tunables: Tunables | None = None,
    gcs_links: int = 0,
    signing: Signing | None = None,
    started_unix_s: float = 0.0,
    recorder: InputRecorder | None = None,
) -> CompanionEndpoint:
    """The companion as a MAVLink participant.

    Args:
        config: The configuration.
        journal: Where it reports.
        ranging_links: Links beside the vehicle's that carry only ranging.
        tunables: The parameters that ground stations may change; None: as the configuration is.
        gcs_links: Links to ground stations, behind the others.
        signing: Proves what arrives and signs what leaves; None: neither.
        started_unix_s: Unix time at the clock's zero, for the timestamps of signatures.
        recorder: Keeps what the endpoint is told.
    """
    tunables = tunables or Tunables(config, build_planner)
    return CompanionEndpoint(
        build_session(tunables.config),
        config.vehicle,
        journal,
        1 + ranging_links + gcs_links,
        config.link,
        tunables=tunables,
        gcs_links=gcs_links,
        signing=signing,
        started_unix_s=started_unix_s,
        recorder=recorder,
    )
