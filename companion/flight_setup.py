"""Builders of planner, session, endpoint, journal and `flight.json` from a configuration.

`flight.json` describes the setup of a flight, for its replay and its report.
"""

from __future__ import annotations

import logging
import math
import os
import platform
import shutil
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from companion import __version__
from companion.config.radios import RadioConfig, radio_setups
from companion.config.schema import CompanionConfig
from companion.config.search_files import read_search_site
from companion.config.tunables import Tunables
from companion.config.versions import renew
from companion.errors import CompanionError, ConfigError, decoding_problem
from companion.estimation.antenna import (
    ABOUT_VERTICAL,
    AntennaKind,
    AntennaParams,
    antenna_axes_enu,
)
from companion.guard.gate import Guard
from companion.guidance.emitters import EmitterQueue
from companion.guidance.searching import Searching
from companion.guidance.session import GuidanceSession
from companion.io.checkpoints import kept_offsets, radio_key
from companion.io.files import FLIGHT, MCAP, read_bytes, write_bytes_atomic
from companion.io.flight_recorder import FlightJournal, delete_old_flights, new_flight_directory
from companion.io.links.transports import FlightLink, parse_flight_link, radio_link
from companion.io.mcap_file import McapLog
from companion.io.state_directory import state_directory
from companion.kernel import IS_COMPILED
from companion.link.endpoint import CompanionEndpoint
from companion.link.intake import Authenticity
from companion.link.interface import (
    VEHICLE_ONLY,
    EndpointParams,
    InputRecorder,
    Journal,
    LinkRole,
    LinkSpec,
)
from companion.mav.signing import Signing
from companion.planning.crossing import LatchedCrossing, SensorGeometry
from companion.planning.fim import FimParams, FimPlanner
from companion.planning.planner import Planner
from companion.planning.search import SearchPlanner, SearchThenCross
from companion.planning.search_probability import ProbabilityPlanner
from companion.planning.views import Antenna
from companion.search.outlook import LegTable

log = logging.getLogger("companion.run")
ROWS: dict[AntennaKind, int] = {"auto": 0, "azimuth": 0, "planar": 1, "line": 1, "two_axis": 2}
"""Number of direction rows for the choice of crossings; 0: as in the paper."""


def build_planner(config: CompanionConfig) -> Planner[Any]:
    """Return the configured planner."""
    planner = config.planner
    if planner.search is None:
        return _crossing(config)
    pattern = planner.pattern.params(planner.search)
    detection = config.detection
    search = SearchPlanner(pattern)
    if planner.search == "probability" and detection is not None:
        table = LegTable(detection, config.mission.altitude_m, config.limits.speed_mps)
        search = ProbabilityPlanner(pattern, table)
    if planner.kind == "survey":
        return search
    return SearchThenCross(search, _crossing(config), planner.lost_after_s)


def _crossing(config: CompanionConfig) -> Planner[Any]:
    planner, noise = config.planner, config.estimation.filter
    match planner.kind:
        case "fim":
            bearing_sigma_rad = math.radians(noise.bearing_sigma_deg)
            is_array = noise.antenna.kind not in ABOUT_VERTICAL
            antenna = _antenna(noise.antenna) if is_array else None
            return FimPlanner(FimParams(), noise.range_sigma_m, bearing_sigma_rad, antenna)
        case _:
            return LatchedCrossing(planner.latched_crossing, _sensor_geometry(config))


def _sensor_geometry(config: CompanionConfig) -> SensorGeometry:
    """Return the sensor geometry for the choice of crossings."""
    limits, noise = config.limits, config.estimation.filter
    lowest_m = limits.guard_limits().altitude_m[0]
    return SensorGeometry(
        _antenna(noise.antenna),
        limits.speed_mps,
        limits.acceleration_mps2,
        lowest_m,
        config.mission.altitude_m - lowest_m,
        is_height_configured=noise.target_height_m != 0.0 or noise.target_height_sigma_m > 0.0,
    )


def _antenna(params: AntennaParams) -> Antenna:
    """Return the antenna in axes of the level body: forward, left, up; the nose is east."""
    is_planar = params.kind == "planar"
    ahead, right, down = antenna_axes_enu((0.0, 0.0, 0.5 * math.pi), params.mount_deg)
    return Antenna(
        ahead,
        ahead if is_planar else right,
        right if is_planar else down,  # the sign of a cosine does not change its information
        ROWS[params.kind],
        is_planar,
        math.radians(0.5 * params.field_of_view_deg),
    )


