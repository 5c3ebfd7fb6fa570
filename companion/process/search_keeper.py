"""Keeps what was searched on disk, while it is searched and at the end.

A flight that is killed leaves what it had searched half a minute before. The files are made on a
thread of their own.
"""

from __future__ import annotations

import json
import logging

from companion.area_handoff import area_files, result_fields
from companion.errors import CompanionError
from companion.guidance.session import GuidanceSession
from companion.io.files import plain, write_bytes_atomic
from companion.io.logs.flight_recorder import FlightJournal
from companion.io.writer_thread import CLOSE_TIMEOUT_S, WriterThread
from companion.search.searched_area import SearchState
from companion.search.searched_flight import SearchedFlight, statement

log = logging.getLogger("companion.flight")

PERIOD_S = 30.0
FIRST_S = 5.0
"""Wait for the first one, from the moment when the search is worth reporting."""
MAX_QUEUED = 4
Snapshot = tuple[SearchedFlight, SearchState | None]


class SearchKeeper(WriterThread[Snapshot]):
    """Writes the searched area of one flight into its folder."""

    def __init__(self, session: GuidanceSession, journal: FlightJournal) -> None:
        self._session = session
        self._journal = journal
        self._next_s: float | None = None
        self._written: tuple[float, float | None] | None = None
        """Seconds listened and time of contact of what was written last."""
        self._now_s = 0.0
        super().__init__("write searched area", MAX_QUEUED)

    def run(self, now_s: float) -> None:
        """Write what was searched, if that is due."""
        self._now_s = now_s
        searching = self._session.searching
        if not searching.is_worth_reporting:
            return
        if self._next_s is None:
            self._next_s = now_s + FIRST_S
        if now_s >= self._next_s:
            self._next_s = now_s + PERIOD_S
            self._write()

    def _write(self) -> Snapshot | None:
        searching = self._session.searching
        flight = searching.flight(self._journal.started_unix_s)
        if flight is None:
            return None
        snapshot = (flight, searching.state(self._now_s))
        present = (searching.listened_s, searching.contact_s)
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
        return super().close(timeout_s)

    def write_batch(self, batch: list[Snapshot]) -> None:
        """Write the newest."""
        flight, state = batch[-1]
        text = json.dumps(plain(result_fields(flight, state)), allow_nan=False, indent=2)
        self._journal.result_of_search(text.encode() + b"\n")
        for name, content in area_files(flight, state).items():
            try:
                write_bytes_atomic(self._journal.directory / name, content)
            except CompanionError as error:
                self.failed += 1
                if self.failed == 1:
                    log.warning("%s", error)
