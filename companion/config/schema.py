"""The companion's configuration, composed of the packages' own parameters.

Defaults live in the records; a file only contains differences. `load_config` also checks
contradictions between records.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec

from companion.config.area_files import read_fence
from companion.config.loader import load_yaml
from companion.config.radios import RadioConfig, flown_radios, is_uncalibrated
from companion.config.search_files import check_search_area
from companion.config.versions import SCHEMA_VERSION, renew
from companion.domain import Distance, NonNegative, Params, Positive
from companion.errors import ConfigError
from companion.estimation.tracker_params import EstimationConfig, TrackerParams
from companion.geometry.geofence import GeoFence
from companion.geometry.obstacles import check_corners
from companion.geometry.polygons import Corners, Point
from companion.guard.gate import GuardLimits
from companion.guard.limits import Envelope, Fence, Reserve, Stopping
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import QueueParams
from companion.guidance.fencing import FencePlan, FencePolicy
from companion.link.interface import LinkParams, VehicleParams
from companion.planning.crossing import LatchedCrossingParams
from companion.planning.planner import PlanRequest
from companion.planning.search import (
    ExpandingSquareParams,
    HeadingDeg,
    LawnmowerParams,
    SearchParams,
    SectorParams,
    Spacing,
)
from companion.search.detection_model import DetectionModel
from companion.search.searched_flight import SearchAreaParams

Speed = Annotated[float, msgspec.Meta(ge=0.1, le=20.0)]
"""Speed in m/s, within the range of the autopilot's own limit (ArduPilot: WPNAV_SPEED 0.1 to 20
m/s, PX4: MPC_XY_VEL_MAX up to 20 m/s)."""
DEFAULT_FENCE = ((-150.0, -150.0), (150.0, -150.0), (150.0, 150.0), (-150.0, 150.0))


class LimitsConfig(Params, frozen=True):
    """Limits of every setpoint; metres in the autopilot's local frame, east and north."""

    fence_enu_m: tuple[tuple[float, float], ...] = DEFAULT_FENCE
    """Corners of the fence polygon, relative to the autopilot's local origin."""
    fence_file: str | None = None
    """File with the fence instead, a QGroundControl .plan or a .kml, relative to this file."""
    autopilot_fence: Literal["ignore", "compare", "require", "use"] = "compare"
    """Use of the autopilot's own fence; see `FencePolicy`."""
    fence_margin_m: NonNegative = 3.0
    """Distance that setpoints keep from the fence and from keep-outs, on the allowed side."""
    keep_out_enu_m: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Polygons that no setpoint enters, each by its corners."""
    altitude_min_m: Distance = 5.0
    """Lowest altitude of setpoints above home."""
    altitude_max_m: Distance = 60.0
    """Highest altitude of setpoints above home."""
    speed_mps: Speed = 5.0
    climb_mps: Speed = 2.0
    acceleration_mps2: Positive = 2.5
    """Acceleration of setpoints, and the deceleration that the vehicle reaches in any case."""
    step_m: ClassVar[float] = 8.0
    """Lead over the vehicle beyond which a setpoint moves no faster than the vehicle, metres."""
    latency_s: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.5
    """Delay from a measurement of the vehicle's motion until it follows the setpoint."""
    navigation_sigma_m: ClassVar[float] = 0.3
    """Standard deviation of the vehicle's position in its local frame, per axis."""
    distance_home_m: Positive | None = None
    """Largest distance of setpoints from home; null: up to the fence."""
    battery_pct_per_km: Positive | None = 15.0
    """Charge for a kilometre of the way home; null: the battery is ignored."""
    battery_reserve_pct: Annotated[float, msgspec.Meta(ge=0.0, lt=100.0)] = 20.0
    """Charge that is left at home."""

    def __post_init__(self) -> None:
        if self.fence_file is not None and self.fence_enu_m != DEFAULT_FENCE:
            raise ValueError("fence_file: fence_enu_m is given, too; one of them is enough")
        if self.autopilot_fence == "use" and self.fence_file is not None:
            raise ValueError("fence_file: autopilot_fence is `use`; one of them is enough")
        self.guard_limits()

    @property
    def is_fence_local(self) -> bool:
        """True if the fence is known in the local frame from the start."""
        return self.fence_file is None and self.autopilot_fence != "use"

    def guard_limits(self) -> GuardLimits:
        """Return the guard's limits, with a local fence only; `ValueError` begins with a key."""
        fence = self._fence(self.fence_enu_m if self.is_fence_local else _roomy(self))
        envelope = Envelope(**{each.name: getattr(self, each.name) for each in fields(Envelope)})
        stopping = Stopping(self.latency_s, self.acceleration_mps2, self.navigation_sigma_m)
        distance_m = math.inf if self.distance_home_m is None else self.distance_home_m
        reserve = None
        if self.battery_pct_per_km is not None:
            reserve = Reserve(self.battery_reserve_pct, self.battery_pct_per_km)
        limits = GuardLimits(fence, envelope, stopping, distance_m, reserve)
        return limits if self.is_fence_local else replace(limits, fence=None)

    def fence_plan(self) -> FencePlan:
        """Return the sources of the guard's fence; `ConfigError` names file and element."""
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