def build_session(config: CompanionConfig) -> GuidanceSession:
    """Return the guidance of one flight."""
    path = config.search.area_file
    return GuidanceSession(
        config.mission,
        EmitterQueue(config.tracking, config.emitters, searches_on=config.mission.searches_on),
        build_planner(config),
        Guard(config.limits.guard_limits()),
        needs_origin=config.vehicle.setpoint == "global_int",
        fence_plan=config.limits.fence_plan(),
        searching=Searching(
            config.search,
            config.detection,
            None if path is None else read_search_site(Path(path)),
            is_planned=config.planner.search == "probability",
        ),
    )


def radio_links(radios: Sequence[RadioConfig]) -> list[FlightLink]:
    """Return the links of radios that have their addresses, in order."""
    setups = radio_setups(radios)
    return [radio_link(s, radio.url or "") for s, radio in zip(setups, radios, strict=True)]


def flight_links(
    connect: str, ranging: Sequence[str], radios: Sequence[RadioConfig], gcs: Sequence[str] = ()
) -> list[FlightLink]:
    """Return the links: vehicle, ranging, radios, stations; `ConfigError`: bad, or two the same."""
    mavlink = [("--connect", connect, LinkRole.VEHICLE)]
    mavlink += [("--ranging", text, LinkRole.RANGING) for text in ranging]
    given = [(f"{option} {text}", parse_flight_link(text, role)) for option, text, role in mavlink]
    given += [(f"--radio {link.transport}", link) for link in radio_links(radios)]
    given += [(f"--gcs {text}", parse_flight_link(text, LinkRole.GCS)) for text in gcs]
    links: dict[str, FlightLink] = {}
    for words, link in given:
        if str(link.transport) in links:
            raise ConfigError(f"{words}: this link is given twice; one of them is enough")
        links[str(link.transport)] = link
    return list(links.values())


def build_endpoint(
    config: CompanionConfig,
    journal: Journal,
    links: Sequence[LinkSpec] = VEHICLE_ONLY,
    *,
    tunables: Tunables | None = None,
    signing: Signing | None = None,
    started_unix_s: float = 0.0,
    recorder: InputRecorder | None = None,
) -> CompanionEndpoint:
    """Return the companion's MAVLink endpoint.

    Without `tunables` its parameters are as configured; without `signing` frames are neither
    checked nor signed. `started_unix_s` is the time at the clock's zero, for the timestamps of
    signatures.
    """
    tunables = tunables or Tunables(config, build_planner)
    return CompanionEndpoint(
        build_session(tunables.config),
        EndpointParams(config.vehicle, config.link, tuple(links)),
        journal,
        tunables=tunables,
        authenticity=Authenticity(signing, started_unix_s),
        recorder=recorder,
    )


MAX_LINKS = 256
"""The number of a link is a byte in `flight.inputs`."""


LAST_UNIX_S = 253_402_300_799.0
"""The end of the year 9999, beyond which Python has no dates."""


class FlightFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Setup of a flight, for its replay and its report."""

    started_unix_s: Annotated[float, msgspec.Meta(ge=0.0, le=LAST_UNIX_S)]
    links: Annotated[int, msgspec.Meta(ge=1, le=MAX_LINKS)]
    """The vehicle's, those that carry only ranging, radios, and ground stations'; in this order."""
    gcs_links: Annotated[int, msgspec.Meta(ge=0, le=MAX_LINKS)] = 0
    """Number of links to ground stations."""
    config: CompanionConfig
    """Configuration as read from its file, with the radios of the command line."""
    parameters: dict[str, float] = {}
    """Parameters changed by a ground station before the flight, by name."""
    version: str = __version__
    python: str = platform.python_version()
    numpy: str = np.__version__
    is_compiled: bool = IS_COMPILED
    """True if the kernels were compiled: they may differ from plain ones in the last digits."""

    def link_specs(self, radios: Sequence[RadioConfig] | None = None) -> tuple[LinkSpec, ...]:
        """Return the role of each link; for other `radios` than in the flight, as many of them."""
        setups = radio_setups(self.config.radios if radios is None else radios)
        ranging = self.links - 1 - len(setups) - self.gcs_links
        return (
            *VEHICLE_ONLY,
            *[LinkSpec(LinkRole.RANGING)] * ranging,
            *(LinkSpec(LinkRole.RANGING, setup) for setup in setups),
            *[LinkSpec(LinkRole.GCS)] * self.gcs_links,
        )


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """A recorded flight on disk."""

    directory: Path
    facts: FlightFacts

    def path(self, name: str) -> Path:
        """Return the path of one of its files."""
        return self.directory / name


def write_facts(directory: Path, facts: FlightFacts) -> None:
    """Write `flight.json` into a new flight's directory, see `write_bytes_atomic`."""
    write_bytes_atomic(directory / FLIGHT, facts_as_json(facts))


