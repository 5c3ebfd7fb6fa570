"""The composition root: configuration to filter, planner, guard, session, endpoint and shell."""

from __future__ import annotations

import gc
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from companion.config.schema import CompanionConfig, CrossingKind, PatternKind, PlannerConfig
from companion.errors import CompanionError, LinkError
from companion.flight_facts import FlightFacts, facts_as_json, write_facts
from companion.guard.gate import Guard
from companion.guidance.emitters import EmitterQueue
from companion.guidance.session import GuidanceSession
from companion.guidance.states import Phase
from companion.io.checkpoint_store import CheckpointStore
from companion.io.clock import Clock
from companion.io.files import delete_old_flights, new_flight_directory
from companion.io.flight_files import MCAP
from companion.io.journal import BlackBox, FlightJournal, MissingJournal
from companion.io.key_file import load_signing_key
from companion.io.link_watch import LinkWatch
from companion.io.links import LinkSpec, make_link
from companion.io.lock import VehicleLock, lock_name
from companion.io.mcap_log import McapLog
from companion.io.shell import Shell
from companion.io.signing_store import SigningKeeper, open_signing_keeper
from companion.io.state_directory import state_directory
from companion.io.supervisor import Supervisor
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
from companion.process.accounts import Accounts
from companion.process.chores import Chores
from companion.process.restart import RestartKeeper, digests_of
from companion.process.watchdog import Watchdog
from companion.warm_up import warm_up

log = logging.getLogger("companion.run")

CLOSE_S = 0.25
"""What the disk may take for the last checkpoint, and again for the last of the log."""
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
    log.info("flight log: %s", directory)
    return FlightJournal(directory, started_unix_s, config.log.max_bytes, mcap)


def _open_black_box(config: CompanionConfig, links: int, *, is_restart: bool) -> BlackBox:
    """A journal; after a restart in flight the vehicle matters more than its log.

    Raises:
        CompanionError: The flight directory cannot be made, and nothing flies yet.
    """
    try:
        return open_journal(config, links)
    except CompanionError as error:
        if not is_restart:
            raise
        log.error("%s; resuming a flight, so going on without any log", error)
        return MissingJournal()


def prepare(config: CompanionConfig) -> None:
    """Compile what a flight needs, before its clock starts; nothing to do without numba."""
    if IS_COMPILED:
        log.info("compiling kernels: half a minute the first time")
    warm_up(config.estimation, build_planner(config))


def link_name(link: LinkSpec) -> str:
    """What a link is called in messages, locks and checkpoints."""
    return make_link(link, 0, lambda _: None).name


def is_handed_over(endpoint: CompanionEndpoint) -> bool:
    """Whether the target is reported and the vehicle no longer obeys us."""
    session = endpoint.session
    return session.phase is Phase.FINISHED and not session.vehicle.is_ours


def fly(
    config: CompanionConfig,
    links: Sequence[LinkSpec],
    clock: Clock,
    *,
    once: bool = False,
    is_fresh: bool = False,
    views: Sequence[FlightView] = (),
    at_end: Callable[[Path], None] | None = None,
) -> CompanionEndpoint:
    """Fly until asked to stop; the endpoint as it was at the end.

    Args:
        config: The configuration.
        links: The vehicle's link, then those that carry only ranging.
        clock: Where the time comes from.
        once: End by itself once the target is reported and the vehicle handed over.
        is_fresh: Take up nothing of an earlier run.
        views: Watch the flight; closed at its end.
        at_end: Gets the flight's directory once everything is written.

    Raises:
        LinkError: A link cannot be opened, or another companion has the vehicle; nothing was sent.
        ConfigError: The signing key cannot be read.
        CompanionError: The flight directory cannot be made.
    """
    keeper = open_signing(config)
    state = state_directory(config.process.state_directory, os.environ)
    name = link_name(links[0])
    lock = VehicleLock(state, name, config.vehicle.system_id)
    try:
        prepare(config)
        store = CheckpointStore(state, lock_name(name)) if config.process.checkpoint else None
        flight = _Flight(config, links, clock, keeper, store, views, once=once, is_fresh=is_fresh)
        flight.run()
        if at_end is not None and flight.directory is not None:
            at_end(flight.directory)
    finally:
        if keeper is not None:
            keeper.close()
        lock.release()
        for view in views:
            view.close()
    return flight.endpoint