def _roomy(limits: LimitsConfig) -> Corners:
    """Return a fence that is large enough for any margin, to check the other limits."""
    side_m = 10.0 * (limits.fence_margin_m + 1.0)
    return ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m))


AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]


class LogConfig(Params, frozen=True):
    """Logs of a flight."""

    directory: str = "flights"
    """Folder for the folders of the flights."""
    max_mb: Annotated[float, msgspec.Meta(ge=1.0, le=1e9)] = 1000.0
    """Cap of one flight's logs: of more the newest part is kept. A tenth is for events."""
    mcap: bool = False
    """True: flight.mcap is written as well, for Foxglove; needs the extra `mcap`."""
    keep_flights: AtLeastOne | None = None
    """Number of older flights to keep at the start of a new one; null: all."""

    @property
    def max_bytes(self) -> int:
        """Size limit of one flight's logs."""
        return int(1e6 * self.max_mb)


class ProcessConfig(Params, frozen=True):
    """State kept from one process to the next."""

    state_directory: str | None = None
    """Folder of checkpoints and locks; null: systemd's, or ~/.local/state/companion."""
    resume_max_age_s: Positive | None = 600.0
    """The mission's state is saved once a second, for a restart in flight; an older one is not
    restored; null: none is saved."""


PatternKind = Literal["lawnmower", "expanding_square", "sector", "probability"]


class PatternConfig(Params, frozen=True):
    """Layout of the search pattern."""

    spacing_m: Spacing = 20.0
    """Distance between neighbouring legs: at most twice the reliable range of the radio."""
    area_enu_m: tuple[Point, ...] | None = None
    """Corners of the area of a lawnmower; null: the whole fence."""
    heading_deg: HeadingDeg | None = None
    """Heading of lanes, or of the first leg, clockwise from north; null: along the longer side of
    a lawnmower's area, else north."""
    datum_enu_m: Point | None = None
    """Most likely position of the target, the middle of expanding square and sector; null: the
    vehicle position when the search begins."""
    radius_m: Positive | None = None
    """Half the width of an expanding square; null: 100. Length of a sector's legs; null: 60."""

    def __post_init__(self) -> None:
        """Reject an invalid area."""
        self.params("lawnmower")

    def params(self, kind: PatternKind) -> SearchParams:
        """Return the parameters of a pattern; `ValueError` if its layout is impossible.

        That of `probability` is the one flown where the map is even.
        """
        if kind in ("lawnmower", "probability"):
            return LawnmowerParams(
                spacing_m=self.spacing_m,
                area_enu_m=self.area_enu_m,
                lane_heading_deg=self.heading_deg,
            )
        made = ExpandingSquareParams() if kind == "expanding_square" else SectorParams()
        return msgspec.structs.replace(
            made,
            spacing_m=self.spacing_m,
            datum_enu_m=self.datum_enu_m,
            heading_deg=self.heading_deg or 0.0,
            radius_m=self.radius_m or made.radius_m,
        )


CrossingKind = Literal["latched_crossing", "fim"]


