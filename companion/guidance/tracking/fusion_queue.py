"""Queue of measurements for the filters, which fuse a few steps at a time.

Theory of operation. Estimation may not delay a setpoint. So measurements queue up by emitter, each
is fused in steps (`companion.estimation.stepwise`), and between two wake-ups only a limited number
of steps is made, counted by the measurements that they process: never by a clock, so that a replay
makes the same steps at the same wake-ups. A measurement is finished before the next one of its
emitter begins, so that estimates are the same, only later; a solution of the window takes some
wake-ups. The current emitter goes first, the others alternate, which puts their solutions out of
phase.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from companion.domain import PositionAccuracy, RangingMeasurement
from companion.estimation.stepwise import Steps
from companion.estimation.tracker import FusionReport

WAKE_ROWS = 20_000
"""Measurements that the steps of one wake-up process: a tenth of a control period, 5 ms."""
BEGIN_ROWS = 4_000
"""Cost of a measurement in this unit besides solutions: screen, filter and the use of the estimate,
1 ms in plain Python."""
MOST_QUEUED = 256
"""Limit at which the oldest is dropped: 16 emitters at 10 Hz for more than a second."""


class Queued(NamedTuple):
    """Measurement whose vehicle position is known, with the accuracy at that time."""

    measurement: RangingMeasurement
    now_s: float
    own: PositionAccuracy | None


class FusionQueue:
    """Fuses added measurements by `begin`, in the order of each emitter."""

    def __init__(self, begin: Callable[[Queued], Steps[FusionReport]]) -> None:
        self._begin = begin
        self._queues: dict[int, deque[Queued]] = {}
        """Queues by emitter, none of them empty, the next in turn first."""
        self._begun: dict[int, Steps[FusionReport]] = {}
        """Remaining steps for the first measurement of a queue."""
        self._left = WAKE_ROWS

    def __bool__(self) -> bool:
        """Return True while measurements are not fused yet; cheaper than their number."""
        return bool(self._queues)

    def __len__(self) -> int:
        """Return the number of measurements that are not fused yet."""
        return sum(len(queue) for queue in self._queues.values())

    def add(self, queued: Queued) -> bool:
        """Queue a measurement; return True if it took the place of an older one."""
        is_full = len(self) >= MOST_QUEUED
        if is_full:
            self._drop_oldest()
        self._queues.setdefault(queued.measurement.emitter_id, deque()).append(queued)
        return is_full

    def _drop_oldest(self) -> None:
        """Drop the oldest measurement of the longest queue that is not begun."""

        def waiting(key: int) -> int:
            return len(self._queues[key]) - (key in self._begun)

        longest = max(self._queues, key=waiting)
        del self._queues[longest][longest in self._begun]
        if not self._queues[longest]:
            del self._queues[longest]

    def renew(self) -> None:
        """Allow the steps of another wake-up."""
        self._left = WAKE_ROWS

    def advance(self, first_id: int | None) -> list[FusionReport]:
        """Make the steps of this wake-up; return reports of finished measurements, oldest first."""
        reports = []
        while self._left > 0 and self._queues:
            key = first_id if first_id in self._queues else next(iter(self._queues))
            assert key is not None
            report = self._step(key)
            if report is not None:
                reports.append(report)
        return reports

    def _step(self, key: int) -> FusionReport | None:
        """Make one step for an emitter; return the report once its measurement is finished."""
        steps = self._begun.pop(key, None)
        if steps is None:
            steps = self._begin(self._queues[key][0])
            self._left -= BEGIN_ROWS
        # also if a step raises: a measurement that makes a filter fail is not repeated
        is_over = True
        try:
            self._left -= next(steps)
            self._begun[key] = steps
            is_over = False
        except StopIteration as end:
            report: FusionReport = end.value
            return report
        finally:
            if is_over:
                self._end(key)
        return None

    def _end(self, key: int) -> None:
        """Remove a measurement, and move its emitter to the end of the turn."""
        queue = self._queues.pop(key)
        queue.popleft()
        if queue:
            self._queues[key] = queue
