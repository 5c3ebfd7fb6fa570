"""The composition root of a flight: endpoint, shell, logs, and the periodic tasks around them.

Periodic tasks run after every control tick, and must never end a flight. Flying comes first: a task
that raises is a bug of ours, is announced once and not run again. It is not retried, because an
error at 20 Hz would recur, and its log would fill the disk.
"""

from __future__ import annotations

import gc
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from companion import kernel_cache
from companion.config.schema import CompanionConfig
from companion.config.tunables import Tunables
from companion.diagnostics import (
    HOW_TO_ALLOW,
    NORMAL_PRIORITY,
    STOPPING,
    LinkWatch,
    ProcessDiagnostics,
    ProcessParts,
    Supervisor,
    Watchdog,
    raised_priority,
)
from companion.errors import CompanionError, LinkError
from companion.flight_setup import (
    begin_housekeeping,
    build_endpoint,
    build_planner,
    open_journal,
)
from companion.guidance.commands import Severity
from companion.guidance.events import ProcessMessage
from companion.guidance.phases import IN_CONTROL, Phase
from companion.io.checkpoints import CheckpointStore
from companion.io.flight_recorder import BlackBox, FlightJournal
from companion.io.links.link import NOTICE
from companion.io.links.transports import FlightLink, Transport, make_link
from companion.io.shell import Clock, Shell
from companion.io.state_directory import (
    SigningKeeper,
    VehicleLock,
    load_signing_key,
    lock_name,
    open_signing_keeper,
    resolved_address,
    state_directory,
)
from companion.kernel import IS_COMPILED, IS_NATIVE, IS_SWITCHED_OFF
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from companion.mav.signing import ONE_LINK_EACH
from companion.persistence import ParameterKeeper, RestartKeeper, SearchKeeper

log = logging.getLogger("companion.run")

PeriodicTask = Callable[[float], None]


class PeriodicTasks:
    """Runs tasks in order, by the names that the operator reads if one fails."""

    def __init__(self, endpoint: CompanionEndpoint, tasks: Mapping[str, PeriodicTask]) -> None:
        self._endpoint = endpoint
        self._tasks = dict(tasks)

    def run(self, now_s: float) -> None:
        """Run the tasks that have not failed."""
        for name, task in list(self._tasks.items()):
            try:
                task(now_s)
            except Exception:
                del self._tasks[name]
                log.exception("%s: failed", name)
                text = f"internal error: {name} ended; the flight continues"
                self._endpoint.handle_event(ProcessMessage(now_s, Severity.ERROR, text))


CLOSE_S = 0.25
"""Time for the disk to take the last checkpoint, and again for the last part of the log."""
SEARCHED_S = 2.0
"""Time to write the last state of the searched area."""
SILENCE_HINT_S = 10.0
"""Time without an autopilot after which the operator is shown the address we listen on."""


def open_signing(config: CompanionConfig) -> SigningKeeper | None:
    """Return the keeper of the configured signing key; None without a key."""
    if config.link.signing_key_file is None:
        return None
    path = Path(config.link.signing_key_file)
    return open_signing_keeper(path, load_signing_key(path), ONE_LINK_EACH)


def _open_black_box(open_it: Callable[[], FlightJournal], *, is_restart: bool) -> BlackBox:
    """Return a journal; after a restart in flight the vehicle matters more than its log."""
    try:
        return open_it()
    except CompanionError as error:
        if not is_restart:
            raise
        log.error("%s; resuming a flight, so continuing without a log", error)
        return BlackBox()


def compile_kernels() -> str:
    """Compile the kernels unless done, and say so; `CompanionError`: not compiled, or not kept."""
    if IS_NATIVE:
        return "kernels were compiled ahead: nothing to do"
    if IS_SWITCHED_OFF or not kernel_cache.can_compile():
        return "numba is not installed, or switched off: kernels run as plain Python"
    began_s = time.monotonic()
    with _reported_progress():
        kernel_cache.compile_kernels()
    return f"kernels compiled, in {time.monotonic() - began_s:.0f} s"


@contextmanager
def _announced_priority(clock: Clock) -> Iterator[None]:
    """Raise the priority for a flight at real time; a faster one is flown on a simulator here."""
    if clock.speed != 1.0:
        yield
        return
    with raised_priority() as priority:
        if priority is None:
            log.log(NOTICE, "%s; %s", NORMAL_PRIORITY, HOW_TO_ALLOW)
        else:
            log.info("%s", priority)
        yield


PROGRESS_S = 10.0