class PlannerConfig(Params, frozen=True):
    """The planner in use, and the parameters of each."""

    kind: CrossingKind | Literal["survey"] = "latched_crossing"
    """Planner during contact; `survey` continues the search pattern regardless of contact."""
    search: PatternKind | None = None
    """Pattern while there is no contact; null: hold. `probability`: lanes where the remaining
    probability is highest."""
    pattern: PatternConfig = PatternConfig()
    lost_after_s: Positive = 20.0
    """Time without a usable measurement after which the search pattern resumes."""
    latched_crossing: LatchedCrossingParams = LatchedCrossingParams()

    def __post_init__(self) -> None:
        if self.search is None and self.kind == "survey":
            raise ValueError("kind: survey flies a pattern; set search to one")
        if self.search is not None:
            try:
                self.pattern.params(self.search)
            except ValueError as error:
                raise ValueError(f"pattern: {error}") from None

    @property
    def flown(self) -> CrossingKind | PatternKind | None:
        """Planner during contact: a crossing, or a survey's pattern; None: no pattern is set."""
        return self.search if self.kind == "survey" else self.kind


class CompanionConfig(Params, frozen=True):
    """All keys of a configuration file."""

    schema_version: Annotated[int, msgspec.Meta(ge=1, le=SCHEMA_VERSION)] = SCHEMA_VERSION
    """Version of these keys; files of earlier versions are read, and migrated to this one."""
    mission: SessionParams = SessionParams()
    emitters: QueueParams = QueueParams()
    estimation: EstimationConfig = EstimationConfig()
    search: SearchAreaParams = SearchAreaParams()
    planner: PlannerConfig = PlannerConfig()
    limits: LimitsConfig = LimitsConfig()
    vehicle: VehicleParams = VehicleParams()
    link: LinkParams = LinkParams()
    radios: tuple[RadioConfig, ...] = ()
    """Radios with their native formats."""
    log: LogConfig = LogConfig()
    process: ProcessConfig = ProcessConfig()

    @property
    def tracking(self) -> TrackerParams:
        """`estimation`, with the calibration state of the radios."""
        if not any(is_uncalibrated(radio) for radio in self.radios):
            return self.estimation.params()
        return msgspec.structs.replace(self.estimation.params(), is_range_calibrated=False)

    @property
    def detection(self) -> DetectionModel | None:
        """`search.detection`, by default with the reach of the radio's preset; None if absent."""
        detection = self.search.detection
        return None if detection is None else detection.model(self.estimation.filter.reach_m)


FOLDERS = ("log.directory", "process.state_directory")
FILES = ("link.signing_key_file", "limits.fence_file", "search.area_file")


def load_config(path: Path | None) -> CompanionConfig:
    """Return the configuration in a file, or the defaults; a `ConfigError` names file and key."""
    if path is None:
        return CompanionConfig()
    config = load_yaml(path, CompanionConfig, lambda raw: renew(raw, str(path)))
    config = _from_home(config, path)
    if config.limits.fence_file is not None:
        beside = str(path.parent / config.limits.fence_file)
        limits = msgspec.structs.replace(config.limits, fence_file=beside)
        config = msgspec.structs.replace(config, limits=limits)
        try:
            limits.fence_plan()
        except ConfigError as error:
            raise ConfigError(f"{path}: $.limits.fence_file: {error}") from None
    if config.search.area_file is not None:
        site = path.parent / config.search.area_file
        search = msgspec.structs.replace(config.search, area_file=str(site))
        config = msgspec.structs.replace(config, search=search)
        try:
            check_search_area(site, config.limits.fence_plan().site, search.cell_m)
        except ConfigError as error:
            raise ConfigError(f"{path}: $.search.area_file: {error}") from None
    problem = inconsistency(config)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}")
    return config


def _from_home(config: CompanionConfig, path: Path) -> CompanionConfig:
    """Return the configuration with the home folder for `~` in its paths, as a shell has it."""
    for name in (*FOLDERS, *FILES):
        section, _, key = name.partition(".")
        record = getattr(config, section)
        text = getattr(record, key) or ""
        if (full := os.path.expanduser(text)).startswith("~"):
            raise ConfigError(f"{path}: $.{name}: there is no home folder for {text}")
        if full != text:
            record = msgspec.structs.replace(record, **{key: full})
            config = msgspec.structs.replace(config, **{section: record})
    return config