def facts_as_json(facts: FlightFacts) -> bytes:
    """Return the content of `flight.json`; raise `ConfigError` for a path that is not text."""
    try:
        return msgspec.json.format(msgspec.json.encode(facts), indent=2) + b"\n"
    except UnicodeEncodeError as error:
        raise ConfigError(f"{error.object}: this name is not UTF-8; rename it") from None


def open_journal(
    config: CompanionConfig,
    links: Sequence[LinkSpec],
    parameters: Mapping[str, float],
    started_unix_s: float,
) -> FlightJournal:
    """Return the journal of a new flight, with earlier changes of a ground station.

    All its times are `started_unix_s` plus the flight's own: it is the wall clock at the flight's
    zero, however the clock is set later.
    """
    facts = FlightFacts(
        started_unix_s=started_unix_s,
        links=len(links),
        gcs_links=sum(link.role is LinkRole.GCS for link in links),
        config=config,
        parameters=dict(parameters),
    )
    flight_json = facts_as_json(facts)
    max_bytes = config.log.max_bytes
    directory = new_flight_directory(Path(config.log.directory), started_unix_s)
    mcap = None
    try:
        write_bytes_atomic(directory / FLIGHT, flight_json)
        if config.log.mcap:
            mcap = McapLog(directory / MCAP, started_unix_s, flight_json.decode(), max_bytes)
        journal = FlightJournal(directory, started_unix_s, max_bytes, mcap)
    except CompanionError:
        shutil.rmtree(directory, ignore_errors=True)
        raise
    log.info("flight log: %s", directory)
    return journal


def begin_housekeeping(directory: Path, keep: int | None) -> None:
    """Delete all but the newest `keep` flights on a thread, once the one in `directory` flies."""

    def delete() -> None:
        """Delete them, however long the disk takes."""
        if keep is not None and (deleted := delete_old_flights(directory.parent, keep, directory)):
            log.info("log.keep_flights: deleted %d older flights", len(deleted))

    threading.Thread(target=delete, name="delete older flights").start()


def open_flight(path: Path) -> RecordedFlight:
    """Return a flight, by its directory or any file in it; a `ConfigError` names a missing file."""
    directory = path if path.is_dir() else path.parent
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file or folder")
    facts_path = directory / FLIGHT
    try:
        data = read_bytes(facts_path)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: belongs to no flight, there is no {facts_path}; give a flight's folder, as "
            "in flights/2026-11-21T02-50-00Z, and a walk as .csv"
        ) from error
    except OSError as error:
        raise ConfigError(f"{facts_path}: cannot be read ({error.strerror})") from error
    try:
        return RecordedFlight(directory, facts_of_json(data))
    except ConfigError as error:
        raise ConfigError(f"{facts_path}: {error}") from error


def facts_of_json(data: bytes) -> FlightFacts:
    """Return the facts in `flight.json`; raise `ConfigError` for others, and for other versions."""
    try:
        raw = msgspec.json.decode(data)
        if isinstance(raw, dict) and isinstance(raw.get("config"), dict):
            renew(raw["config"], "config")
        return msgspec.convert(raw, FlightFacts, str_keys=False)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"not the facts of a flight: {decoding_problem(error)}") from error


def with_kept_offsets(config: CompanionConfig) -> CompanionConfig:
    """Return the configuration with the kept range offsets of its radios, where none is configured.

    `companion radio calibrate --beside` keeps them, for the single radio.
    """
    if not config.radios:
        return config
    offsets = kept_offsets(state_directory(config.process.state_directory, os.environ))
    radios = []
    for radio in config.radios:
        kept = offsets.get(radio_key(radio.name, radio.url or "")) if offsets else None
        if kept is not None and not radio.has_range_offset:
            settings = {**radio.settings, "range_offset_m": kept.range_offset_m}
            radio = msgspec.structs.replace(radio, settings=settings)
        radios.append(radio)
    return msgspec.structs.replace(config, radios=tuple(radios))