@contextmanager
def _reported_progress() -> Iterator[None]:
    """Report every few seconds that kernels are being compiled."""
    is_over = threading.Event()

    def report() -> None:
        seconds = 0.0
        log.info("compiling kernels, which takes half a minute or more")
        while not is_over.wait(PROGRESS_S):
            seconds += PROGRESS_S
            log.info("compiling kernels: %.0f s so far", seconds)

    reporter = threading.Thread(target=report, name="compiling", daemon=True)
    reporter.start()
    try:
        yield
    finally:
        is_over.set()
        reporter.join()


def link_name(link: Transport) -> str:
    """Return the name of a link in messages, locks and checkpoints."""
    return make_link(link, 0, lambda _: None).name


def is_handed_over(endpoint: CompanionEndpoint) -> bool:
    """Return True if the flight is over and the vehicle no longer obeys us.

    Between two control ticks an autopilot that lands may have ended the phase that follows.
    """
    session = endpoint.session
    is_over = session.has_finished or session.phase is Phase.FINISHED
    return is_over and not session.vehicle.is_ours


class FlightView:
    """Shows a flight, and never makes it wait; every method may do nothing."""

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Handle an event."""

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Handle a text for the operator."""

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        """Called after every control tick of the flight."""

    def close(self) -> None:
        """Called at the end of the flight."""


class ViewedJournal:
    """Passes frames and results to the flight log, and events and texts to views as well."""

    def __init__(self, journal: Journal, views: Sequence[FlightView]) -> None:
        self.frame, self.result = journal.frame, journal.result
        self._listeners: tuple[Journal | FlightView, ...] = (journal, *views)

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        """Pass an event on."""
        for listener in self._listeners:
            listener.record(kind, fields, now_s)

    def text(self, severity: Severity, text: str, now_s: float) -> None:
        """Forward a text."""
        for listener in self._listeners:
            listener.text(severity, text, now_s)


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """Options of the begin, the end and the views of a flight."""

    once: bool = False
    """True: the flight ends once the target is reported and the vehicle handed over."""
    is_fresh: bool = False
    """True: nothing of an earlier run is restored."""
    views: Sequence[FlightView] = ()
    """Views of the flight, closed at its end."""
    at_end: Callable[[Path], None] | None = None
    """Called with the flight's directory once everything is written."""


@dataclass(frozen=True, slots=True)
class FlightEnd:
    """The end of a flight."""

    endpoint: CompanionEndpoint
    is_log_whole: bool
    """False: a full or slow disk has cost a part of the log, which was reported."""


def fly(
    config: CompanionConfig, links: Sequence[FlightLink], clock: Clock, options: FlightOptions
) -> FlightEnd:
    """Fly until asked to stop; return the flight's end.

    Raises:
        LinkError: A link cannot be opened, or another companion has the vehicle; nothing was sent.
        ConfigError: The signing key cannot be read.
        CompanionError: The flight directory cannot be created.
    """
    keeper = open_signing(config)
    state = state_directory(config.process.state_directory, os.environ)
    (vehicle,) = (link.transport for link in links if link.spec.role is LinkRole.VEHICLE)
    name = link_name(vehicle)
    lock = VehicleLock(state, name, config.vehicle.system_id, resolved_address(vehicle))
    try:
        if not IS_COMPILED and not IS_SWITCHED_OFF and kernel_cache.can_compile():
            log.info(
                "kernels run as plain Python; companion warm-up compiles them for later starts"
            )
        clock.restart()
        flight = _Flight(config, links, clock, keeper, options, state / lock_name(name))
        with _announced_priority(clock):
            flight.run()
        if options.at_end is not None and flight.directory is not None:
            options.at_end(flight.directory)
    finally:
        if keeper is not None:
            keeper.close()
        lock.release()
        for view in options.views:
            view.close()
    return FlightEnd(flight.endpoint, flight.is_log_whole)