def with_fence(config: CompanionConfig, path: Path) -> CompanionConfig:
    """Return the configuration with the fence of a file; `ConfigError` as `read_fence`'s."""
    policy = config.limits.autopilot_fence
    limits = msgspec.structs.replace(
        config.limits,
        fence_file=str(path),
        fence_enu_m=DEFAULT_FENCE,
        autopilot_fence="compare" if policy == "use" else policy,
    )
    limits.fence_plan()
    config = msgspec.structs.replace(config, limits=limits)
    if config.search.area_file is not None:
        site = Path(config.search.area_file)
        check_search_area(site, limits.fence_plan().site, config.search.cell_m)
    return config


def with_signing_key(config: CompanionConfig, path: Path) -> CompanionConfig:
    """Return the configuration with another file that holds the signing key."""
    link = msgspec.structs.replace(config.link, signing_key_file=str(path))
    return msgspec.structs.replace(config, link=link)


def with_radios(
    config: CompanionConfig, options: Sequence[str], file: Path | None = None
) -> CompanionConfig:
    """Return the configuration of a file with the radios of `--radio`; see `flown_radios`."""
    radios = flown_radios(config.radios, options, file)
    config = msgspec.structs.replace(config, radios=radios)
    problem = _mounted_twice(config)
    if problem is not None:
        raise ConfigError(problem)
    return config


def _mounted_twice(config: CompanionConfig) -> str | None:
    """Return the problem if both a radio's mount and the antenna's turn its bearings, or None."""
    if config.estimation.filter.antenna.mount_deg[2] == 0.0:
        return None
    turned = [r.name for r in config.radios if r.settings.get("bearing_mount_deg")]
    if not turned:
        return None
    return (
        f"$.estimation.filter.antenna.mount_deg: its yaw and bearing_mount_deg of {turned[0]} both "
        "turn bearings; keep one"
    )


def inconsistency(config: CompanionConfig) -> str | None:
    """Return a contradiction between sections, with its YAML path, or None."""
    limits, mission = config.limits, config.mission
    least_m, most_m = limits.guard_limits().altitude_m
    if not least_m <= mission.altitude_m <= most_m:
        band = f"{least_m:g} to {most_m:g} m, less 3 sigma of the position at each end"
        return f"$.mission.altitude_m: {mission.altitude_m:g} m is outside $.limits ({band})"
    swing_m = config.planner.latched_crossing.altitude_swing_m
    low_m, high_m = mission.altitude_m - swing_m, mission.altitude_m + swing_m
    if not least_m <= low_m <= high_m <= most_m:
        return (
            f"$.planner.latched_crossing.altitude_swing_m: {low_m:g} to {high_m:g} m is not "
            "within $.limits"
        )
    if (twice := _mounted_twice(config)) is not None:
        return twice
    if (problem := _search_problem(config)) is not None:
        return problem
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


def _search_problem(config: CompanionConfig) -> str | None:
    """Return a contradiction between the search and other sections, or None."""
    if config.search.detection is not None and config.detection is None:
        return (
            "$.search.detection.reach_m: configure it; there is no preset of the radio with "
            "$.estimation.filter.reach_m"
        )
    if config.planner.search == "probability" and config.detection is None:
        return "$.planner.search: probability flies by the map of $.search.detection; describe it"
    if config.mission.searches_on and config.emitters.order == "first":
        return "$.mission.continue: set $.emitters.order for several emitters: nearest, for example"
    if config.mission.searches_on and config.planner.search is None:
        return "$.mission.continue: set $.planner.search to the pattern that is flown then"
    if not _has_lanes(config):
        return "$.planner.pattern.area_enu_m: nothing of it is left by $.limits"
    return None


def _has_lanes(config: CompanionConfig) -> bool:
    """Return False if the lawnmower is used and has no lanes."""
    planner, limits = config.planner, config.limits
    if planner.search not in ("lawnmower", "probability") or not limits.is_fence_local:
        return True
    request = PlanRequest(
        limits.fence_enu_m[0],
        None,
        limits.fence_enu_m,
        limits.fence_margin_m,
        keep_out_enu_m=limits.keep_out_enu_m,
    )
    lawnmower = planner.pattern.params("lawnmower")
    return bool(lawnmower.track(request, limits.fence_enu_m[0], 0))
