"""The composition root: configuration to filter, planner, guard, session, endpoint and shell."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.config.schema import CompanionConfig, CrossingKind, PatternKind, PlannerConfig
from companion.errors import LinkError
from companion.estimation.tracker import TargetTracker
from companion.flight_facts import FlightFacts, facts_as_json, write_facts
from companion.guard.gate import Guard
from companion.guidance.session import GuidanceSession
from companion.guidance.states import Phase
from companion.io.clock import Clock
from companion.io.files import delete_old_flights, new_flight_directory
from companion.io.flight_files import MCAP
from companion.io.journal import FlightJournal
from companion.io.key_file import load_signing_key
from companion.io.links import LinkSpec
from companion.io.mcap_log import McapLog
from companion.io.shell import Shell
from companion.io.signing_store import SigningKeeper, open_signing_keeper
from companion.kernel import IS_COMPILED
from companion.link.endpoint import CompanionEndpoint, Journal
from companion.link.inputs import InputRecorder
from companion.mav.signing import ONE_LINK_EACH, Signing
from companion.planning.base import Planner
from companion.planning.fim import FimPlanner
from companion.planning.latched_crossing import LatchedCrossing
from companion.planning.patterns import ExpandingSquare, Lawnmower, SectorSearch
from companion.planning.reactive_crossing import ReactiveCrossing
from companion.planning.search import Pattern, SearchPlanner
from companion.planning.search_then_cross import SearchThenCross
from companion.warm_up import warm_up

log = logging.getLogger("companion.run")

SILENCE_HINT_S = 10.0
"""After this long without an autopilot the operator is told where we listen."""


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
        TargetTracker(config.estimation, config.emitter_id),
        build_planner(config),
        Guard(config.limits.guard_limits()),
        needs_origin=config.vehicle.setpoint == "global_int",
    )


def build_endpoint(
    config: CompanionConfig,
    journal: Journal,
    ranging_links: int = 0,
    *,
    signing: Signing | None = None,
    started_unix_s: float = 0.0,
    recorder: InputRecorder | None = None,
) -> CompanionEndpoint:
    """The companion as a MAVLink participant.

    Args:
        config: The configuration.
        journal: Where it reports.
        ranging_links: Links beside the vehicle's that carry only ranging.
        signing: Proves what arrives and signs what leaves; None: neither.
        started_unix_s: Unix time at the clock's zero, for the timestamps of signatures.
        recorder: Keeps what the endpoint is told.
    """
    return CompanionEndpoint(
        build_session(config),
        config.vehicle,
        journal,
        1 + ranging_links,
        config.link,
        signing=signing,
        started_unix_s=started_unix_s,
        recorder=recorder,
    )


def open_signing(config: CompanionConfig) -> SigningKeeper | None:
    """Signing with the configured key, and its memory; None without a key.

    Raises:
        ConfigError: The key, or what signing remembers, cannot be read.
        CompanionError: What it must remember cannot be written.
    """
    if config.link.signing_key_file is None:
        return None
    path = Path(config.link.signing_key_file)
    return open_signing_keeper(path, load_signing_key(path), ONE_LINK_EACH)


def open_journal(config: CompanionConfig, links: int) -> FlightJournal:
    """The black box of a new flight.

    Args:
        config: The configuration.
        links: The vehicle's and those that carry only ranging.

    Raises:
        CompanionError: The flight directory cannot be made.
    """
    started_unix_s = time.time()
    root = Path(config.log.directory)
    directory = new_flight_directory(root, started_unix_s)
    if config.log.keep_flights is not None:
        deleted = delete_old_flights(root, config.log.keep_flights)
        if deleted:
            log.info("log.keep_flights: deleted %d older flights", len(deleted))
    facts = FlightFacts(started_unix_s=started_unix_s, links=links, config=config)
    write_facts(directory, facts)
    mcap = None
    if config.log.mcap:
        flight_json = facts_as_json(facts).decode()
        mcap = McapLog(directory / MCAP, started_unix_s, flight_json, config.log.max_bytes)
    return FlightJournal(directory, started_unix_s, config.log.max_bytes, mcap)


def prepare(config: CompanionConfig) -> None:
    """Compile what a flight needs, before its clock starts; nothing to do without numba."""
    if IS_COMPILED:
        log.info("compiling kernels: half a minute the first time")
    warm_up(config.estimation, build_planner(config))


def is_handed_over(endpoint: CompanionEndpoint) -> bool:
    """Whether the target is reported and the vehicle no longer obeys us."""
    session = endpoint.session
    return session.phase is Phase.FINISHED and not session.vehicle.is_ours


def fly(
    config: CompanionConfig, links: Sequence[LinkSpec], clock: Clock, *, once: bool = False
) -> CompanionEndpoint:
    """Fly until asked to stop; the endpoint as it was at the end.

    Args:
        config: The configuration.
        links: The vehicle's link, then those that carry only ranging.
        clock: Where the time comes from.
        once: End by itself once the target is reported and the vehicle handed over.

    Raises:
        LinkError: A link cannot be opened; nothing was sent.
        ConfigError: The signing key cannot be read.
        CompanionError: The flight directory cannot be made.
    """
    keeper = open_signing(config)
    prepare(config)
    journal = open_journal(config, len(links))
    endpoint = build_endpoint(
        config,
        journal,
        len(links) - 1,
        signing=None if keeper is None else keeper.signing,
        started_unix_s=time.time() - clock.now_s(),
        recorder=journal.inputs,
    )
    hints = _Hints(endpoint, clock, journal.directory)

    def on_wakeup(now_s: float) -> None:
        hints.check()
        if keeper is not None:
            keeper.keep(now_s)
            if clock.speed == 1.0 and not endpoint.binding.is_bound:
                endpoint.authenticity.set_clock(time.time(), now_s)
        if once and is_handed_over(endpoint):
            shell.request_stop()

    shell = Shell(endpoint, links, clock, on_wakeup)
    hints.link_name = shell.links[0].name
    try:
        shell.run_blocking()
    except LinkError:
        journal.discard()
        raise
    finally:
        if keeper is not None:
            keeper.close()
        journal.close()
    return endpoint


class _Hints:
    """What whoever started us wants to read: where we wait, and that nothing was heard there."""

    def __init__(self, endpoint: CompanionEndpoint, clock: Clock, directory: Path) -> None:
        self.link_name = ""
        self._endpoint = endpoint
        self._clock = clock
        self._directory = directory
        self._has_begun = False
        self._has_warned = False

    def check(self) -> None:
        """Say what is due now; the first time is when the links are open."""
        if not self._has_begun:
            self._has_begun = True
            log.info("flight log: %s", self._directory)
            log.info("waiting for an autopilot on %s", self.link_name)
        if self._has_warned or self._clock.now_s() < SILENCE_HINT_S:
            return
        self._has_warned = True
        if not self._endpoint.binding.is_bound:
            log.warning(
                "no autopilot heard on %s yet: does it send there, and is the port the right one?",
                self.link_name,
            )