class _Flight:
    """One run of the shell, and the periodic tasks after each of its control ticks.

    `state` is the common prefix of the files kept from run to run.
    """

    def __init__(
        self,
        config: CompanionConfig,
        links: Sequence[FlightLink],
        clock: Clock,
        keeper: SigningKeeper | None,
        options: FlightOptions,
        state: Path,
    ) -> None:
        self._options = options
        self._clock = clock
        self._keeper = keeper
        self._keep_flights = config.log.keep_flights
        max_age_s = config.process.resume_max_age_s
        self._store = None if max_age_s is None else CheckpointStore(state.parent, state.name)
        tunables = Tunables(config, build_planner)
        self._parameters = ParameterKeeper(
            tunables, state.with_name(f"{state.name}.parameters.json")
        )
        found = None if self._store is None or options.is_fresh else self._store.load()
        specs = [link.spec for link in links]
        self._journal = _open_black_box(
            lambda: open_journal(config, specs, tunables.changed, time.time() - clock.now_s()),
            is_restart=found is not None and found.has_files,
        )
        self.endpoint = self._build_endpoint(tunables, specs)
        self._restart = None
        if self._store is not None and max_age_s is not None:
            self._restart = RestartKeeper(
                self.endpoint, self._store, config, clock, max_age_s, is_fresh=options.is_fresh
            )
        transports = [link.transport for link in links]
        authority = self.endpoint.session.authority
        self._shell = Shell(
            self.endpoint,
            transports,
            clock,
            self._after_wakeup,
            may_gather=lambda: authority.phase in IN_CONTROL,
        )
        for link, flown in zip(self._shell.links, links, strict=True):
            link.expects_mavlink = flown.spec.role is not LinkRole.RANGING
        self._vehicle_link = self._shell.links[
            next(n for n, spec in enumerate(specs) if spec.role is LinkRole.VEHICLE)
        ]
        self._watch = LinkWatch(self._shell.links, self._journal)
        self._supervisor = Supervisor(os.environ)
        self._searched: SearchKeeper | None = None
        if isinstance(self._journal, FlightJournal):
            self._searched = SearchKeeper(self.endpoint.session, self._journal)
        self._tasks = self._gather_tasks()
        self._hints = 0
        self._ticks = 0

    def _build_endpoint(self, tunables: Tunables, links: Sequence[LinkSpec]) -> CompanionEndpoint:
        return build_endpoint(
            tunables.file,
            ViewedJournal(self._journal, self._options.views),
            links,
            tunables=tunables,
            signing=None if self._keeper is None else self._keeper.signing,
            started_unix_s=time.time() - self._clock.now_s(),
            recorder=self._journal.inputs,
        )

    def _gather_tasks(self) -> PeriodicTasks:
        parts = ProcessParts(self._journal, self._shell.timing, self._shell.links, self._store)
        watchdog = Watchdog(self._supervisor, self.endpoint, parts)
        diagnostics = ProcessDiagnostics(self.endpoint, parts, self._clock.speed)
        tasks: dict[str, PeriodicTask] = {
            f"view {number}": partial(view.update, self.endpoint)
            for number, view in enumerate(self._options.views, start=1)
        }
        tasks["parameters"] = self._parameters.run
        tasks["accounts"] = diagnostics.run
        tasks["watchdog"] = lambda now_s: watchdog.run(now_s, time.monotonic())
        if self._restart is not None:
            tasks["checkpoints"] = self._restart.run
        if self._searched is not None:
            tasks["searched area"] = self._searched.run
        return PeriodicTasks(self.endpoint, tasks)

    @property
    def directory(self) -> Path | None:
        """Folder of the flight's files; None without a log."""
        return self._journal.directory if isinstance(self._journal, FlightJournal) else None

    @property
    def is_log_whole(self) -> bool:
        """True if nothing of the log was lost."""
        return self._journal.is_whole

    def run(self) -> None:
        """Run to the end, however it ends, and leave everything closed."""
        gc.freeze()  # objects so far stay: later collections need not scan them
        try:
            self._shell.run_blocking()
        except LinkError:
            self._journal.discard()
            raise
        finally:
            self._supervisor.notify(STOPPING)
            if self._restart is not None:
                self._restart.close(CLOSE_S)
            self._parameters.close(CLOSE_S)
            if self._searched is not None:
                self._searched.close(SEARCHED_S)
            self._journal.close(CLOSE_S)
            self._supervisor.close()

    def _after_wakeup(self, now_s: float) -> None:
        if self.endpoint.ticks == self._ticks:
            return
        self._ticks = self.endpoint.ticks
        self._hint()
        self._watch.check(now_s)
        self._vehicle_link.hear_only(self.endpoint.shield.sole_peer(now_s))
        if self._keeper is not None:
            self._keeper.keep(now_s)
            if self._clock.speed == 1.0 and not self.endpoint.binding.is_bound:
                self.endpoint.authenticity.set_clock(time.time(), now_s)
        self._tasks.run(now_s)
        if self._options.once and is_handed_over(self.endpoint):
            self._shell.request_stop()

    def _hint(self) -> None:
        """Log the address we listen on, once the links are open; warn if nothing is heard."""
        name = self._vehicle_link.name
        if self._hints == 0:
            self._hints = 1
            if self.directory is not None:
                begin_housekeeping(self.directory, self._keep_flights)
            log.info("waiting for an autopilot on %s", name)
        if self._hints == 1 and self._clock.now_s() >= SILENCE_HINT_S:
            self._hints = 2
            if not self.endpoint.binding.is_bound:
                if self._vehicle_link.counters.received and not self.endpoint.good_frames:
                    text = "%s: bytes arrive, but no MAVLink; check the speed (baud) of the port"
                else:
                    text = "no autopilot heard on %s yet: check that it sends there, and the port"
                log.warning(text, name)