class FlightView(Protocol):
    """Shows a flight to somebody, and never makes it wait."""

    def listen(self, journal: Journal) -> Journal:
        """A journal that passes everything on, and lets the view know."""

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Called at every wake-up of the flight."""

    def close(self) -> None:
        """The flight is over."""


class _Flight:
    """One run of the shell, and the chores at the end of each of its wake-ups."""

    def __init__(
        self,
        config: CompanionConfig,
        links: Sequence[LinkSpec],
        clock: Clock,
        keeper: SigningKeeper | None,
        store: CheckpointStore | None,
        views: Sequence[FlightView],
        *,
        once: bool,
        is_fresh: bool,
    ) -> None:
        found = None if store is None or is_fresh else store.load()
        is_restart = found is not None and found.has_files
        self._journal = _open_black_box(config, len(links), is_restart=is_restart)
        listens: Journal = self._journal
        for view in views:
            listens = view.listen(listens)
        self.endpoint = build_endpoint(
            config,
            listens,
            len(links) - 1,
            signing=None if keeper is None else keeper.signing,
            started_unix_s=time.time() - clock.now_s(),
            recorder=self._journal.inputs,
        )
        self._clock = clock
        self._keeper = keeper
        self._once = once
        self._restart = None
        if store is not None:
            self._restart = RestartKeeper(
                self.endpoint,
                store,
                digests_of(config),
                clock,
                config.process.resume_max_age_s,
                is_fresh=is_fresh,
            )
        self._shell = Shell(self.endpoint, links, clock, self._after_wakeup)
        self._watch = LinkWatch(self._shell.links, self._journal)
        self._supervisor = Supervisor(os.environ)
        parts = (self._journal, self._shell.timing, self._shell.links, store)
        watchdog = Watchdog(self._supervisor, self.endpoint, *parts)
        accounts = Accounts(self.endpoint, *parts, clock.speed)
        self._chores = Chores(
            self.endpoint,
            {
                **{
                    f"view {number}": partial(view.update, self.endpoint)
                    for number, view in enumerate(views, start=1)
                },
                "accounts": accounts.run,
                "watchdog": lambda now_s: watchdog.run(now_s, time.monotonic()),
                **({} if self._restart is None else {"checkpoints": self._restart.run}),
            },
        )
        self._hints = _Hints(self.endpoint, clock, self._shell.links[0].name)

    @property
    def directory(self) -> Path | None:
        """Where the flight's files are; None without a log."""
        return self._journal.directory if isinstance(self._journal, FlightJournal) else None

    def run(self) -> None:
        """Run to the end, whatever it is, and leave everything closed."""
        gc.freeze()  # what was loaded so far stays: later collections need not look at it
        try:
            self._shell.run_blocking()
        except LinkError:
            self._journal.discard()
            raise
        finally:
            self._supervisor.stopping()
            if self._restart is not None:
                self._restart.close(CLOSE_S)
            self._journal.close(CLOSE_S)
            self._supervisor.close()

    def _after_wakeup(self, now_s: float) -> None:
        self._hints.check()
        self._watch.check(now_s)
        self._shell.links[0].hear_only(self.endpoint.sole_peer(now_s))
        if self._keeper is not None:
            self._keeper.keep(now_s)
            if self._clock.speed == 1.0 and not self.endpoint.binding.is_bound:
                self.endpoint.authenticity.set_clock(time.time(), now_s)
        self._chores.run(now_s)
        if self._once and is_handed_over(self.endpoint):
            self._shell.request_stop()


class _Hints:
    """What whoever started us wants to read: where we wait, and that nothing was heard there."""

    def __init__(self, endpoint: CompanionEndpoint, clock: Clock, link_name: str) -> None:
        self._link_name = link_name
        self._endpoint = endpoint
        self._clock = clock
        self._has_begun = False
        self._has_warned = False

    def check(self) -> None:
        """Say what is due now; the first time is when the links are open."""
        if not self._has_begun:
            self._has_begun = True
            log.info("waiting for an autopilot on %s", self._link_name)
        if self._has_warned or self._clock.now_s() < SILENCE_HINT_S:
            return
        self._has_warned = True
        if not self._endpoint.binding.is_bound:
            log.warning(
                "no autopilot heard on %s yet: does it send there, and is the port the right one?",
                self._link_name,
            )
