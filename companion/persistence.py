"""Memory that outlives the process: the mission's, changed parameters, and the searched area.

Theory of operation. Files of an earlier run that did not end in order, readable or not, mean that
a vehicle may be in the air: then nothing engages by itself, whatever the configuration says. A
valid checkpoint is given to the session when the autopilot is heard (and has reported its fence, if
that is the one to keep), and only if vehicle, limits, fence, mission and age match; otherwise the
flight starts without it, with a line that says why. In the air another fence of the autopilot is
not a mismatch, and its fences of the flight are restored even for another mission, as the guard's
fence is widened on the ground only. An orderly end deletes the files, unless the vehicle was left
armed in mid-mission.

Parameters that a ground station changed are kept next to them, and are restored at the next start
if the configuration's rules allow it.

A flight that is killed leaves what it had searched half a minute before; these files are made on a
thread of their own.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import msgspec

from companion.area_handoff import area_files, result_fields
from companion.config.schema import CompanionConfig
from companion.config.tunables import Tunables
from companion.errors import CompanionError, decoding_problem
from companion.guidance.commands import Severity
from companion.guidance.emitters import Progress
from companion.guidance.events import MemoryRecalled, ProcessMessage, UncleanExitFound
from companion.guidance.fencing import FencePolicy
from companion.guidance.session import GuidanceSession
from companion.io.checkpoints import (
    Checkpoint,
    MissionKey,
    Moment,
    StoredCheckpoints,
    age_s,
    present_moment,
)
from companion.io.files import (
    CLOSE_TIMEOUT_S,
    BackgroundReplacer,
    WriterThread,
    open_file,
    write_bytes_atomic,
)
from companion.io.flight_recorder import FlightJournal
from companion.link.endpoint import CompanionEndpoint
from companion.search.searched_area import SearchState
from companion.search.searched_flight import SearchedFlight, combined_area, statement

log = logging.getLogger("companion.run")

SAVE_PERIOD_S = 1.0


class CheckpointStorage(Protocol):
    """Storage of checkpoints."""

    def load(self) -> StoredCheckpoints:
        """Return the newest valid checkpoint; never raises."""

    def save(self, checkpoint: Checkpoint) -> None:
        """Save a checkpoint soon; never waits and never raises."""

    def discard(self) -> None:
        """Delete all checkpoints after a normal end of the mission."""

    def close(self, timeout_s: float) -> None:
        """Write everything queued within `timeout_s`."""


class SessionClock(Protocol):
    """Clock of a shell."""

    speed: float

    def now_s(self) -> float:
        """Return the current time."""


class RestartKeeper:
    """Saves the memory of one flight, and restores that of the previous one unless it is too old.

    With `is_fresh` the operator asks to ignore a stored mission.
    """

    def __init__(
        self,
        endpoint: CompanionEndpoint,
        store: CheckpointStorage,
        config: CompanionConfig,
        clock: SessionClock,
        max_age_s: float,
        *,
        is_fresh: bool = False,
        moment: Callable[[], Moment] = present_moment,
    ) -> None:
        self._endpoint = endpoint
        self._store = store
        self._limits = _digest(config.limits)
        self._mission = _digest(
            (config.mission, config.emitters, config.estimation, config.planner)
        )
        self._clock = clock
        self._moment = moment
        self._pending: Checkpoint | None = None
        self._age_s = 0.0
        """Age of the pending memory at the start of this process."""
        self._began_s = clock.now_s()
        self._sequence = 0
        self._next_s = 0.0
        self.is_restart = False
        """True if an earlier run did not end in order."""
        if is_fresh:
            store.discard()
        else:
            self._look_back(max_age_s)

    def run(self, now_s: float) -> None:
        """Restore and save the state when due."""
        binding = self._endpoint.binding
        if not binding.is_bound:
            return
        if not self._endpoint.session.fencing.is_site_known:
            return
        if self._pending is not None:
            self._recall(self._pending, now_s)
            self._pending = None
        wall_s = now_s / self._clock.speed
        if wall_s >= self._next_s and not self._endpoint.session.is_recalling:
            self._next_s = wall_s + SAVE_PERIOD_S
            self._save(now_s)

    def close(self, timeout_s: float) -> None:
        """Save the memory of a mission that continues without the companion, else delete it."""
        session = self._endpoint.session
        is_over = session.has_found_all or session.is_search_over
        is_over = is_over or not session.vehicle.is_armed
        is_known = self._endpoint.is_finished and self._endpoint.binding.is_bound
        if is_known and not is_over and self._pending is None:
            self._save(self._clock.now_s())
        if is_known and is_over:
            self._store.discard()
        self._store.close(timeout_s)

    def _look_back(self, max_age_s: float) -> None:
        found = self._store.load()
        for problem in found.problems:
            log.warning("checkpoint: %s", problem)
        checkpoint = found.checkpoint
        age = None if checkpoint is None else age_s(checkpoint.saved, self._moment())
        if age is not None and age > max_age_s:
            log.info(
                "checkpoint: %.0f s old, beyond process.resume_max_age_s: starting a new mission",
                age,
            )
            return
        self.is_restart = found.has_files
        if not found.has_files:
            return
        vehicle = None if checkpoint is None or age is None else checkpoint.vehicle
        if vehicle is not None and age is not None:
            vehicle = replace(vehicle, boot_s=vehicle.boot_s + age * self._clock.speed)
        self._endpoint.handle_event(UncleanExitFound(self._clock.now_s(), vehicle))
        if checkpoint is None:
            log.warning(
                "checkpoint: none is whole: starting a new mission, no automatic engagement"
            )
        elif age is None:
            log.warning(
                "checkpoint: its age is unknown: starting a new mission, no automatic engagement"
            )
        else:
            self._pending, self._age_s = checkpoint, age * self._clock.speed
        if checkpoint is not None:
            self._sequence = checkpoint.sequence + 1

    def _recall(self, checkpoint: Checkpoint, now_s: float) -> None:
        then, memory = checkpoint.key, checkpoint.memory
        difference = self._difference(then)
        if difference is not None:
            text = f"restarted with {difference}: starting a new mission, no automatic engagement"
            self._endpoint.handle_event(ProcessMessage(now_s, Severity.WARNING, text))
            if not self._is_of(then):
                return
            memory = memory.fences_alone
        age = self._age_s + now_s - self._began_s
        self._endpoint.handle_event(MemoryRecalled(now_s, memory, age))

    def _is_of(self, then: MissionKey) -> bool:
        """Return True if a key belongs to the bound vehicle."""
        now = self._key()
        return (then.system_id, then.autopilot) == (now.system_id, now.autopilot)

    def _difference(self, then: MissionKey) -> str | None:
        now = self._key()
        if not self._is_of(then):
            return f"another vehicle (it was {then.autopilot.value}, system {then.system_id})"
        is_same_fence = then.autopilot_fence == now.autopilot_fence
        if then.fence != now.fence or not (
            is_same_fence or self._endpoint.session.context.is_airborne
        ):
            return "other limits or another fence"
        return "another mission or estimator" if then.mission != now.mission else None

    def _key(self) -> MissionKey:
        binding, fencing = self._endpoint.binding, self._endpoint.session.fencing
        is_theirs, site, fence = fencing.plan.policy is FencePolicy.USE, fencing.site, self._limits
        if site is not None and not is_theirs:
            fence = _digest((fence, site))
        theirs = _digest(site) if is_theirs else ""
        return MissionKey(binding.system_id or 1, binding.autopilot, fence, self._mission, theirs)

    def _save(self, now_s: float) -> None:
        memory, vehicle = self._endpoint.session.memory, self._endpoint.binding.mark(now_s)
        checkpoint = Checkpoint(self._sequence, self._moment(), self._key(), memory, vehicle)
        self._store.save(checkpoint)
        self._sequence += 1


def _digest(value: object) -> str:
    return hashlib.sha256(msgspec.json.encode(value)).hexdigest()[:32]


MAX_BYTES = 100_000


class ParameterKeeper:
    """Keeps the changed parameters of one vehicle, and restores them at once."""

    def __init__(self, tunables: Tunables, path: Path) -> None:
        self._tunables = tunables
        self._path = path
        self._writer: BackgroundReplacer | None = None
        for problem in tunables.restore(self._load()):
            log.warning("%s: %s; continuing without", path, problem)
        self._kept = dict(tunables.changed)
        if self._kept:
            words = ", ".join(f"{name} {value:g}" for name, value in self._kept.items())
            log.info("parameters changed by a ground station: %s (%s)", words, path)

    def run(self, now_s: float) -> None:
        """Save changes; never waits."""
        del now_s
        self._save()

    def _save(self) -> None:
        if self._tunables.changed == self._kept:
            return
        self._kept = dict(self._tunables.changed)
        if self._writer is None:
            with suppress(OSError):  # the writer warns, once
                self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = BackgroundReplacer("write parameters")
        content = msgspec.json.format(msgspec.json.encode(self._kept), indent=2) + b"\n"
        self._writer.replace(self._path, content)

    def close(self, timeout_s: float) -> None:
        """Save what was changed since the last control tick, within `timeout_s`."""
        self._save()
        if self._writer is not None:
            self._writer.close(timeout_s)

    def _load(self) -> dict[str, float]:
        """Return the saved parameters; a file that cannot be read is reported and ignored."""
        try:
            with open_file(self._path) as file:
                data = file.read(MAX_BYTES)
            return msgspec.json.decode(data, type=dict[str, float])
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("%s: cannot be read (%s)", self._path, error.strerror)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            problem = decoding_problem(error)
            log.warning("%s: no parameters (%s); continuing without", self._path, problem)
        return {}


PERIOD_S = 30.0
FIRST_S = 5.0
"""Wait for the first one, from the moment when the search is worth reporting."""
BUSY_SHARE = 0.1
"""Largest share of the time that the writer works: with a learnt reach it repeats the search."""
MAX_QUEUED = 4
Snapshot = tuple[SearchedFlight, SearchState | None]


class SearchKeeper(WriterThread[Snapshot]):
    """Writes the searched area of one flight into its folder."""

    def __init__(self, session: GuidanceSession, journal: FlightJournal) -> None:
        self._session = session
        self._journal = journal
        self._next_s: float | None = None
        self._written: tuple[float, bool, Progress, bool] | None = None
        """Written last: seconds listened, True if all, found emitters, True with a learnt reach."""
        self._busy_s = 0.0
        """Time that the last write took."""
        super().__init__("write searched area", MAX_QUEUED)

    def run(self, now_s: float) -> None:
        """Write the searched area if that is due."""
        searching = self._session.searching
        if not searching.is_worth_reporting:
            return
        if self._next_s is None:
            self._next_s = now_s + FIRST_S
        if now_s >= self._next_s:
            self._next_s = now_s + max(PERIOD_S, self._busy_s / BUSY_SHARE)
            self._write()

    def _write(self) -> Snapshot | None:
        searching = self._session.searching
        flight = searching.flight(self._journal.started_unix_s)
        if flight is None:
            return None
        snapshot = (flight, searching.state)
        found = searching.progress
        present = (searching.listened_s, searching.is_over, found, flight.learnt is not None)
        if present != self._written:
            self._written = present
            self.append(snapshot)
        return snapshot

    def close(self, timeout_s: float = CLOSE_TIMEOUT_S) -> bool:
        """Write the last state within `timeout_s`, and log it."""
        self._session.searching.finish()
        snapshot = self._write()
        if snapshot is not None and snapshot[0].contact_unix_s is None:
            log.info("%s", statement(*snapshot))
        is_written = super().close(timeout_s)
        if not is_written:
            log.warning("%s: the final searched area was not written", self._journal.directory)
        return is_written

    def write_batch(self, batch: list[Snapshot]) -> None:
        """Write the newest search of the batch: its result and the files of its area."""
        began_s = time.monotonic()
        flight, state = batch[-1]
        if flight.learnt is not None:  # on this thread: it takes seconds
            state = combined_area([flight])
        self._journal.result_of_search(result_fields(flight, state))
        for name, content in area_files(flight, state).items():
            try:
                write_bytes_atomic(self._journal.directory / name, content)
            except CompanionError as error:
                self.failed += 1
                if self.failed == 1:
                    log.warning("%s", error)
        self._busy_s = time.monotonic() - began_s
