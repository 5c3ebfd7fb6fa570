"""The service manager's watchdog, stroked only when every part of the process answered.

Asked are: the control tick (it ran since the last stroke; this code itself runs on its thread), the
writers of logs and checkpoints (they are there; a disk that hangs is no reason to kill a flight),
and the links (open). Source of the rule: NASA F Prime, Svc/Health, HTH-007.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.io.checkpoint_store import CheckpointStore
from companion.io.journal import BlackBox
from companion.io.link_base import Link
from companion.io.shell import TimerStatistics
from companion.io.supervisor import Supervisor
from companion.link.endpoint import CompanionEndpoint

STROKES_PER_PATIENCE = 4.0
"""Strokes within the manager's patience."""
STATUS_PERIOD_S = 1.0


class Watchdog:
    """Tells the service manager how we are.

    Args:
        supervisor: The manager, or nobody.
        endpoint: The flight.
        journal: The black box.
        timing: Of the shell.
        links: Of the shell.
        store: Where checkpoints go; None: nowhere.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        endpoint: CompanionEndpoint,
        journal: BlackBox,
        timing: TimerStatistics,
        links: Sequence[Link],
        store: CheckpointStore | None,
    ) -> None:
        self._supervisor = supervisor
        self._endpoint = endpoint
        self._journal = journal
        self._timing = timing
        self._links = links
        self._store = store
        self._is_ready = False
        self._ticks = 0
        self._next_stroke_s = 0.0
        self._next_status_s = 0.0
        self._status = ""

    def run(self, now_s: float, wall_s: float) -> None:
        """Say what is due.

        Args:
            now_s: The session's time.
            wall_s: Monotonic wall seconds.
        """
        if not self._supervisor.is_there or self._timing.fired == 0:
            return
        if not self._is_ready:
            self._is_ready = True
            self._supervisor.ready()
        missing = self.missing()
        if wall_s >= self._next_stroke_s and missing is None:
            patience_s = self._supervisor.watchdog_s or STATUS_PERIOD_S
            self._next_stroke_s = wall_s + patience_s / STROKES_PER_PATIENCE
            self._ticks = self._timing.fired
            self._supervisor.alive()
        if wall_s >= self._next_status_s:
            self._next_status_s = wall_s + STATUS_PERIOD_S
            self._tell_status(now_s, missing)

    def missing(self) -> str | None:
        """Which part did not answer since the last stroke, in words, or None."""
        if self._timing.fired == self._ticks:
            return "the control tick"
        if not self._journal.health.is_alive:
            return "a writer of the log"
        writer = None if self._store is None else self._store.writer
        if writer is not None and not writer.is_alive:
            return "the writer of checkpoints"
        closed = next((link.name for link in self._links if not link.is_open), None)
        return None if closed is None else f"link {closed}"

    def _tell_status(self, now_s: float, missing: str | None) -> None:
        status = self._endpoint.session.status(now_s)
        text = f"{status.phase.value}: {status.detail}" if status.detail else status.phase.value
        if missing is not None and missing != "the control tick":
            text = f"does not answer: {missing}; {text}"
        if text != self._status:
            self._status = text
            self._supervisor.status(text)
